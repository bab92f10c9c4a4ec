"""`tangram-bench`: how fast it is against what else one could do, and long trials of endurance."""

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
  tangram-bench wire runs=9 out=wire.json   more runs, and a file with machine, versions, commit
  tangram-bench all out=bench.json          everything, most of an hour on two cores (make bench)
  tangram-bench chaos minutes=20 seed=1     random faults over a real training
  tangram-bench attack out=attack.json      every attack that is known, on real trainings
"""
RATES = {
    "sim": "the simulation, also where tokens are seen in pictures, against a bare PyBullet loop",
    "wire": "worker to master, against bare ROUTER-DEALER sockets",
    "learner": "updates, compiled or not, against Stable-Baselines3",
    "train": "a whole training, against Stable-Baselines3 (minutes=)",
    "scaling": "more workers, and 64 synthetic ones",
    "gpu": "updates on a GPU, against single operations there and one core",
}
TRIALS = {
    "chaos": ("random faults over a real training", 20.0),
    "attack": ("every attack that is known, on trainings that run; what held", None),
    "fuzz": ("mutated messages against decoder and master", None),
    "silhouettes": ("silhouettes filled with seven tans: how many, how fast", None),
    "seeing": ("tokens found in pictures: how exactly, how surely, how fast", None),
    "soak": ("memory and open files of a long training, drawn", 60.0),
}
# Option -> its bounds.
BOUNDS = {
    "runs": (1, 10_000),
    "seeds": (1, 1000),
    "minutes": (0.01, 1e5),
    "messages": (1, 10**12),
    "live": (1, 10**12),
    "scenes": (1, 10**6),
    "seed": (0, 2**63 - 1),
}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="tangram-bench",
        description=__doc__,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    kinds = parser.add_subparsers(dest="kind", required=True)
    for name, text in {"all": "everything below down to scaling", **RATES}.items():
        one = kinds.add_parser(name, help=text, description=text)
        one.add_argument("--runs", type=int, default=5, help="measurements of each rate (5)")
        one.add_argument("--out", type=Path, help="JSON file of the results")
        if name in ("all", "train"):
            limit = "that a rival's training may last (5)"
            one.add_argument("--minutes", type=float, default=5.0, help=limit)
        if name in ("all", "train"):
            one.add_argument("--seeds", type=int, default=3, help="trainings of each (3)")
    for name, (text, minutes) in TRIALS.items():
        one = kinds.add_parser(name, help=text, description=text)
        if minutes is not None:
            one.add_argument("--minutes", type=float, default=minutes, help=f"({minutes:g})")
        elif name == "fuzz":
            one.add_argument("--messages", type=int, default=1_000_000, help="for the decoder")
            one.add_argument("--live", type=int, default=100_000, help="for a live master")
        elif name in ("seeing", "silhouettes"):
            one.add_argument("--scenes", type=int, default=200, help="of each kind (200)")
        if name != "attack":
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
    if arguments.out is not None:
        check_writable("out", arguments.out.absolute())


def _dashed(argument: str) -> str:
    return f"--{argument}" if re.fullmatch(r"[a-z_]+=.*", argument) else argument


def _run(arguments: argparse.Namespace) -> int:
    # Late imports: --help and wrong input are answered at once.
    if arguments.kind not in TRIALS:
        from tangram_lab.benchmarks.stages import run_stages

        return run_stages(arguments)
    from tangram_lab.benchmarks.sight.seeing import run_seeing
    from tangram_lab.benchmarks.sight.silhouettes import run_silhouettes
    from tangram_lab.benchmarks.trials.attack import run_attack
    from tangram_lab.benchmarks.trials.chaos import run_chaos
    from tangram_lab.benchmarks.trials.fuzz_wire import run_fuzz
    from tangram_lab.benchmarks.trials.soak import run_soak

    of_scenes = {"seeing": run_seeing, "silhouettes": run_silhouettes}
    if arguments.kind in of_scenes:
        return of_scenes[arguments.kind](arguments.scenes, arguments.seed, arguments.out)
    with tempfile.TemporaryDirectory(prefix="tangram-") as folder:
        if arguments.kind == "attack":
            return run_attack(arguments.out, Path(folder))
        if arguments.kind == "chaos":
            return run_chaos(arguments.minutes, arguments.seed, arguments.out, Path(folder))
        if arguments.kind == "soak":
            return run_soak(arguments.minutes, arguments.seed, arguments.out, Path(folder) / "run")
        numbers = (arguments.messages, arguments.live, arguments.seed)
        return run_fuzz(*numbers, arguments.out, Path(folder) / "run")
