"""`python -m benchmarks rates` measures speed; `python -m benchmarks seeds` trains over seeds.

Both print a table and write JSON with the command, the commit, the machine and the versions.
"""

import argparse
import sys
from pathlib import Path

from benchmarks.rates import measure_rates
from benchmarks.seeds import train_seeds
from tangram_sim.errors import TangramError


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    kinds = parser.add_subparsers(dest="kind")
    rates = kinds.add_parser("rates", help="episodes, actions, batches and updates per second")
    rates.add_argument("--out", type=Path, help="JSON file of the medians and their spread")
    rates.add_argument("--runs", type=int, default=5, help="measurements of each rate (5)")
    seeds = kinds.add_parser("seeds", help="train one setting over seeds, report all of them")
    seeds.add_argument("--out", type=Path, help="JSON file of every seed's result")
    seeds.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    seeds.add_argument("--folder", type=Path, default=Path("runs/seeds"), help="of the runs")
    seeds.add_argument("overrides", nargs="*", help="settings of tangram-train")
    return parser


def main() -> int:
    arguments = _parser().parse_args(sys.argv[1:] or ["rates"])
    try:
        if arguments.kind == "rates":
            measure_rates(arguments.runs, arguments.out)
        else:
            train_seeds(
                arguments.seeds, arguments.folder, tuple(arguments.overrides), arguments.out
            )
    except TangramError as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
