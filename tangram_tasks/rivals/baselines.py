"""Three baselines: random actions, the position-only oracle and the exact oracle.

Legend: B environments, K tokens, V corners, A entries of an action.
"""

import numpy as np

from tangram_core.arrays import Bools, Floats, Ints, Singles
from tangram_core.spec import Arrays
from tangram_core.task import Chooser, Generators, History
from tangram_sim.config import SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import outlines, shared_areas
from tangram_sim.motion.actions import action_size, make_actions, velocities_of
from tangram_tasks.pairing import Pairing, paired
from tangram_tasks.played import as_seen


def random_policy(layout: Layout, sim: SimConfig) -> Chooser:
    """Random actions: with one token, every entry is uniform in [-1, 1].

    With several, a random token that is left goes to a random pose with its centre in the arena.
    Uniform entries would mostly choose a placed token, or throw it out of the arena.
    """
    size = action_size(layout.tokens, sim)

    def choose(seen: Arrays, _past: History, generators: Generators) -> Singles:
        corners, placed, _goals = as_seen(seen)
        drawn = np.array([generator.uniform(-1.0, 1.0, size) for generator in generators])
        if layout.tokens == 1:
            return drawn.astype(np.float32)
        token = np.array([_any_left(row, rng) for row, rng in zip(placed, generators, strict=True)])
        pose = drawn[:, -3:] * (sim.arena / 2.0, sim.arena / 2.0, np.pi)
        way = pose - layout.poses(corners)[np.arange(len(token)), token]
        flip = (drawn[:, -4] > 0.0) & layout.chiral[token]  # read with sim.allow_flip only
        return _actions(sim, layout, token, way, flip)

    return choose


def position_policy(layout: Layout, sim: SimConfig) -> Chooser:
    """Move each token exactly onto the centre of its own target, without a turn.

    A square moved in this way overlaps by 0.8825 on average, the plateau of the paper's Table II.
    """

    def choose(seen: Arrays, _past: History, _generators: Generators) -> Singles:
        corners, placed, goals = as_seen(seen)
        token = np.argmin(placed, axis=1)
        way = (layout.poses(goals) - layout.poses(corners))[np.arange(len(token)), token]
        way[:, 2] = 0.0
        return _actions(sim, layout, token, way, np.zeros(len(token), dtype=np.bool_))

    return choose


def exact_policy(layout: Layout, sim: SimConfig) -> Chooser:
    """Move each token exactly onto an observed piece of its shape, by the smallest turn.

    Equal tokens share the pieces so that the sum of ways is least. The next token is the one whose
    place others cover least. The score is not perfect for three reasons: tokens may lie on each
    other's places in a circle, actions are float32, and the engine rounds.
    """

    def choose(seen: Arrays, _past: History, _generators: Generators) -> Singles:
        corners, placed, goals = as_seen(seen)
        pairing = paired(layout, corners, goals)
        token = freest(layout, corners, placed, goals, pairing)
        rows = np.arange(len(token))
        way, flip = pairing.way[rows, token], pairing.other_side[rows, token]
        return _actions(sim, layout, token, way, flip)

    return choose


def _any_left(placed: Bools, generator: np.random.Generator) -> int:
    """A random token that is not placed (K,), or any if all are."""
    left = np.flatnonzero(~np.asarray(placed, dtype=np.bool_))
    return int(generator.choice(left if len(left) else len(placed)))


def freest(layout: Layout, corners: Floats, placed: Bools, goals: Floats, pairing: Pairing) -> Ints:
    """(B,) the remaining token whose place others cover least; the first in a tie."""
    rows, every = np.arange(len(corners))[:, None], np.arange(layout.tokens)
    places = outlines(goals, layout)[rows, pairing.target]
    shared = shared_areas(places, outlines(corners, layout))
    shared[:, every, every] = 0.0
    covered = shared.sum(axis=2) / layout.areas
    # Rounding must not decide between places that are free.
    blocked = np.where(placed, np.inf, np.round(covered, 6))
    freest: Ints = np.argmin(blocked, axis=1)
    return freest


def _actions(sim: SimConfig, layout: Layout, token: Ints, way: Floats, flip: Bools) -> Singles:
    """Actions (B, A) that take tokens (B,) along ways (B, 3), turned over where flip (B,) says."""
    return make_actions(token, velocities_of(way, sim), flip, layout.tokens, sim)
