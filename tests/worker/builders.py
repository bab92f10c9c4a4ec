"""Policies and finished runs that the tests of the worker share."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tangram_core.agent import Weights
from tangram_core.arrays import Floats
from tangram_core.run.service import ServiceConfig
from tangram_core.setup import Setup, make_setup
from tangram_core.spec import Episodes
from tangram_core.store.checkpoints import save_checkpoint
from tangram_sim.geometry.layout import Layout
from tangram_tasks.played import Played
from tests.agent.builders import SMALL, SQUARE, Policy


def weights(made: Setup, version: int) -> Weights:
    """Random weights; every version has its own, and all of them move the tokens visibly."""
    return Weights(version, made.agent.learner(made.task, version, "cpu").export())


def sent(made: Setup, version: int) -> Weights:
    """What a master sends of them."""
    return Weights(version, made.agent.learner(made.task, version, "cpu").broadcast())


def policy(made: Setup, version: int = 1) -> Policy:
    """A policy with random weights."""
    acting = Policy(made)
    acting.load(weights(made, version).tensors)
    return acting


def write_run(folder: Path, tokens: dict[str, Any] = SQUARE, **sections: Any) -> Setup:
    """A run folder with one checkpoint of random weights, on the kinematic backend."""
    kind = sections.get("agent", {}).get("kind", "pair")
    config = {
        "task": {"kind": "fill" if kind == "outline" else "place"},
        "tokens": tokens,
        "sim": {"backend": "kinematic"},
        "reward": {},
        "agent": {"kind": kind},
        "net": SMALL,
        "service": asdict(ServiceConfig()),
    } | sections
    config["agent"] = {"kind": kind} | config["agent"]
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
        "coverage": np.zeros(count),
        "refused": np.zeros((count, steps), np.bool_),
        "blocked": np.zeros((count, steps), np.bool_),
        "seconds": np.ones(count),
        "chose": np.ones(count),
        "camera": None,
        "pictures": None,
    }
    travels = Episodes({name: more.get(name, column) for name, column in seen.items()})
    rest: dict[str, Any] = {name: more.get(name, column) for name, column in known.items()}
    return Played(episodes=travels, corners=corners, goals=goals, **rest)
