"""`tangram-bench`: speed compared with alternatives, and trials with faults and attacks."""

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
Options may be written like settings: runs=9 for --runs 9.

examples:
  tangram-bench learner                     a table of the learner alone
  tangram-bench learner runs=9 out=l.json   nine runs, and a file with machine, versions, commit
  tangram-bench all out=bench.json          learner and scaling (make bench)
  tangram-bench fetch id=PandaPush-v3 minutes=60    ours and Stable-Baselines3 side by side
  tangram-bench fetch seeds=3 rows=fetch.csv    five tasks; the same command again continues
  tangram-bench gpu profile=true            recorded updates, and what a second of them does
  tangram-bench chaos minutes=20 seed=1     random faults in a real training
  tangram-bench attack out=attack.json      all known attacks on real trainings
"""
RATES = {
    "learner": "compiled updates, compared with single operations and Stable-Baselines3",
    "fetch": "learning of Fetch and Panda tasks, compared with Stable-Baselines3",
    "scaling": "one and two workers, and up to 1,000 synthetic ones",
    "gpu": "recorded updates on a GPU, compared with other ways on the GPU and with one core",
}
TRIALS = {
    "chaos": "random faults in a real training: what recovers and what is lost",
    "attack": "all known attacks on real trainings: which ones fail to do harm",
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
        if name == "gpu":
            about = "true: write timeline.json, a second of updates for Chrome's tracing (false)"
            one.add_argument("--profile", choices=("true", "false"), default="false", help=about)
        if name == "fetch":
            one.add_argument("--id", help="gymnasium id of one task (five of Fetch and Panda)")
            one.add_argument("--minutes", type=float, default=60.0, help="per training (60)")
            one.add_argument("--seeds", type=int, default=1, help="seeds per task, from 0 (1)")
            one.add_argument(
                "--agent", default="goal", help="our preset: goal or goal_large (goal)"
            )
            one.add_argument("--workers", type=int, default=0, help="our workers (0: by cores)")
            one.add_argument("--rows", type=Path, help="CSV file: trainings in it are not repeated")
    for name, text in TRIALS.items():
        one = kinds.add_parser(name, help=text, description=text)
        if name == "chaos":
            one.add_argument("--minutes", type=float, default=20.0, help="time with faults (20)")
            one.add_argument("--seed", type=int, default=0, help="seed of faults and training (0)")
        one.add_argument("--out", type=Path, help="JSON file of the results")
    return parser


def main() -> int:
    """Run tangram-bench and return its exit status."""
    # SIGTERM then ends the program as Ctrl-C does, with all processes that it started.
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
    # Imported late, so that --help and wrong input answer at once.
    if arguments.kind not in TRIALS:
        from tangram_lab.benchmarks.stages import run_stages

        return run_stages(arguments)
    from tangram_lab.benchmarks.trials.attack import run_attack
    from tangram_lab.benchmarks.trials.chaos import run_chaos

    with tempfile.TemporaryDirectory(prefix="tangram-") as folder:
        if arguments.kind == "attack":
            return run_attack(arguments.out, Path(folder))
        return run_chaos(arguments.minutes, arguments.seed, arguments.out, Path(folder))
