"""`python -m benchmarks` measures speed and endurance, and writes JSON with its sources."""

import argparse
import re
import sys
import tempfile
from pathlib import Path

from benchmarks.chaos import run_chaos
from benchmarks.fuzz_wire import run_fuzz
from benchmarks.rates import measure_rates
from benchmarks.soak import run_soak
from tangram_sim.errors import TangramError


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description=__doc__,
        epilog="Options may be written as elsewhere in this project: minutes=20 for --minutes 20.",
    )
    kinds = parser.add_subparsers(dest="kind", required=True)
    rates = kinds.add_parser("rates", help="episodes, actions, batches and updates per second")
    rates.add_argument("--runs", type=int, default=5, help="measurements of each rate (5)")
    chaos = kinds.add_parser("chaos", help="random faults over a real training")
    chaos.add_argument("--minutes", type=float, default=20.0, help="of faults (20)")
    fuzz = kinds.add_parser("fuzz", help="mutated messages against decoder and master")
    fuzz.add_argument("--messages", type=int, default=1_000_000, help="for the decoder (1,000,000)")
    fuzz.add_argument("--live", type=int, default=100_000, help="for a live master (100,000)")
    soak = kinds.add_parser("soak", help="memory and open files of a long training, drawn")
    soak.add_argument("--minutes", type=float, default=60.0, help="of training (60)")
    for one in (chaos, fuzz, soak):
        one.add_argument("--seed", type=int, default=0, help="of everything random (0)")
    for one in (rates, chaos, fuzz, soak):
        one.add_argument("--out", type=Path, help="JSON file of the results")
    return parser


def main() -> int:
    given = [_dashed(argument) for argument in sys.argv[1:]]
    # The usual one: its name may be left out.
    named = bool(given) and (not given[0].startswith("-") or given[0] in ("-h", "--help"))
    arguments = _parser().parse_args(given if named else ["rates", *given])
    try:
        return _run(arguments)
    except TangramError as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        return 2


def _dashed(argument: str) -> str:
    return f"--{argument}" if re.fullmatch(r"[a-z]+=.*", argument) else argument


def _run(arguments: argparse.Namespace) -> int:
    if arguments.kind == "rates":
        measure_rates(arguments.runs, arguments.out)
        return 0
    with tempfile.TemporaryDirectory(prefix="tangram-") as folder:
        if arguments.kind == "chaos":
            return run_chaos(arguments.minutes, arguments.seed, arguments.out, Path(folder))
        if arguments.kind == "soak":
            return run_soak(arguments.minutes, arguments.seed, arguments.out, Path(folder) / "run")
        numbers = (arguments.messages, arguments.live, arguments.seed)
        return run_fuzz(*numbers, arguments.out, Path(folder) / "run")


if __name__ == "__main__":
    sys.exit(main())
