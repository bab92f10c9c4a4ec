"""`python -m worker` is tangram-worker."""

import sys

from worker.cli import worker

sys.exit(worker())
