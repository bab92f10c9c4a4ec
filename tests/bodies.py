"""What a child runs in the place of a command."""

import sys
from collections.abc import Sequence


def run_code(arguments: Sequence[str]) -> int:
    """As Python does with `-c CODE ...`."""
    option, code, *rest = arguments
    sys.argv[:] = [option, *rest]
    exec(code, {"__name__": "__main__"})  # noqa: S102
    return 0
