"""`python -m benchmarks` measures speed, and writes JSON that says where its numbers come from."""

import argparse
import sys
from pathlib import Path

from benchmarks.rates import measure_rates
from tangram_sim.errors import TangramError


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    kinds = parser.add_subparsers(dest="kind", required=True)
    rates = kinds.add_parser("rates", help="episodes, actions, batches and updates per second")
    rates.add_argument("--out", type=Path, help="JSON file of the medians and their spread")
    rates.add_argument("--runs", type=int, default=5, help="measurements of each rate (5)")
    return parser


def main() -> int:
    given = sys.argv[1:]
    # One benchmark so far: its name may be left out.
    named = bool(given) and (not given[0].startswith("-") or given[0] in ("-h", "--help"))
    arguments = _parser().parse_args(given if named else ["rates", *given])
    try:
        measure_rates(arguments.runs, arguments.out)
    except TangramError as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
