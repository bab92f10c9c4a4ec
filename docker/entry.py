"""A command in a container that docker starts again when it fails, unless its settings are wrong.

    entry.py COMMAND [SETTING...]

`restart: on-failure` knows one status that ends a container for good, 0.
"""

import sys

from tangram_cli.commands import COMMANDS
from tangram_core.errors import USAGE_STATUS


def main() -> int:
    """The command's exit status; 0 for wrong input."""
    status = COMMANDS[sys.argv.pop(1)]()
    if status != USAGE_STATUS:
        return status
    sys.stderr.write("not started again: change the settings, and give docker-compose up again\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
