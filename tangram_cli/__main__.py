"""`python -m tangram_cli train ...` is `tangram-train ...`; commands start each other this way."""

import sys

from tangram_cli.commands import COMMANDS

if len(sys.argv) < 2 or sys.argv[1] not in COMMANDS:
    sys.exit(f"tangram_cli: name a command: {', '.join(COMMANDS)}")
sys.exit(COMMANDS[sys.argv.pop(1)]())
