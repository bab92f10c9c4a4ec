"""Make an agent that comes with the package, from finished runs of several seeds.

`python -m tangram_lab.experiments.pretrained square runs/seeds/square/seed_*` puts the run with
the median score into `tangram_agent/pretrained/square`, with a card that has the scores of all
seeds.
"""

import argparse
import hashlib
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import safetensors.numpy
import torch
import yaml

from tangram_agent.pretrained import CARD, CONFIG, FORMAT, WEIGHTS
from tangram_agent.runs import Run, load_run
from tangram_core.errors import ConfigError, RunError, TangramError
from tangram_core.settings import told
from tangram_core.store.checkpoints import ACTING, CHECKPOINTS, load_checkpoint, newest_checkpoint
from tangram_core.store.files import check_writable, write_whole
from tangram_game.config import EvalConfig
from tangram_game.evaluate import policies, score_policies
from tangram_game.figures.puzzles import by, find_figures
from tangram_game.scores import RUN, score_puzzles
from tangram_sim.targets.targets import has_all_tans
from tangram_tasks.place import Place

PACKAGE = Path(__file__).resolve().parents[2] / "tangram_agent" / "pretrained"
RESULT = "result.json"
MAX_BYTES = 1_000_000  # size limit of the weights, because every installation contains them
FIGURES, TURNS = ("test", "train"), 4  # splits of the library, and angles of each figure
TESTS, TEST_SEED = 400, 1  # fresh tests: evaluators and the choice of settings used seed 0
# Look-ahead settings that the published agent uses, but training does not.
AHEAD = {"push": {"tried": 16}}
DEAR = ("table", "planner", "planner_told", "planner_wrong")  # rivals that would take hours


class Candidate(NamedTuple):
    """A finished run of one seed with its final weights, and the content of result.json."""

    run: Run
    result: dict[str, Any]


def publish(
    run_dirs: Sequence[Path], name: str, target: Path = PACKAGE, tests: int = TESTS
) -> Path:
    """Write the folder of an agent: weights of the median seed, and a card about all seeds.

    The run with the median final score is chosen (the lower one of two). The best seed would
    promise more than a new training achieves.

    Args:
        run_dirs: finished runs of one setup, one for each seed.
        name: name of the agent: lower-case letters, digits and underscores.
        target: folder in which the agent's folder is made.
        tests: number of new test episodes on which the chosen weights are scored again.

    Returns:
        The agent's folder.

    Raises:
        RunError: a run is unfinished or has another setup, or the weights are too large.
        ConfigError: the name is invalid, or the folder cannot be written.
    """
    if not (name.isascii() and name.isidentifier() and name == name.lower()):
        raise ConfigError(f"name must be a-z, 0-9 (not in front) and _, got '{name}'")
    check_writable("--out", (target / name / CARD).absolute())
    seeds = sorted((_read(path) for path in run_dirs), key=lambda one: int(one.result["seed"]))
    _check_one_setup(seeds)
    chosen = median(seeds)
    if ahead := AHEAD.get(chosen.run.setup.agent_kind):
        chosen = chosen._replace(run=chosen.run.with_settings({"agent": ahead}))
    weights = _weights(chosen.run)
    config = EvalConfig(str(chosen.run.folder), episodes=tests, seed=TEST_SEED)
    players = {name: one for name, one in policies(chosen.run).items() if name not in DEAR}
    task = chosen.run.setup.task
    scores = score_policies(task, players, config)
    card = make_card(name, chosen, seeds)
    card |= {"tests": {"episodes": tests, "seed": TEST_SEED, "scores": scores}}
    places = isinstance(task, Place) and task.sim.observe != "pictures"  # pieces of figures touch
    if isinstance(task, Place) and places and has_all_tans(task.layout):
        card |= {"puzzles": {split: _on_figures(chosen.run, split) for split in FIGURES}}
    card |= {"sha256": hashlib.sha256(weights).hexdigest()}
    folder = target / name
    # Only the setup, with every value; the config of a run would also name its machine.
    content = yaml.safe_dump(chosen.run.setup.config(), sort_keys=False)
    write_whole(folder / CONFIG, content.encode())
    write_whole(folder / WEIGHTS, weights)
    write_whole(folder / CARD, (json.dumps(card, indent=1) + "\n").encode())
    return folder


def _on_figures(run: Run, split: str) -> dict[str, Any]:
    """Mean scores of a run on the figures of a split."""
    figures = find_figures(split, run.task, None, TURNS)
    scored = score_puzzles(run.task, figures, {RUN: by(run.actor)}, TEST_SEED)
    return {"turns": TURNS, "scores": scored.means[RUN]}


def median(seeds: Sequence[Candidate]) -> Candidate:
    """The candidate with the median final score; the lower one of two."""
    ranked = sorted(seeds, key=lambda one: float(one.result[_ranks(one.result)]))
    return ranked[(len(ranked) - 1) // 2]


def _ranks(result: Mapping[str, Any]) -> str:
    """Name of the score by which runs are ranked."""
    return "solved" if result.get("mean_reward") is None else "mean_reward"


def _read(run_dir: Path) -> Candidate:
    path = run_dir / RESULT
    try:
        result = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        raise RunError(f"cannot read {path}: name the folder of a finished run") from None
    if not isinstance(result, dict) or result.get(_ranks(result)) is None:
        raise RunError(f"{path} holds no score: train it with an evaluator")
    run = load_run(run_dir)
    if not result["scored_updates"] == result["updates"] == run.updates:
        raise RunError(
            f"{run_dir} was scored after {result['scored_updates']} of its {result['updates']} "
            f"updates and holds weights of {run.updates}: the scores must be those of the final "
            "weights, so train it to its end"
        )
    return Candidate(run, result)


def _check_one_setup(seeds: Sequence[Candidate]) -> None:
    if not seeds:
        raise RunError("no runs: name the folder of at least one finished run")
    first = seeds[0]
    for one in seeds[1:]:
        odd = first.run.setup.differences(one.run.setup.contents())
        if odd:
            raise RunError(
                f"{one.run.folder} differs from {first.run.folder} in {', '.join(odd)}: name runs "
                "that share all settings but the seed"
            )
    numbers = [one.result["seed"] for one in seeds]
    if len(set(numbers)) < len(numbers):
        raise RunError(f"the runs are of the seeds {numbers}: name each seed once")


def _weights(run: Run) -> bytes:
    """Weights of the acting actor in float32, in safetensors format."""
    path = newest_checkpoint(run.folder / CHECKPOINTS)
    tensors = load_checkpoint(path, [ACTING]).arrays[ACTING]
    single = {k: np.ascontiguousarray(v, np.float32) for k, v in sorted(tensors.items())}
    data: bytes = safetensors.numpy.save(single)
    if len(data) > MAX_BYTES:
        raise RunError(
            f"the weights of {run.folder} have {len(data):,} bytes, more than {MAX_BYTES:,}: "
            "publish an agent with a smaller net"
        )
    return data


# The card: how the agent was trained, and its scores

# Keys of result.json about the cost of training.
_BUDGET = ("updates", "train_s", "wall_s", "cores", "processor", "device", "workers")

# Keys of result.json for the scores of each seed.
_SCORES = (
    *("solved", "placed", "pushes", "mean_reward", "coverage", "coverage_p10", "iou"),
    *("angle_error_deg_median", "position_error_median"),
)


def make_card(name: str, chosen: Candidate, seeds: Sequence[Candidate]) -> dict[str, Any]:
    """The content of card.json except the tests, the puzzles and the checksum.

    Args:
        name: name of the agent.
        chosen: the run whose weights are published.
        seeds: all runs, in the order of their seeds.
    """
    setup, result = chosen.run.setup, chosen.result
    world = setup.config()
    acting = sum(tensor.size for tensor in chosen.run.weights.tensors.values())
    return {
        "format": FORMAT,
        "name": name,
        "licence": "MIT",
        "tokens": list(world["tokens"]["shapes"]),
        "scale": world["tokens"]["scale"],
        **setup.agent.facts(),
        "sim": {key: told(value) for key, value in world.get("sim", world["task"]).items()},
        "parameters": {"acting": acting, "trained": result["parameters"]},
        "budget": _picked(result, *_BUDGET),
        **_picked(result, "updates", "seed", "episodes", "transitions", "test_episodes"),
        "selection": f"median of the seeds by final {_ranks(result)} (the lower one of two)",
        "seeds": [
            {key: one.result.get(key) for key in ("seed", "train_s", *_SCORES)} for one in seeds
        ],
        **_picked(result, "commit", "versions"),
    }


def _picked(result: Mapping[str, Any], *names: str) -> dict[str, Any]:
    return {name: result[name] for name in names}


def main() -> int:
    """Run `python -m tangram_lab.experiments.pretrained NAME RUN_DIR...`; return exit status."""
    program = "python -m tangram_lab.experiments.pretrained"
    parser = argparse.ArgumentParser(prog=program, description=__doc__)
    parser.add_argument("name", help="name of the agent, as in pretrained/NAME")
    parser.add_argument("run_dirs", metavar="RUN_DIR", type=Path, nargs="+", help="a run per seed")
    parser.add_argument("--out", type=Path, default=PACKAGE, help="folder to make NAME in")
    parser.add_argument("--tests", type=int, default=TESTS, help=f"test episodes ({TESTS})")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    try:
        folder = publish(arguments.run_dirs, arguments.name, arguments.out, arguments.tests)
    except TangramError as error:
        sys.stderr.write(f"pretrained: {error}\n")
        return 2
    sys.stdout.write(f"{folder}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
