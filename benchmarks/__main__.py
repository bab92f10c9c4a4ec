"""python -m benchmarks, the same as tangram-bench."""

import sys

from benchmarks.cli import main

sys.exit(main())
