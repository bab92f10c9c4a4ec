"""Runs a command in a container; docker restarts it after a failure, but not for wrong settings.

    entry.py COMMAND [SETTING...]

With `restart: on-failure` only exit status 0 ends a container for good.
"""

import sys

from tangram_cli.commands import COMMANDS
from tangram_core.errors import USAGE_STATUS


def main() -> int:
    """Run the command and return its exit status, but 0 for wrong input."""
    status = COMMANDS[sys.argv.pop(1)]()
    if status != USAGE_STATUS:
        return status
    sys.stderr.write("not restarted: correct the settings, then run docker-compose up again\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
