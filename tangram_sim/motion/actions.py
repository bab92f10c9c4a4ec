"""Encoding of actions, their number in an episode, and bounds of the motion.

Legend: B actions of A entries each, K tokens.
"""

import numpy as np

from tangram_core.arrays import Bools, Floats, Ints, Singles
from tangram_sim.config import SILHOUETTE, SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.motion.kinematics import wrap

_ROUNDING = 1.0 + 1e-6


def action_size(tokens: int, sim: SimConfig) -> int:
    """A, the size of an action: the token (if several), the flip (if allowed), 3 velocities."""
    return 3 + (tokens > 1) + sim.allow_flip


def horizon(tokens: int, sim: SimConfig) -> int:
    """T, the number of actions in an episode: `actions_per_token` for each token."""
    return tokens * sim.actions_per_token


def full_scale(sim: SimConfig) -> Floats:
    """(3,) the velocity for an entry of 1: the arena's width in x and y, half a turn (rad)."""
    return np.array([sim.arena, sim.arena, np.pi])


def corner_bound(tokens: int, sim: SimConfig) -> float:
    """The largest |coordinate| that a corner can reach in an episode, arena units.

    A token starts inside the arena at every angle, or, with `sim.overhang`, with its centre inside.
    Each action moves it in x and y by at most the arena's width. Tokens that are pushed apart move
    by less than one more width. With pictures, only the centre of a found token is sure to lie in
    the arena. A missing token is assumed to have moved as commanded.
    """
    inside = 1.0 if sim.looks or sim.overhang else 0.5
    moved = sim.actions_per_token + (tokens > 1)
    return sim.arena * (inside + moved) * _ROUNDING


def goal_rows(layout: Layout, sim: SimConfig) -> int:
    """G, the rows of a target as agents see it: corners of its pieces, or of their outline.

    An outline has at most as many corners as its pieces, and one more row per ring, see `rings`.
    """
    if sim.observe != SILHOUETTE:
        return layout.corner_count
    return layout.corner_count + layout.tokens


def chosen_tokens(actions: Floats, tokens: int) -> Ints:
    """(B,) the token that each action (B, A) names by its first entry: [-1, 1] in K equal parts."""
    if tokens == 1:
        return np.zeros(len(actions), dtype=np.int64)
    share = (np.asarray(actions)[:, 0] + 1.0) / 2.0
    return np.clip(np.floor(share * tokens), 0, tokens - 1).astype(np.int64)


def velocities(actions: Floats, sim: SimConfig) -> Floats:
    """Velocities (B, 3) of actions (B, A), in arena units and radians per second.

    At full scale one action crosses the arena and makes half a turn, so it can reach every pose.
    """
    scaled: Floats = np.asarray(actions, dtype=np.float64)[:, -3:] * full_scale(sim)
    return scaled


def flips(actions: Floats, layout: Layout, sim: SimConfig) -> Bools:
    """(B,) which actions (B, A) turn their token over: the entry before the velocities is > 0.

    A token that is not chiral never flips: turning it over looks like a rotation.
    """
    if not sim.allow_flip:
        return np.zeros(len(actions), dtype=np.bool_)
    chiral = layout.chiral[chosen_tokens(actions, layout.tokens)]
    return np.asarray((np.asarray(actions)[:, -4] > 0.0) & chiral)


def velocities_of(ways: Floats, sim: SimConfig) -> Floats:
    """Entries (B, 3) of actions for shifts and rotations (B, 3), arena units and radians.

    The inverse of `velocities`, with the shorter way round. A shift beyond the arena's width gives
    entries beyond [-1, 1].
    """
    shortest = np.column_stack([ways[:, :2], wrap(ways[:, 2])])
    velocity: Floats = shortest / full_scale(sim)
    return velocity


def make_actions(
    token: Ints, velocity: Floats | Singles, flip: Bools, tokens: int, sim: SimConfig
) -> Singles:
    """Actions (B, A) as `chosen_tokens`, `velocities` and `flips` read them.

    Args:
        token: (B,) number of the token that moves; ignored if there is only one.
        velocity: (B, 3) in [-1, 1].
        flip: (B,) whether the token is turned over; ignored without `sim.allow_flip`.
        tokens: K.
        sim: settings of the world, for `sim.allow_flip`.
    """
    parts: list[Floats | Singles] = []
    if tokens > 1:
        # The middle of the token's part of [-1, 1].
        parts.append(((2.0 * token + 1.0) / tokens - 1.0)[:, None])
    if sim.allow_flip:
        parts.append(np.where(flip, 1.0, -1.0)[:, None])
    actions: Singles = np.concatenate([*parts, velocity], axis=1).astype(np.float32)
    return actions
