"""Six agents train twenty updates in lockstep and come to the numbers that they always came to.

`python -m tests.experiments.test_fingerprints` writes the numbers anew, after a change that is to
train otherwise. Processors round otherwise, so a tolerance stands beside each number. It is
derived: the same training is begun twelve times with weights that are moved by one part in 2^22,
four times the spacing of float32, and the tolerance is four times the farthest that a number went,
or what twenty updates come to that each round it so, if that is more.
"""

import json
import math
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch

from conf.cli import composed
from master.learn.trainer import Trainer
from tangram_core.setup import Setup, make_setup
from worker.play.rollout import Rollout

FILE = Path(__file__).parents[1] / "golden" / "fingerprints.json"
UPDATES = 20
SHORT = {
    "batch_size": 16,
    "learning_starts": 16,
    "replay_capacity": 256,
    "updates_per_transition": 2.0,
}
SEED, ENVS, BATCH_EPISODES = 0, 4, 4
PERTURBED, STEP, MARGIN = 12, 2.0**-22, 4.0
AGENTS = {
    "paper": (
        *("agent=paper", "net=mha_small", "agent.actor_delay=3"),
        *("sim=paper", "sim.pixels=64", "reward.source=camera"),
    ),
    "perceptron": ("agent=mlp", "agent.actor_delay=3"),
    "pairs": ("agent=tangram",),
    "seven": ("agent=tangram", "tokens=tangram7", "net=mlp_pairs"),
    "outline": ("task=fill", "agent=outline", "tokens=tangram7", "sim=silhouette"),
    "pictures": (
        "agent=tangram",
        "tokens=large_triangle",  # a square is seen alike at four angles: rounding chooses one
        "sim.observe=pictures",
        "sim.pixels=64",
    ),
}
pytestmark = pytest.mark.slow

Tensors = Mapping[str, npt.NDArray[Any]]


def setup_of(name: str) -> Setup:
    """An agent with small batches, that begins to learn soon."""
    setup = make_setup(composed("train", ["run_dir=x", *AGENTS[name]]))
    return with_agent(setup, **SHORT)


def with_agent(setup: Setup, **settings: Any) -> Setup:
    """Learned otherwise."""
    config = replace(setup.agent.config, **settings)
    return replace(setup, agent=replace(setup.agent, config=config))


def total(arrays: Iterable[npt.NDArray[Any]]) -> float:
    """Of all values without their signs."""
    return math.fsum(float(np.abs(one.astype(np.float64)).sum()) for one in arrays)


def fingerprint(setup: Setup, moved_by: int | None = None) -> dict[str, float]:
    """Sums over the weights after the updates, over how far they went, and the mean losses.

    Args:
        setup: what is trained.
        moved_by: a seed, to begin with weights that are moved by a rounding error or four.
    """
    torch.set_num_threads(1)
    trainer, actor = Trainer(setup, SEED, "cpu"), setup.agent.actor(setup.task)
    if moved_by is not None:
        generator = torch.Generator().manual_seed(moved_by)
        with torch.no_grad():
            for weights in every_weight(trainer):
                noise = torch.rand(weights.shape, generator=generator) * 2.0 - 1.0
                weights.mul_(1.0 + STEP * noise)
    first = trainer.learner.export()
    losses: dict[str, list[float]] = {}
    with closing(setup.task.make(ENVS)) as env:
        rollout = Rollout(env, setup.spec, SEED, "player", 0, 0)
        while trainer.updates < UPDATES:
            actor.load(trainer.weights().tensors)
            trainer.insert(rollout.play(actor.act, BATCH_EPISODES // ENVS))
            while trainer.rate_limiter.may_update() and trainer.updates < UPDATES:
                for name, loss in trainer.update(trainer.updates / UPDATES).items():
                    losses.setdefault(name, []).append(loss)
    last = trainer.learner.export()
    went = (last[name].astype(np.float64) - first[name] for name in last)
    found = {"weights": total(last.values()), "moved": total(went)}
    return found | {name: math.fsum(losses[name]) / UPDATES for name in ("critic_loss", "q")}


def every_weight(trainer: Trainer) -> list[torch.Tensor]:
    """Of actor, critic and what else learns."""
    lists = trainer.learner.lists
    return [one for name in sorted(lists) for one in lists[name]]


def derived(setup: Setup) -> dict[str, dict[str, float]]:
    """Each number and its tolerance."""
    now = fingerprint(setup)
    others = [fingerprint(setup, seed) for seed in range(PERTURBED)]
    return {
        name: {
            "value": value,
            "tolerance": max(
                MARGIN * max(abs(one[name] - value) for one in others), UPDATES * STEP * abs(value)
            ),
        }
        for name, value in now.items()
    }


@pytest.mark.parametrize("name", AGENTS)
def test_an_agent_trains_as_it_always_did(name: str) -> None:
    expected = json.loads(FILE.read_text())[name]
    found = fingerprint(setup_of(name))
    wrong = {
        key: f"{found[key]} and was {one['value']}, tolerance {one['tolerance']}"
        for key, one in expected.items()
        if not abs(found[key] - one["value"]) <= one["tolerance"]
    }
    assert wrong == {}


def test_a_thousandth_more_of_a_learning_rate_is_seen() -> None:
    expected = json.loads(FILE.read_text())["paper"]["moved"]
    setup = setup_of("paper")
    faster = with_agent(setup, actor_lr=setup.agent.config.actor_lr * 1.001)
    found = fingerprint(faster)["moved"]
    assert abs(found - expected["value"]) > expected["tolerance"]


if __name__ == "__main__":
    made = {name: derived(setup_of(name)) for name in AGENTS}
    FILE.write_text(json.dumps(made, indent=1) + "\n")
