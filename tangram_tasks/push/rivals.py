"""Baselines that learned nothing: a table of pushes of single tokens, and planners that simulate.

The cost of a push is the number of pushes that the tokens need afterwards, each as if alone.
Collisions of finger and token with others on the way add to it. The table takes the push of least
estimated cost. A planner also simulates the best of them, in an engine of its own.

Legend: N pushes of a shape, n rows, K tokens, V corners, C corners of a token, m pushes.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tangram_core.arrays import AnyArray, Bools, Complex, Floats, Ints, Singles
from tangram_core.spec import Arrays
from tangram_core.task import Generators, History
from tangram_sim.world.pushing import Unknowns
from tangram_tasks.push.alone import after, moved_by, tried_alone, way_left
from tangram_tasks.push.order import come_next
from tangram_tasks.push.places import apart, on_table
from tangram_tasks.push.trials import Trials, middle

if TYPE_CHECKING:
    from tangram_tasks.push.env import PushEnv
    from tangram_tasks.push.task import Push

TRIED = 24  # pushes that are simulated for an action
LOOKED_AT, LENGTH = 48, 6  # pushes to estimate, half the best, half any; pushes in a row
PAIR = 2  # up to so many tokens, each may come first
SHARES = 1.0 / 3.0, 2.0 / 3.0, 1.0  # of a token's way, where collisions are checked
SLACK, SLOPE, HARDEST = 0.004, 40.0, 1.5  # depth without cost, cost of more depth, largest cost
NEVER, MOST = 100.0, 3.0  # cost of an impossible push; largest cost of an estimated collision
MARGIN = 0.5  # for `table`: cost of a token just within tolerance
AGAIN, REACH = 0.5, 0.1  # cost of a return to an earlier state; distance that counts as one
STILL = 1e-4  # corners that moved by less did not move
WRONG = 2.0  # factor by which planner_wrong errs about friction


class Planner:
    """A policy that looks up the effects of pushes on single tokens, and may simulate the best."""

    def __init__(self, task: "Push", env: "PushEnv", tried: int = 0, knows: str = "middle") -> None:
        """Simulate random pushes of each shape.

        Args:
            task: the task to play.
            env: its environments, which `knows="all"` asks for the hidden parameters.
            tried: pushes that are simulated for each action; 0: none.
            knows: assumed friction and centres of mass: middle (of their ranges), all (the true
                ones) or wrong (finger's friction and lever of the table's twice the middle).
        """
        self._middle, config, layout = middle(task), task.config, task.layout
        self._env, self._count, self._knows = env, tried, knows
        self._trials, self._task, self._layout = Trials(task), task, layout
        known = self._middle.finger, float(self._middle.spread[0])
        margin = 0.0 if tried else MARGIN
        ways = config.finger, config.longest, config.within, config.turned, margin
        found = [tried_alone(shape, known, *ways) for shape in layout.shapes]
        self._tried, self._left = [one for one, _ in found], [one for _, one in found]
        self._bodies = layout.body[layout.padded_corners] @ (1.0, 1j)

    def __call__(self, seen: Arrays, past: History, generators: Generators) -> Singles:
        """Actions (B, 4): for each table the push of least cost."""
        tables = range(len(generators))
        return np.stack([self._best(seen, past, table) for table in tables]).astype(np.float32)

    def _known(self, table: int) -> Unknowns:
        if self._knows == "all":
            return self._env.unknowns[table]
        own, times = self._middle, WRONG if self._knows == "wrong" else 1.0
        return replace(own, spread=own.spread * times, finger=own.finger * times)

    def _best(self, seen: Arrays, past: History, table: int) -> Floats:
        corners, goals, before = (
            np.asarray(one[table], np.float64)
            for one in (seen["corners"], seen["goals"], past.seen["corners"])
        )
        here = np.abs(before[:-1] - corners).max(axis=(1, 2)) < STILL
        found, following = self._proposed(corners, goals, past.actions[table][here])
        if not self._count or not len(found):
            return np.asarray(found[0] if len(found) else np.zeros(4))
        self._trials.begin(corners, goals, self._known(table))
        ends = [(one, self._trials.after(one)) for one in found]
        played = [(one, end) for one, end in ends if end is not None]
        if not played:
            return np.asarray(found[0])
        laid = np.stack([end for _, end in played])
        placed = self._task.placed(laid, np.broadcast_to(goals, laid.shape)).sum(axis=1)
        home = placed > self._task.placed(corners[None], goals[None]).sum()
        off = np.abs(laid[:, None] - before).max(axis=(2, 3))
        again = AGAIN * (1.0 - off / REACH).clip(0.0).sum(axis=1)
        left = self._worth(laid, goals, following) + np.where(home, 0.0, again)
        return np.asarray(played[int(left.argmin())][0])

    def _proposed(self, corners: Floats, goals: Floats, made: AnyArray) -> tuple[Floats, Ints]:
        """Pushes (m, 4) by cost, without those that moved nothing here, and the tokens tried."""
        placed = self._task.placed(corners[None], goals[None])[0]
        left = on_table(goals, self._layout) & ~placed
        following = come_next(self._layout, corners, goals, placed)
        for tokens in (following, left):  # any token, if no next one can be pushed
            costs, pushes = self._ranked(tokens, corners, goals)
            here = np.abs(pushes[:, None] - made).max(axis=2, initial=0.0) < STILL
            possible = (costs < NEVER / 2.0) & ~here.any(axis=1)
            if possible.any():
                break
        order = np.argsort(costs[possible])[: max(1, self._count)]
        return pushes[possible][order], np.flatnonzero(tokens)

    def _ranked(self, those: Bools, corners: Floats, goals: Floats) -> tuple[Floats, Floats]:
        """All pushes of some tokens (K,), with their cost above the same token's best push."""
        layout, costs, pushes = self._layout, [np.zeros(0)], [np.zeros((0, 4))]
        poses, desired = layout.poses(corners), layout.poses(goals)
        for token in np.flatnonzero(those).tolist():
            own, every = self._tried[token], np.arange(len(self._tried[token].moved))
            left = after(way_left(poses[token], desired[token])[None], own.moved)
            at = np.broadcast_to(poses[token], left.shape)
            cost = self._left[token](left) + self._met(
                token, at, every, self._others(token, poses[None], goals)
            )
            named = np.full((len(every), 1), (token + 0.5) / layout.tokens * 2.0 - 1.0)
            costs.append(cost - min(cost.min(), NEVER / 2.0))
            pushes.append(np.concatenate([named, own.actions], axis=1))
        return np.concatenate(costs), np.concatenate(pushes)

    def _worth(self, corners: Floats, goals: Floats, following: Ints) -> Floats:
        """(n,) pushes that tokens at corners (n, V, 2) still need, with the best first token.

        The first token moves beside all others. Of two tokens, the second then moves beside the
        first in its place. Of more, each of the others counts as if it lay alone.
        """
        poses, desired = self._layout.poses(corners), self._layout.poses(goals)
        there = np.flatnonzero(on_table(goals, self._layout)).tolist()
        needs = {k: self._left[k](way_left(poses[:, k], desired[k])) for k in there}
        best = np.full(len(corners), np.inf)
        for first in there if len(there) <= PAIR else following.tolist():
            now = self._others(first, poses, goals)
            whole = self._followed(first, poses[:, first], desired[first], now)
            for token in [one for one in there if one != first]:
                if len(there) == PAIR:
                    then = [self._laid(first, np.tile(desired[first], (len(poses), 1)))]
                    whole += self._followed(token, poses[:, token], desired[token], then)
                else:
                    whole += needs[token]
            best = np.minimum(best, whole)
        return best

    def _followed(
        self, token: int, poses: Floats, desired: Floats, others: Sequence[Complex]
    ) -> Floats:
        """(n,) estimated pushes to bring a token from poses (n, 3) home, beside outlines (n, C).

        Takes the best push LENGTH times; the rest counts as if the token lay alone.
        """
        left, own, poses = self._left[token], self._tried[token].moved, poses.copy()
        alone, whole, half = left(way_left(poses, desired)), np.zeros(len(poses)), LOOKED_AT // 2
        for _ in range(LENGTH):
            ways = way_left(poses, desired)
            going = np.flatnonzero(~left.near(ways))
            if not len(going):
                break
            counts = left(after(ways[going, None], own[None]))
            best = np.argpartition(counts, half, axis=1)[:, :half]
            some = np.concatenate([best, np.tile(np.arange(half), (len(going), 1))], axis=1)
            each = np.repeat(going, 2 * half)
            met = self._met(token, poses[each], some.ravel(), [one[each] for one in others])
            met = np.minimum(met, MOST).reshape(some.shape)
            rows = np.arange(len(going))
            at = (np.take_along_axis(counts, some, axis=1) + met).argmin(axis=1)
            whole[going] += 1.0 + met[rows, at]
            poses[going] = moved_by(poses[going], own[some[rows, at]])
        return np.maximum(alone, whole + left(way_left(poses, desired)))

    def _others(self, token: int, poses: Floats, goals: Floats) -> list[Complex]:
        """(n, C) outlines of each other token on the table at poses (n, K, 3)."""
        there = np.flatnonzero(on_table(goals, self._layout)).tolist()
        return [self._laid(one, poses[:, one]) for one in there if one != token]

    def _laid(self, token: int, poses: Floats) -> Complex:
        """(n, C) the outline of a token at poses (n, 3)."""
        turned: Complex = np.exp(1j * poses[:, 2:]) * self._bodies[token]
        return _places(poses)[:, None] + turned

    def _met(self, token: int, poses: Floats, pushes: Ints, others: Sequence[Complex]) -> Floats:
        """(n,) cost of collisions in pushes (n,) of a token at poses (n, 3)."""
        own, radius = self._tried[token], self._task.config.finger
        turn, place, moved = np.exp(1j * poses[:, 2]), _places(poses), own.moved[pushes]
        begin, end = (place + turn * _places(at[pushes]) for at in (own.begins, own.ends))
        reach = np.maximum(np.abs([begin.real, end.real]), np.abs([begin.imag, end.imag])).max(0)
        cost = np.where(reach > 1.0 - radius, NEVER, 0.0)
        gaps = np.ones(len(pushes))
        for outline in others:
            cost[apart(outline, begin) < radius] = NEVER
            for share in SHARES:
                laid = self._laid(token, moved_by(poses, moved * share))
                np.minimum(gaps, _gaps(laid, outline), out=gaps)
                finger = begin + share * (end - begin)
                np.minimum(gaps, apart(outline, finger) - radius, out=gaps)
        return cost + np.clip(SLOPE * (-gaps - SLACK), 0.0, HARDEST)


def _places(poses: Floats) -> Complex:
    """(n,) x and y as complex numbers."""
    places: Complex = poses[..., :2] @ np.array([1.0, 1j])
    return places


def _gaps(some: Complex, others: Complex) -> Floats:
    """(n,) gaps of convex polygons (n, C), by the separating axis theorem; below 0: overlap."""
    found = list[Floats]()
    for one, other in ((some, others), (others, some)):
        edges = np.roll(one, -1, axis=1) - one
        lengths = np.abs(edges)
        normals = edges.conj() / np.maximum(lengths, 1e-9)
        nearest = -(normals[:, :, None] * (other[:, None] - one[:, :, None])).imag.max(axis=2)
        found.append(np.where(lengths < 1e-9, -np.inf, nearest).max(axis=1))
    return np.maximum(*found)
