"""`tangram-bench`: how fast it is against what else one could do, and trials with faults."""

import argparse
import re
import signal
import sys
import tempfile
from pathlib import Path

from tangram_core.errors import TangramError
from tangram_core.settings import check_range
from tangram_core.store.files import check_writable

EPILOG = """\
Options may be written as elsewhere in this project: runs=9 for --runs 9.

examples:
  tangram-bench learner                     a table of the learner alone
  tangram-bench learner runs=9 out=l.json   more runs, and a file with machine, versions, commit
  tangram-bench all out=bench.json          learner and scaling (make bench)
  tangram-bench fetch id=PandaPush-v3 minutes=60    ours and Stable-Baselines3 side by side
  tangram-bench fetch seeds=3 rows=fetch.csv    five tasks; given again, it goes on
  tangram-bench chaos minutes=20 seed=1     random faults over a real training
  tangram-bench attack out=attack.json      every attack that is known, on real trainings
"""
RATES = {
    "learner": "updates against single operations and Stable-Baselines3",
    "fetch": "tasks of Fetch and Panda learned, against Stable-Baselines3",
    "scaling": "more workers, and 64 synthetic ones",
    "gpu": "updates on a GPU, recorded, against other ways there and one core",
}
TRIALS = {
    "chaos": "random faults over a real training",
    "attack": "every attack that is known, on trainings that run; what held",
}
# Option -> its bounds.
BOUNDS = {
    "runs": (1, 10_000),
    "minutes": (0.01, 1e5),
    "seed": (0, 2**63 - 1),
    "seeds": (1, 1000),
    "workers": (0, 1000),
}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="tangram-bench",
        description=__doc__,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    kinds = parser.add_subparsers(dest="kind", required=True)
    for name, text in {"all": "learner and scaling", **RATES}.items():
        one = kinds.add_parser(name, help=text, description=text)
        one.add_argument("--runs", type=int, default=5, help="measurements of each rate (5)")
        one.add_argument("--out", type=Path, help="JSON file of the results")
        if name == "fetch":
            one.add_argument("--id", help="of gymnasium (five of Fetch and Panda)")
            one.add_argument("--minutes", type=float, default=60.0, help="of each training (60)")
            one.add_argument("--seeds", type=int, default=1, help="of each, from 0 (1)")
            one.add_argument("--agent", default="goal", help="our preset: goal or push (goal)")
            one.add_argument("--workers", type=int, default=0, help="of ours (0: one for a core)")
            one.add_argument("--rows", type=Path, help="CSV file: what it has is not run again")
    for name, text in TRIALS.items():
        one = kinds.add_parser(name, help=text, description=text)
        if name == "chaos":
            one.add_argument("--minutes", type=float, default=20.0, help="of faults (20)")
            one.add_argument("--seed", type=int, default=0, help="of everything random (0)")
        one.add_argument("--out", type=Path, help="JSON file of the results")
    return parser


def main() -> int:
    """The command."""
    # As after Ctrl-C, so that no process that was started is left.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    arguments = _parser().parse_args([_dashed(argument) for argument in sys.argv[1:]])
    try:
        _check(arguments)
        return _run(arguments)
    except (TangramError, ModuleNotFoundError) as error:
        print(f"tangram-bench: {error}", file=sys.stderr)
        return 2


def _check(arguments: argparse.Namespace) -> None:
    """Raise ConfigError for a number out of its bounds, or a file that cannot be written."""
    for name, value in vars(arguments).items():
        if name in BOUNDS:
            check_range(name, value, *BOUNDS[name])
        if name in ("out", "rows") and value is not None:
            check_writable(name, value.absolute())


def _dashed(argument: str) -> str:
    return f"--{argument}" if re.fullmatch(r"[a-z_]+=.*", argument) else argument


def _run(arguments: argparse.Namespace) -> int:
    # Late imports: --help and wrong input are answered at once.
    if arguments.kind not in TRIALS:
        from tangram_lab.benchmarks.stages import run_stages

        return run_stages(arguments)
    from tangram_lab.benchmarks.trials.attack import run_attack
    from tangram_lab.benchmarks.trials.chaos import run_chaos

    with tempfile.TemporaryDirectory(prefix="tangram-") as folder:
        if arguments.kind == "attack":
            return run_attack(arguments.out, Path(folder))
        return run_chaos(arguments.minutes, arguments.seed, arguments.out, Path(folder))
