"""Setups, episodes and transitions for the measurements."""

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
    """The setup of tangram-train with the preset of an agent: one square, moved by PyBullet."""
    return make_setup(composed("train", ["run_dir=x", f"agent={agent}"]))


def robot(id: str, module: str, *told: str) -> Setup:  # noqa: A002 - as gymnasium calls it
    """The setup of a goal environment that a module registers; `told` are more settings."""
    task = ["task=gym", f"task.id={id}", f"task.imports=[{module}]"]
    return make_setup(composed("train", ["run_dir=x", *task, *told]))


def goal_config(setup: Setup) -> GoalConfig:
    """The configuration of the goal agent in a setup."""
    return cast("Goal", setup.agent).config


def place(setup: Setup) -> Place:
    """The task of a setup whose task is Place."""
    return cast("Place", setup.task)


def several(count: int) -> Setup:
    """The setup of a task with the first `count` tans, in the arena of the game."""
    setup = preset()
    return replace(setup, task=replace(place(setup), tokens=TokensConfig(SEVEN[:count], 0.6)))


def with_agent(setup: Setup, **values: Any) -> Setup:
    """The same setup, with other values in the configuration of its agent."""
    agent: Any = setup.agent
    return replace(setup, agent=replace(agent, config=replace(agent.config, **values)))


# Episodes and transitions


ENVS = 32


def played(setup: Setup, count: int) -> Episodes:
    """Play `count` episodes (a multiple of ENVS) of random actions, without a physics engine."""

    def choose(_seen: Arrays, _past: History, generators: Generators) -> Singles:
        size = setup.spec.action_size
        return np.array([g.uniform(-1.0, 1.0, size) for g in generators], np.float32)

    task = setup.task
    if isinstance(task, Place):
        task = task.with_sim(backend="kinematic")
    with closing(task.make(ENVS, "play")) as env:
        return Rollout(env, task.spec, 0, "player", 0, 0).play(choose, count // ENVS)


def random_transitions(setup: Setup, count: int) -> Transitions:
    """Random transitions with the right shapes; they do not obey the simulation."""
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
