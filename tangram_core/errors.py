"""Errors that a user can cause and mend.

Command lines print them as one line and exit with status 2, so each message names the value,
the bound and what to do.
"""

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


class TangramError(Exception):
    """Base of every error that is shown to the user without a traceback."""


class ConfigError(TangramError):
    """A setting that cannot work."""


class SamplingError(TangramError):
    """No layout without overlap was found within the allowed tries."""


class RunError(TangramError):
    """A run folder or a checkpoint that cannot be used."""


class WireError(TangramError):
    """A message that breaks the protocol."""
