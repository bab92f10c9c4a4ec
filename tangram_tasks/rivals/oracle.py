"""The exact policy where corners are noisy: by where tokens are most likely to be.

Legend: B environments, K tokens, V corners.
"""

import numpy as np

from tangram_core.arrays import Floats, Singles
from tangram_core.spec import Arrays
from tangram_core.task import Chooser, Generators, History
from tangram_sim.config import SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.motion.actions import chosen_tokens, velocities
from tangram_sim.motion.kinematics import wrap
from tangram_tasks.played import as_seen
from tangram_tasks.rivals.baselines import exact_policy

_SURPRISE = 5.0  # deviations beyond which something else has moved a token


def oracle_policy(layout: Layout, sim: SimConfig) -> Chooser:
    """As `exact_policy`, by all corners and actions of the episode, see `_Filter`."""
    exact, tracker = exact_policy(layout, sim), _Filter(layout, sim)

    def choose(seen: Arrays, past: History, generators: Generators) -> Singles:
        corners, *_ = as_seen(seen)
        likely = layout.corners(tracker.follow(corners, past), layout.flipped(corners))
        return exact({**seen, "corners": likely}, past, generators)

    return choose


class _Filter:
    """Where tokens are most likely to be, by all corners and actions of the episode.

    A Kalman filter for x, y and angle of every token: predicted by what the action before says, and
    corrected by what is seen, each with the weight that its noise leaves it. Where the two are too
    far apart for noise, as another token pushed or the action was refused or blocked, what is seen
    counts alone.
    """

    def __init__(self, layout: Layout, sim: SimConfig) -> None:
        self._layout, self._sim = layout, sim
        noise = sim.corner_noise * sim.arena
        centre = (layout.base_weights**2).sum(axis=1)
        turn = 1.0 / np.add.reduceat((layout.body**2).sum(axis=1), layout.starts[:-1])
        # Variances (K, 3) of what is seen.
        self._seen = noise**2 * np.column_stack([centre, centre, turn])
        self._poses: Floats = np.zeros((0, layout.tokens, 3))
        self._variance = self._poses

    def follow(self, corners: Floats, past: History) -> Floats:
        """Poses (B, K, 3) after the last step, which shows corners (B, V, 2)."""
        shown = self._layout.poses(corners)
        if not past.actions.shape[1]:
            self._poses, self._variance = shown, np.broadcast_to(self._seen, shown.shape)
            return shown
        last = np.clip(past.actions[:, -1].astype(np.float64), -1.0, 1.0)
        poses, token = self._poses.copy(), chosen_tokens(last, self._layout.tokens)
        poses[np.arange(len(last)), token] += velocities(last, self._sim)
        off = shown - poses
        off[..., 2] = wrap(off[..., 2])
        both = self._variance + self._seen
        fresh = (np.abs(off) > _SURPRISE * np.sqrt(both)).any(axis=2, keepdims=True)
        weight = np.where(fresh, 1.0, self._variance / both)
        self._poses = poses + weight * off
        self._variance = np.where(fresh, self._seen, (1.0 - weight) * self._variance)
        return self._poses
