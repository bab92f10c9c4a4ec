"""Hindsight experience replay (Sec. III-B): transitions with the goals that they reached.

If the critic learns the environment's reward, transitions are relabelled once, when episodes enter
the replay buffer. With agent=pair and several tokens the critic learns the area that a token covers
of one piece. That is known for any goal, so each update draws new goals for its pairs.

Legend: E episodes, T steps, B = E * T transitions, P pairs of each, M = B * P, K tokens, V corners.
"""

from collections.abc import Callable

import numpy as np

from tangram_agent.base.config import RelabelConfig
from tangram_agent.base.types import Transitions
from tangram_core.arrays import Floats, Singles
from tangram_core.spec import Episodes
from tangram_sim.geometry.layout import Layout

# (achieved corners (B, V, 2), desired corners (B, V, 2)) -> rewards (B,)
RewardFunction = Callable[[Floats, Floats], Floats]


def learnable(episodes: Episodes) -> Episodes:
    """The episodes in which all tokens and pieces were seen at all times.

    With several tokens, one that left the picture counts as seen where it was told to go: that is
    better than to lose an episode of many actions.
    """
    if "seen" not in episodes.arrays:
        return episodes
    whole = episodes["seen"].all(axis=(1, 2)) & episodes["goals_seen"].all(axis=1)
    return episodes.at(whole)


def flatten(episodes: Episodes) -> Transitions:
    """The played transitions, one episode after the other."""
    size = episodes.count * episodes.steps
    corners, placed = episodes["corners"], episodes["placed"]
    return Transitions(
        state=corners[:, :-1].reshape(size, *corners.shape[2:]),
        placed=placed[:, :-1].reshape(size, -1),
        action=episodes.actions.reshape(size, -1),
        reward=episodes.rewards.reshape(-1),
        next_state=corners[:, 1:].reshape(size, *corners.shape[2:]),
        next_placed=placed[:, 1:].reshape(size, -1),
        done=episodes.terminated.reshape(size),
        goal=np.repeat(episodes["goals"], episodes.steps, axis=0),
    )


def with_relabelled(
    episodes: Episodes,
    relabels: tuple[RelabelConfig, ...],
    layout: Layout,
    reward: RewardFunction,
    generator: np.random.Generator,
) -> Transitions:
    """The played transitions, followed by copies with each hindsight goal and its reward."""
    played = flatten(episodes)
    goals = [
        _goals(episodes, relabel, layout, generator)
        for relabel in relabels
        for _ in range(relabel.copies)
    ]
    if not goals:
        return played
    # One call for all goals: each call costs about as much as a hundred rewards.
    achieved = np.concatenate([played.next_state] * len(goals)).astype(np.float64)
    rewards = reward(achieved, np.concatenate(goals).astype(np.float64)).astype(np.float32)
    every = {n: np.concatenate([part] * (1 + len(goals))) for n, part in played.arrays.items()}
    every["goal"] = np.concatenate([played.goal, *goals])
    every["reward"] = np.concatenate([played.reward, rewards])
    return Transitions(**every)


def spread(relabel: RelabelConfig) -> tuple[float, float, float]:
    """Standard deviations of a goal's x, y and angle."""
    return relabel.position, relabel.position, relabel.angle


def _goals(
    episodes: Episodes, relabel: RelabelConfig, layout: Layout, generator: np.random.Generator
) -> Singles:
    """Goals (B, V, 2) of one kind.

    final: the state in which the episode ended (the paper). future: a state reached at this step
    or later, drawn uniformly. near: the final poses with noise; with one action per episode every
    exact goal has the highest reward, so only near misses show how it falls.
    """
    count, steps = episodes.count, episodes.steps
    if relabel.strategy == "future":
        step = np.arange(steps)
        later = generator.integers(step + 1, steps + 1, size=(count, steps))
        chosen = episodes["corners"][np.arange(count)[:, None], later]
        return chosen.reshape(-1, *chosen.shape[2:])
    final = np.repeat(episodes["corners"][:, -1], steps, axis=0)
    if relabel.strategy == "final":
        return final
    exact = final.astype(np.float64)
    poses = layout.poses(exact)
    poses += generator.standard_normal(poses.shape) * spread(relabel)
    return layout.corners(poses, layout.flipped(exact)).astype(np.float32)
