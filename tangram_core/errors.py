"""Errors that are told without a traceback.

Command lines print them as one line, so each message names the value, the bound and what to do. The
status says whose fault it was: 2 the user's, who must change something, 75 the environment's.
"""

import os
from errno import EADDRINUSE, EDQUOT, EIO, EMFILE, ENFILE, ENOMEM, ENOSPC, EROFS, ESTALE

# What reading a file raises that anybody may have written: it is missing, no JSON, or another one.
UNREADABLE = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    OverflowError,
    RecursionError,
)
USAGE_STATUS, UNAVAILABLE_STATUS = 2, os.EX_TEMPFAIL
# A disk that is full or fails, no memory, no open files, a port that another process has.
PASSING = (ENOSPC, EDQUOT, EIO, EROFS, ESTALE, ENOMEM, EMFILE, ENFILE, EADDRINUSE)


class TangramError(Exception):
    """Base of every error that is shown to the user without a traceback."""


class ConfigError(TangramError):
    """A setting that cannot work."""


class OwnCodeError(ConfigError):
    """Code of the user's own fails, whatever it says of the environment."""


class UnavailableError(TangramError):
    """What the environment lacks, and may have again by itself: it helps to try again later."""


class SamplingError(TangramError):
    """No layout without overlap was found within the allowed tries."""


class RunError(TangramError):
    """A run folder or a checkpoint that cannot be used."""


class WireError(TangramError):
    """A message that breaks the protocol."""


def is_passing(error: BaseException | None) -> bool:
    """Whether an error, or the one that it was made of, is the environment's."""
    seen = set[int]()
    while error is not None and id(error) not in seen and not isinstance(error, OwnCodeError):
        seen.add(id(error))
        known = isinstance(error, UnavailableError | MemoryError)
        if known or getattr(error, "errno", None) in PASSING:
            return True
        error = error.__cause__ or error.__context__
    return False
