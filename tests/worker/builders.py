"""Policies and finished runs that the tests of the worker share."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tangram_agent.agents.outline.filling_learner import FillLearner
from tangram_agent.checkpoints import save_checkpoint
from tangram_agent.config import ServiceConfig
from tangram_agent.learner import Learner
from tangram_agent.networks import travelling
from tangram_agent.policy import Policy
from tangram_agent.setup import Setup, make_setup
from tangram_agent.types import Weights
from tangram_core.arrays import Floats
from tangram_core.spec import Episodes
from tangram_sim.geometry.layout import Layout
from tests.agent.builders import SMALL, SQUARE
from worker.play.rollout import Played


def weights(made: Setup, version: int) -> Weights:
    """Random weights; every version has its own, and all of them move the tokens visibly."""
    learner = FillLearner if made.fills else Learner
    return learner(made, seed=version).acting_weights(version)


def sent(made: Setup, version: int) -> Weights:
    """What a master sends of them."""
    return travelling(weights(made, version), made)


def policy(made: Setup, version: int = 1) -> Policy:
    """A policy with random weights."""
    acting = Policy(made)
    acting.load(weights(made, version))
    return acting


def write_run(folder: Path, tokens: dict[str, Any] = SQUARE, **sections: Any) -> Setup:
    """A run folder with one checkpoint of random weights, on the kinematic backend."""
    config = {
        "tokens": tokens,
        "sim": {"backend": "kinematic"},
        "reward": {},
        "agent": {},
        "net": SMALL,
        "service": asdict(ServiceConfig()),
    } | sections
    made = make_setup(config)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    arrays = {"weights": weights(made, 1).tensors, "learner": {"updates": np.array([7])}}
    save_checkpoint(folder / "checkpoints", 7, arrays, {}, keep=1)
    return made


def ended(layout: Layout, corners: Floats, goals: Floats, **more: Any) -> Played:
    """Episodes that were at corners (E, T + 1, V, 2), as if every action had been taken.

    Args:
        more: other columns of `Played`, and of its episodes.
    """
    count, steps = len(corners), corners.shape[1] - 1
    seen = {
        "corners": corners.astype(np.float32),
        "placed": np.zeros((count, steps + 1, layout.tokens), np.uint8),
        "actions": np.zeros((count, steps, 4), np.float32),
        "rewards": np.zeros((count, steps), np.float32),
        "goals": goals.astype(np.float32),
        "terminated": np.zeros((count, steps), np.uint8),
    }
    known = {
        "overlap": np.zeros(count),
        "refused": np.zeros((count, steps), np.bool_),
        "blocked": np.zeros((count, steps), np.bool_),
        "seconds": np.ones(count),
        "slowest": np.ones(count),
        "camera": None,
        "pictures": None,
    }
    travels = Episodes({name: more.get(name, column) for name, column in seen.items()})
    rest: dict[str, Any] = {name: more.get(name, column) for name, column in known.items()}
    return Played(episodes=travels, corners=corners, goals=goals, **rest)
