"""Hindsight experience replay (Sec. III-B): what was played, and twins with other goals.

Legend: E episodes, T steps, B = E * T transitions, K tokens, V corners.
"""

from collections.abc import Callable

import numpy as np

from tangram_agent.config import TwinConfig
from tangram_agent.types import Episodes, Transitions
from tangram_sim.arrays import Floats, Singles
from tangram_sim.layout import Layout

# (achieved corners (B, V, 2), desired corners (B, V, 2)) -> rewards (B,)
RewardFunction = Callable[[Floats, Floats], Floats]


def flatten(episodes: Episodes) -> Transitions:
    """The transitions as they were played, episode after episode."""
    goals = np.repeat(episodes.goals, episodes.steps, axis=0)
    return _transitions(episodes, goals, episodes.rewards.reshape(-1))


def with_twins(
    episodes: Episodes,
    twins: tuple[TwinConfig, ...],
    layout: Layout,
    reward: RewardFunction,
    generator: np.random.Generator,
) -> Transitions:
    """The transitions played, followed by those of every twin; rewards and ends are recomputed."""
    goals = [
        _goals(episodes, twin, layout, generator)
        for twin in twins
        for _ in range(twin.copies if twin.strategy != "none" else 0)
    ]
    if not goals:
        return flatten(episodes)
    # The rewards of all twins at once: each call costs about as much as a hundred of them.
    achieved = episodes.corners[:, 1:].reshape(goals[0].shape).astype(np.float64)
    desired = np.concatenate(goals).astype(np.float64)
    rewards = reward(np.concatenate([achieved] * len(goals)), desired).astype(np.float32)
    parts = zip(goals, np.split(rewards, len(goals)), strict=True)
    twin_batches = [_transitions(episodes, goal, part) for goal, part in parts]
    return _concatenate([flatten(episodes), *twin_batches])


def _goals(
    episodes: Episodes, twin: TwinConfig, layout: Layout, generator: np.random.Generator
) -> Singles:
    """Goals (B, V, 2) of one twin.

    final: the state in which the episode ended (the paper). future: a state reached at this step
    or later, drawn uniformly. near: the final poses, each moved a little; with one action per
    episode every plain twin scores the most there is, so only near misses teach the slope.
    """
    count, steps = episodes.count, episodes.steps
    if twin.strategy == "future":
        step = np.arange(steps)
        later = generator.integers(step + 1, steps + 1, size=(count, steps))
        chosen = episodes.corners[np.arange(count)[:, None], later]
        return chosen.reshape(-1, *chosen.shape[2:])
    final = np.repeat(episodes.corners[:, -1], steps, axis=0)
    if twin.strategy == "final":
        return final
    exact = final.astype(np.float64)
    poses = layout.poses(exact)
    spread = np.array([twin.position, twin.position, twin.angle])
    poses += generator.standard_normal(poses.shape) * spread
    return layout.corners(poses, layout.flipped(exact)).astype(np.float32)


def _transitions(episodes: Episodes, goals: Singles, rewards: Singles) -> Transitions:
    count, steps = episodes.count, episodes.steps
    done = np.zeros((count, steps), dtype=np.uint8)
    done[:, -1] = 1
    size = count * steps
    return Transitions(
        state=episodes.corners[:, :-1].reshape(size, *episodes.corners.shape[2:]),
        placed=episodes.placed[:, :-1].reshape(size, -1),
        action=episodes.actions.reshape(size, -1),
        reward=rewards,
        next_state=episodes.corners[:, 1:].reshape(size, *episodes.corners.shape[2:]),
        next_placed=episodes.placed[:, 1:].reshape(size, -1),
        done=done.reshape(size),
        goal=goals,
    )


def _concatenate(batches: list[Transitions]) -> Transitions:
    columns = {name: [getattr(batch, name) for batch in batches] for name in vars(batches[0])}
    return Transitions(**{name: np.concatenate(parts) for name, parts in columns.items()})
