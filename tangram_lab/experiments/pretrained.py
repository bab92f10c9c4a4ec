"""Making the agents that come with the package, from finished runs of several seeds.

`python -m tangram_lab.experiments.pretrained square runs/seeds/square/seed_*` puts the seed with
the median reward into `tangram_agent/pretrained/square`, with a card that tells the scores of all
seeds.
"""

import argparse
import hashlib
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
import torch
import yaml

from tangram_agent.checkpoints import load_checkpoint, newest_checkpoint
from tangram_agent.files import write_whole
from tangram_agent.pretrained import CARD, CARD_TEXT, CONFIG, WEIGHTS
from tangram_agent.runs import ACTING, CHECKPOINTS, Run, load_run
from tangram_lab.experiments.card import card_text, make_card
from tangram_sim.errors import ConfigError, RunError, TangramError
from tangram_sim.targets import has_all_tans
from worker.config import EvalConfig
from worker.evaluate import RUN, policies, score_policies, score_puzzles
from worker.puzzles import find_figures
from worker.test_set import greedy

PACKAGE = Path(__file__).resolve().parents[2] / "tangram_agent" / "pretrained"
RESULT = "result.json"
MAX_BYTES = 1_000_000  # of the weights: they travel with every installation
FIGURES, TURNS = ("test", "train"), 4  # splits of the library, and angles of each figure
TESTS, TEST_SEED = 400, 1  # tests that no choice was made on: training is scored on seed 0


@dataclass(frozen=True, eq=False)
class Candidate:
    """A finished run of one seed.

    Attributes:
        run: the run, with its final weights.
        result: content of its result.json.
    """

    run: Run
    result: dict[str, Any]


def publish(
    run_dirs: Sequence[Path], name: str, target: Path = PACKAGE, tests: int = TESTS
) -> Path:
    """Write the folder of an agent: the run of the median seed, and a card about all of them.

    The median is that of the final mean reward, the lower one of two; the best seed would promise
    more than another training gives.

    Args:
        run_dirs: finished runs of one setup, one for each seed.
        name: of the agent: small letters, digits and underscores.
        target: the agent's folder is made in here.
        tests: episodes that the chosen weights are scored on again, other ones than in training.

    Returns:
        The agent's folder.

    Raises:
        RunError: a run is not finished, not of the same setup, or its weights are too large.
        ConfigError: a name that cannot be one.
    """
    if not (name.isascii() and name.isidentifier() and name == name.lower()):
        raise ConfigError(f"name must be small letters, digits and _, got '{name}'")
    seeds = sorted((_read(path) for path in run_dirs), key=lambda one: int(one.result["seed"]))
    _check_one_setup(seeds)
    chosen = median(seeds)
    weights = _weights(chosen.run)
    config = EvalConfig(str(chosen.run.folder), episodes=tests, seed=TEST_SEED)
    setup = chosen.run.setup
    scores = score_policies(setup, policies(chosen.run, setup), config)
    card = make_card(name, chosen.run.setup, chosen.result, [one.result for one in seeds], scores)
    card |= {"tests": {"episodes": tests, "seed": TEST_SEED, "scores": scores}}
    if has_all_tans(setup.layout):
        card |= {"puzzles": {split: _on_figures(chosen.run, split) for split in FIGURES}}
    card |= {"sha256": hashlib.sha256(weights).hexdigest()}
    folder = target / name
    write_whole(folder / CONFIG, _config(chosen.run).encode())
    write_whole(folder / WEIGHTS, weights)
    write_whole(folder / CARD_TEXT, card_text(card).encode())
    write_whole(folder / CARD, (json.dumps(card, indent=1) + "\n").encode())
    return folder


def _on_figures(run: Run, split: str) -> dict[str, Any]:
    """Scores of a run on the figures of a split."""
    found = find_figures(split, run.setup, None, TURNS, False)
    players = {RUN: greedy(run.policy)}
    scores, _, _ = score_puzzles(run.setup, found.figures, players, TEST_SEED)
    return {"turns": TURNS, "scores": scores[RUN]}


def median(seeds: Sequence[Candidate]) -> Candidate:
    """The seed in the middle by its final mean reward; of two, the lower one."""
    ranked = sorted(seeds, key=lambda one: float(one.result["mean_reward"]))
    return ranked[(len(ranked) - 1) // 2]


def _read(run_dir: Path) -> Candidate:
    path = run_dir / RESULT
    try:
        result = json.loads(path.read_bytes())
    except (OSError, ValueError):
        raise RunError(f"cannot read {path}: name the folder of a finished run") from None
    if not isinstance(result, dict) or result.get("mean_reward") is None:
        raise RunError(f"{path} holds no mean_reward: train it with an evaluator")
    run = load_run(run_dir)
    if not result["scored_updates"] == result["updates"] == run.updates:
        raise RunError(
            f"{run_dir} was scored after {result['scored_updates']} of its {result['updates']} "
            f"updates and holds weights of {run.updates}: the scores must be those of the final "
            "weights, train it to its end"
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
                f"{one.run.folder} differs from {first.run.folder} in {', '.join(odd)}: the seeds "
                "of an agent share all settings"
            )
    numbers = [one.result["seed"] for one in seeds]
    if len(set(numbers)) < len(numbers):
        raise RunError(f"the runs are of the seeds {numbers}: name each seed once")


def _weights(run: Run) -> bytes:
    """The acting actor in float32, as safetensors."""
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


def _config(run: Run) -> str:
    """What makes the setup, every value written out; a run's config also names its machine."""
    return yaml.safe_dump(asdict(run.setup), sort_keys=False)


def main() -> int:
    """`python -m tangram_lab.experiments.pretrained NAME RUN_DIR...`."""
    program = "python -m tangram_lab.experiments.pretrained"
    parser = argparse.ArgumentParser(prog=program, description=__doc__)
    parser.add_argument("name", help="of the agent, as in pretrained/NAME")
    parser.add_argument("run_dirs", metavar="RUN_DIR", type=Path, nargs="+", help="one each seed")
    parser.add_argument("--out", type=Path, default=PACKAGE, help="where its folder is made")
    parser.add_argument("--tests", type=int, default=TESTS, help=f"scored again on ({TESTS})")
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
