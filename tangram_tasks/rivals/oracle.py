"""The policy that is told the world: the bound of what agents can score in it.

Legend: B environments, K tokens, V corners.
"""

from typing import cast

import numpy as np

from tangram_core.arrays import Floats, Singles
from tangram_core.spec import Arrays
from tangram_core.task import Chooser, Env, Generators, History
from tangram_sim.batch import BatchedEnv
from tangram_sim.geometry.layout import Layout
from tangram_sim.motion.actions import make_actions
from tangram_sim.motion.actuation import Command, full_scale, reach
from tangram_sim.motion.kinematics import wrap
from tangram_sim.world.world import make_world
from tangram_tasks.env import PlaceEnv
from tangram_tasks.pairing import paired
from tangram_tasks.played import as_seen
from tangram_tasks.rivals.baselines import freest

_PROBES = 257  # commands that the engine is tried with
_SURPRISE = 5.0  # deviations beyond which something else has moved a token


def oracle_policy(of: Env) -> Chooser:
    """As `exact_policy`, told the world that each episode has: gain, bias, damping.

    Each action gives the command that ends nearest to the piece, also the long way round where the
    world turns further that way. With a delay it is chosen for where the action before will have
    taken the tokens. What the engine makes of a command is tried once for each damping.

    With noise on corners it goes by where the tokens are most likely to be, see `_Filter`.
    """
    env = cast("PlaceEnv", of).world
    layout, sim, world, engine = env.layout, env.sim, env.actuation, _Engine(env)
    tracker = _Filter(env, engine)

    def choose(seen: Arrays, _past: History, _generators: Generators) -> Singles:
        corners, placed, goals = as_seen(seen)
        poses, sides = tracker.follow(corners), layout.flipped(corners)
        if world.pending is not None:  # that comes first
            _carry(env, engine, world.pending, poses)
            rows = np.flatnonzero(~world.pending.idle)
            sides[rows, world.pending.tokens[rows]] ^= world.pending.flip[rows]
        ahead = layout.corners(poses, sides)
        pairing = paired(layout, ahead, goals)
        token = freest(layout, ahead, placed, goals, pairing)
        rows = np.arange(len(token))
        whole = 2.0 * np.pi / layout.symmetries[token]
        found = []
        for turns in (0.0, -1.0, 1.0):
            wanted = pairing.way[rows, token]
            wanted[:, 2] += turns * whole
            command = world.commands(engine.inverse(wanted, world.damping))
            moved = engine(world.told(command * full_scale(sim)), world.damping)
            found.append((np.round(np.abs(moved - wanted)[:, 2], 9), command))
        nearest = np.argmin([rest for rest, _ in found], axis=0)
        velocity = np.stack([command for _, command in found])[nearest, rows]
        return make_actions(token, velocity, pairing.other_side[rows, token], layout.tokens, sim)

    return choose


def _carry(env: BatchedEnv, engine: "_Engine", command: Command, poses: Floats) -> None:
    """Move poses (B, K, 3) as a command does, but for what meets."""
    way = engine(env.actuation.told(command.velocity), env.actuation.damping)
    rows = np.flatnonzero(~command.idle)
    poses[rows, command.tokens[rows]] += way[rows]


class _Filter:
    """Where tokens are most likely to be, by all corners and commands of the episode.

    A Kalman filter for x, y and angle of every token: predicted by what the command before makes in
    this world, and corrected by what is seen, each with the weight that its noise leaves it. Where
    the two are too far apart for noise, as another token pushed or the placement was blocked, what
    is seen counts alone. Without noise on corners it is what is seen.
    """

    def __init__(self, env: BatchedEnv, engine: "_Engine") -> None:
        self._env, self._engine = env, engine
        layout, sim = env.layout, env.sim
        noise = sim.corner_noise * sim.arena
        centre = (layout.base_weights**2).sum(axis=1)
        turn = 1.0 / np.add.reduceat((layout.body**2).sum(axis=1), layout.starts[:-1])
        # Variances (K, 3) of what is seen.
        self._seen = noise**2 * np.column_stack([centre, centre, turn])
        self._poses: Floats = np.zeros((env.count, layout.tokens, 3))
        self._variance = self._poses

    def follow(self, corners: Floats) -> Floats:
        """Poses (B, K, 3) after the last step, which shows corners (B, V, 2)."""
        env, shown, last = self._env, self._env.layout.poses(corners), self._env.actuation.carried
        if env.sim.corner_noise == 0.0:
            return shown
        fresh = np.full(shown.shape[:2], last is None)
        poses, variance = self._poses.copy(), self._variance
        if last is not None:
            _carry(env, self._engine, last, poses)
        off = shown - poses
        off[..., 2] = wrap(off[..., 2])
        both = variance + self._seen
        fresh |= (np.abs(off) > _SURPRISE * np.sqrt(both)).any(axis=2)
        weight = np.where(fresh[..., None], 1.0, variance / both)
        self._poses = poses + weight * off
        self._variance = np.where(fresh[..., None], self._seen, (1.0 - weight) * variance)
        return self._poses.copy()


class _Engine:
    """The way that a lifted token goes where it is told a velocity, and the other way round.

    Damping and few steps of the engine shorten a shift by a law of its length, and a turn by one of
    its angle. Both are tried with a token alone. A token that slides is led all the way.
    """

    def __init__(self, env: BatchedEnv) -> None:
        sim = env.sim
        self._tried = sim.backend == "physics" and sim.motion == "lift"
        if self._tried:
            self._world = make_world(Layout(env.layout.shapes[:1]), sim.blind)
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
