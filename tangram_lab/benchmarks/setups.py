"""Setups of the presets, as the measurements use them."""

from contextlib import closing
from dataclasses import replace
from typing import Any, cast

import numpy as np

from conf.cli import composed
from tangram_agent.agents.goal.agent import Goal, GoalConfig
from tangram_agent.base.types import Transitions
from tangram_core.arrays import Singles
from tangram_core.setup import Setup, make_setup
from tangram_core.spec import Arrays, Episodes
from tangram_core.task import Generators, History
from tangram_sim.geometry.layout import TokensConfig
from tangram_tasks.place import Place
from tangram_tasks.register import SEVEN
from worker.play.rollout import Rollout


def preset(agent: str = "tangram") -> Setup:
    """What tangram-train makes of an agent's preset: one square, moved by PyBullet."""
    return make_setup(composed("train", ["run_dir=x", f"agent={agent}"]))


def robot(id: str, module: str, *told: str) -> Setup:  # noqa: A002 - as gymnasium calls it
    """A goal environment that a module registers, and what is told of its agent."""
    task = ["task=gym", f"task.id={id}", f"task.imports=[{module}]"]
    return make_setup(composed("train", ["run_dir=x", *task, *told]))


def goal_config(setup: Setup) -> GoalConfig:
    """What the goal agent of a setup is told."""
    return cast("Goal", setup.agent).config


def place(setup: Setup) -> Place:
    """The task of such a setup."""
    return cast("Place", setup.task)


def several(count: int) -> Setup:
    """The first tans of the game, each moved once, in the game's arena."""
    setup = preset()
    return replace(setup, task=replace(place(setup), tokens=TokensConfig(SEVEN[:count], 0.6)))


def with_agent(setup: Setup, **values: Any) -> Setup:
    """Another agent."""
    agent: Any = setup.agent
    return replace(setup, agent=replace(agent, config=replace(agent.config, **values)))


# Episodes and transitions of them


ENVS = 32


def played(setup: Setup, count: int) -> Episodes:
    """Episodes of random actions, tokens without an engine; `count` is a multiple of ENVS."""

    def choose(_seen: Arrays, _past: History, generators: Generators) -> Singles:
        size = setup.spec.action_size
        return np.array([g.uniform(-1.0, 1.0, size) for g in generators], np.float32)

    task = setup.task
    if isinstance(task, Place):
        task = task.with_sim(backend="kinematic")
    with closing(task.make(ENVS, "play")) as env:
        return Rollout(env, task.spec, 0, "player", 0, 0).play(choose, count // ENVS)


def random_transitions(setup: Setup, count: int) -> Transitions:
    """Transitions of the right shapes; nothing moves as it would."""
    rng, layout = np.random.default_rng(0), place(setup).layout
    corners, tokens = layout.corner_count, layout.tokens
    state, after, goal = rng.uniform(-1, 1, (3, count, corners, 2)).astype(np.float32)
    return Transitions(
        state=state,
        placed=np.zeros((count, tokens), np.uint8),
        action=rng.uniform(-1, 1, (count, setup.spec.action_size)).astype(np.float32),
        reward=rng.uniform(-1, 1, count).astype(np.float32),
        next_state=after,
        next_placed=np.ones((count, tokens), np.uint8),
        done=np.ones(count, np.uint8),
        goal=goal,
    )
