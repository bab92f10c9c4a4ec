"""Policies to compare with: chance, the position-only oracle, the formula, the world's oracle.

Legend: B environments, K tokens, V corners, A entries of an action.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tangram_sim.actions import action_size, make_actions, velocities_of
from tangram_sim.actuation import full_scale, reach
from tangram_sim.arrays import Bools, Floats, Ints, Singles
from tangram_sim.batch import BatchedEnv
from tangram_sim.config import SimConfig
from tangram_sim.geometry import outlines, shared_areas
from tangram_sim.layout import Layout
from tangram_sim.world import make_world
from worker.pairing import Pairing, paired
from worker.rollout import Choose, Generators

_PROBES = 257  # commands that the engine is tried with


@dataclass(frozen=True, eq=False)
class Told:
    """A policy that is told the world: it is made for the environments in which it plays."""

    of: Callable[[BatchedEnv], Choose]


Player = Choose | Told


def playing(player: Player, env: BatchedEnv) -> Choose:
    """The policy, told the world if it asks for that."""
    return player.of(env) if isinstance(player, Told) else player


def random_policy(layout: Layout, sim: SimConfig) -> Choose:
    """Chance: of one token every entry uniform in [-1, 1].

    Of several, any that is left goes to any pose with its centre in the arena: uniform entries
    would mostly name a placed token, or throw it out of the arena.
    """
    size = action_size(layout.tokens, sim)

    def choose(corners: Floats, placed: Bools, _goals: Floats, generators: Generators) -> Singles:
        drawn = np.array([generator.uniform(-1.0, 1.0, size) for generator in generators])
        if layout.tokens == 1:
            return drawn.astype(np.float32)
        token = np.array([_any_left(row, rng) for row, rng in zip(placed, generators, strict=True)])
        pose = drawn[:, -3:] * (sim.arena / 2.0, sim.arena / 2.0, np.pi)
        way = pose - layout.poses(corners)[np.arange(len(token)), token]
        flip = (drawn[:, -4] > 0.0) & layout.chiral[token]  # read with sim.allow_flip only
        return _actions(sim, layout, token, way, flip)

    return choose


def position_policy(layout: Layout, sim: SimConfig) -> Choose:
    """Token after token exactly onto the centre of its own target, and never turned.

    A square moved so overlaps by 0.8825 on average: that is the plateau of the paper's Table II.
    """

    def choose(corners: Floats, placed: Bools, goals: Floats, _generators: Generators) -> Singles:
        token = np.argmin(placed, axis=1)
        way = (layout.poses(goals) - layout.poses(corners))[np.arange(len(token)), token]
        way[:, 2] = 0.0
        return _actions(sim, layout, token, way, np.zeros(len(token), dtype=np.bool_))

    return choose


def exact_policy(layout: Layout, sim: SimConfig) -> Choose:
    """Each token exactly onto a piece of its shape as it is seen, by the smallest turn that fits.

    Equal tokens share the pieces by the least way in all. Next is the one whose place is covered
    least by others. What remains to a perfect score is the world's: places that cover each other in
    a circle, float32 actions, and the engine's arithmetic.
    """

    def choose(corners: Floats, placed: Bools, goals: Floats, _generators: Generators) -> Singles:
        pairing = paired(layout, corners, goals)
        token = _freest(layout, corners, placed, goals, pairing)
        rows = np.arange(len(token))
        way, flip = pairing.way[rows, token], pairing.other_side[rows, token]
        return _actions(sim, layout, token, way, flip)

    return choose


def oracle_policy(env: BatchedEnv) -> Choose:
    """As `exact_policy`, told the world that each episode has: its gain, bias, drift and damping.

    Each action gives the command that ends nearest to the piece, also the long way round where the
    world turns further that way. With a delay it is chosen for where the action before will have
    taken the tokens. What the engine makes of a command is tried once for each damping.
    """
    layout, sim, world, engine = env.layout, env.sim, env.actuation, _Engine(env)

    def choose(corners: Floats, placed: Bools, goals: Floats, _generators: Generators) -> Singles:
        ahead = _ahead(env, engine, corners)
        pairing = paired(layout, ahead, goals)
        token = _freest(layout, ahead, placed, goals, pairing)
        rows = np.arange(len(token))
        way, flip = pairing.way[rows, token], pairing.other_side[rows, token]
        whole = 2.0 * np.pi / layout.symmetries[token]
        found = []
        for turns in (0.0, -1.0, 1.0):
            wanted = way.copy()
            wanted[:, 2] += turns * whole
            command = world.commands(engine.inverse(wanted, world.damping))
            moved = engine(world.told(command * full_scale(sim)), world.damping)
            found.append((np.round(np.abs(moved - wanted)[:, 2], 9), command))
        nearest = np.argmin([rest for rest, _ in found], axis=0)
        velocity = np.stack([command for _, command in found])[nearest, rows]
        return make_actions(token, velocity, flip, layout.tokens, sim)

    return choose


class _Engine:
    """The way that a lifted token goes where it is told a velocity, and the other way round.

    Damping and few steps of the engine shorten a shift by a law of its length, and a turn by one of
    its angle. Both are tried with a token alone. A token that slides is led all the way.
    """

    def __init__(self, env: BatchedEnv) -> None:
        sim = env.sim
        self._tried = sim.backend == "physics" and sim.motion == "lift"
        if self._tried:
            self._world = make_world(Layout(env.layout.shapes[:1]), replace(sim, pixels=0))
        x, y, turn = reach(sim)
        most = np.array([sim.arena * np.hypot(x, y), np.pi * turn])
        self._told = np.linspace(0.0, most, _PROBES)
        self._known: dict[float, Floats] = {}

    def __call__(self, told: Floats, damping: Floats) -> Floats:
        """Ways (B, 3) of what is told, (B, 3); the turn may be more than a whole one."""
        return self._mapped(told, damping, forth=True)

    def inverse(self, ways: Floats, damping: Floats) -> Floats:
        """What is to be told (B, 3) for ways (B, 3), or for the nearest that there are."""
        return self._mapped(ways, damping, forth=False)

    def _mapped(self, given: Floats, damping: Floats, *, forth: bool) -> Floats:
        if not self._tried:
            return given
        mapped = np.empty_like(given)
        for b, row in enumerate(given):
            tables = zip(self._told.T, self._ways(float(damping[b])).T, strict=True)
            shift, turn = (self._pair(*table, forth=forth) for table in tables)
            length = np.hypot(*row[:2])
            mapped[b, :2] = row[:2] * (np.interp(length, *shift) / length if length else 1.0)
            mapped[b, 2] = np.sign(row[2]) * np.interp(abs(row[2]), *turn)
        return mapped

    def _pair(self, told: Floats, way: Floats, *, forth: bool) -> tuple[Floats, Floats]:
        """What is known, growing, and what it is mapped to."""
        if forth:
            return told, way
        grows = int(np.argmax(way)) + 1  # beyond, a larger command goes less far
        return way[:grows], told[:grows]

    def _ways(self, damping: float) -> Floats:
        """(P, 2) length and angle of what the engine makes of each of `_told`."""
        if damping not in self._known:
            self._world.damp(damping)
            poses = np.empty((_PROBES, 3))
            for i, (shift, turn) in enumerate(self._told):
                self._world.place(np.zeros((1, 3)))
                self._world.move(0, np.array([shift, 0.0, turn]))
                poses[i] = self._world.poses()[0]
            self._known[damping] = np.column_stack([poses[:, 0], np.unwrap(poses[:, 2])])
        return self._known[damping]


def _ahead(env: BatchedEnv, engine: _Engine, corners: Floats) -> Floats:
    """Corners (B, V, 2) as the action before will leave them, which is carried out first."""
    late = env.actuation.pending
    if late is None:
        return corners
    layout, rows = env.layout, np.flatnonzero(~late.idle)
    poses, sides, tokens = layout.poses(corners), layout.flipped(corners), late.tokens[rows]
    way = engine(env.actuation.told(late.velocity), env.actuation.damping)
    poses[rows, tokens] += way[rows]
    sides[rows, tokens] ^= late.flip[rows]
    return layout.corners(poses, sides)


def _any_left(placed: Bools, generator: np.random.Generator) -> int:
    """One of the tokens that are not placed (K,), or any if all are."""
    left = np.flatnonzero(~np.asarray(placed, dtype=np.bool_))
    return int(generator.choice(left if len(left) else len(placed)))


def _freest(
    layout: Layout, corners: Floats, placed: Bools, goals: Floats, pairing: Pairing
) -> Ints:
    """(B,) the token left whose place the others cover least; the first of several."""
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
