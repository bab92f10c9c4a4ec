"""`python -m master` is tangram-master."""

import sys

from master.cli import master

sys.exit(master())
