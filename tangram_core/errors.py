"""Errors that are shown without a traceback.

Commands print an error as one line, so each message names the value, the bound and a remedy. The
exit status tells the cause: 1 is a run that failed, 2 the user's input, 75 the environment.
"""

import os
from errno import EADDRINUSE, EDQUOT, EIO, EMFILE, ENFILE, ENOMEM, ENOSPC, EROFS, ESTALE

# Errors of reading a file from anybody: it may be missing, not JSON, or have another content.
UNREADABLE = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    OverflowError,
    RecursionError,
)
FAILED_STATUS, USAGE_STATUS, UNAVAILABLE_STATUS = 1, 2, os.EX_TEMPFAIL
# A disk that is full or fails, no memory, too many open files, a port in use.
PASSING = (ENOSPC, EDQUOT, EIO, EROFS, ESTALE, ENOMEM, EMFILE, ENFILE, EADDRINUSE)


class TangramError(Exception):
    """Base of every error that is shown to the user without a traceback."""

    status = USAGE_STATUS  # exit status of a command that ends with this error


class ConfigError(TangramError):
    """A setting that cannot work."""


class OwnCodeError(ConfigError):
    """The user's own code fails; the status is 2 even for an error of the environment."""


class UnavailableError(TangramError):
    """The environment lacks something for now, such as disk space: try again later."""

    status = UNAVAILABLE_STATUS


class FailedError(TangramError):
    """A run that cannot go on as it is, such as one that diverged."""

    status = FAILED_STATUS


class SamplingError(TangramError):
    """No layout without overlap was found within the allowed tries."""


class RunError(TangramError):
    """A run folder or a checkpoint that cannot be used."""


class WireError(TangramError):
    """A message that breaks the protocol."""

    status = FAILED_STATUS


def is_passing(error: BaseException | None) -> bool:
    """Whether the environment caused an error, directly or through the error's cause."""
    seen = set[int]()
    while error is not None and id(error) not in seen and not isinstance(error, OwnCodeError):
        seen.add(id(error))
        known = isinstance(error, UnavailableError | MemoryError)
        if known or getattr(error, "errno", None) in PASSING:
            return True
        error = error.__cause__ or error.__context__
    return False
