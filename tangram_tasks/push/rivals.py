"""Who plays without learning: by pushes of each shape tried alone, and by trials in an engine.

What a push does to a token that lies alone is written down in the token's own frame, at the middle
of what is unknown. A decision looks for the push, or the two pushes, after which least is left to
go, among those that keep finger and token clear of the others. A planner tries the best of them in
an engine of its own, and after the best of these others.

Legend: N pushes of a shape, n of them, K tokens, V corners, C corners of a token.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from operator import itemgetter
from typing import TYPE_CHECKING

import numpy as np

from tangram_core.arrays import Bools, Floats, Ints, Singles
from tangram_core.spec import Arrays
from tangram_core.task import Generators, History
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import outlines_at, shared_area
from tangram_sim.geometry.shapes import Shape
from tangram_sim.world.pushing import PushTable, Unknowns
from tangram_tasks.push.order import come_next
from tangram_tasks.push.places import apart, on_table, push_of
from tangram_tasks.push.trials import Trials, middle

if TYPE_CHECKING:
    from tangram_tasks.push.env import PushEnv
    from tangram_tasks.push.task import Push

PUSHES = 3000  # of each shape
FIRST, SECOND = 120, 1000  # that are followed in thought, half the best, half any; and by these
CLEAR = 0.02  # share of a token that may come to lie on another: it is pushed aside a little
WAY_POINTS = 4  # of a token's way that are looked at
BLOCKED = 1e3  # cost of a push that is not clear
TRIED, KEPT, NEXT = 36, 8, 12  # pushes in an engine, the best of them, and after each of these
LATER = 0.1  # of what is left now counts, beside what is left then: sooner is better
WRONG = 2.0  # by which a planner is wrong about friction


@dataclass(frozen=True, eq=False)
class Pushes:
    """What random pushes do to a shape that lies alone.

    Attributes:
        actions: (N, 3) where, turn, far.
        moved: (N, 3) x, y and turn of the token in its own frame.
        begins, ends: (N, 2) of the finger, there.
    """

    actions: Floats
    moved: Floats
    begins: Floats
    ends: Floats


@lru_cache(maxsize=64)
def tried_alone(
    shape: Shape, finger: float, longest: float, friction: float, spread: float
) -> Pushes:
    """Random pushes of a shape; some seconds when they are asked for first."""
    layout, rng = Layout([shape]), np.random.default_rng(0)
    table, present = PushTable(layout, finger), np.ones(1, np.bool_)
    unknowns = Unknowns(np.ones(1), np.full(1, spread), friction, np.zeros((1, 2)))
    table.place(np.zeros((1, 3)), present, unknowns)
    actions, moved = rng.uniform(-1.0, 1.0, (PUSHES, 3)), np.zeros((PUSHES, 3))
    begins, ends = np.zeros((2, PUSHES, 2))
    corners = layout.corners(np.zeros((1, 3)))
    for i, action in enumerate(actions):
        push = push_of(layout, corners, np.append(0.0, action), finger, longest)
        table.lay(np.zeros((1, 3)))
        table.push(push.begin, push.way)
        moved[i], begins[i], ends[i] = table.poses()[0], push.begin, push.begin + push.way
    table.close()
    return Pushes(actions, moved, begins, ends)


def _error(pose: Floats, desired: Floats) -> Floats:
    """(3,) the way from a pose to another, in its own frame."""
    way = (desired[:2] - pose[:2]) @ (1.0, 1j) * np.exp(-1j * pose[2])
    return np.array([way.real, way.imag, desired[2] - pose[2]])


def after(errors: Floats, moved: Floats) -> Floats:
    """(..., 3) ways that are left, in the frames of tokens that moved by (..., 3) in theirs."""
    left = (errors[..., :2] - moved[..., :2]) @ (1.0, 1j) * np.exp(-1j * moved[..., 2])
    return np.stack([left.real, left.imag, errors[..., 2] - moved[..., 2]], axis=-1)


class Planner:
    """Chooses by what was tried of each shape alone, and by trials in an engine where there are."""

    def __init__(self, task: "Push", env: "PushEnv", tried: int = 0, knows: str = "middle") -> None:
        """Try pushes of each shape.

        Args:
            task: what is played.
            env: where.
            tried: pushes that are tried in an engine before one is played, and a few after them;
                0: none.
            knows: of friction and centres of mass: middle, of what they are drawn from; all; wrong,
                the finger's friction and the lever of the table's twice the middle.
        """
        self._middle, config = middle(task), task.config
        self._env, self._count, self._knows = env, tried, knows
        self._trials = Trials(task)
        self._task, self._layout = task, task.layout
        spread, friction = float(self._middle.spread[0]), self._middle.finger
        self._tried = [
            tried_alone(one, config.finger, config.longest, friction, spread)
            for one in task.layout.shapes
        ]
        self._periods = 2.0 * np.pi / task.layout.symmetries

    def __call__(self, seen: Arrays, past: History, generators: Generators) -> Singles:  # noqa: ARG002
        """(B, 4) the push after which least is left to go."""
        knows = map(self._known, range(len(generators)))
        rows = zip(seen["corners"], seen["goals"], knows, generators, strict=True)
        return np.stack([self._best(*row) for row in rows]).astype(np.float32)

    def _known(self, table: int) -> Unknowns:
        if self._knows == "all":
            return self._env.unknowns[table]
        own, times = self._middle, WRONG if self._knows == "wrong" else 1.0
        return replace(own, spread=own.spread * times, finger=own.finger * times)

    def _best(
        self, corners: Floats, goals: Floats, knows: Unknowns, rng: np.random.Generator
    ) -> Floats:
        scene = np.asarray(corners, np.float64), np.asarray(goals, np.float64)
        found = self._proposed(*scene, max(1, self._count), rng)
        tried = self._outcomes(*scene, knows, found)[:KEPT] if self._count else []
        if not tried:
            return min(found, key=itemgetter(0))[1] if found else np.zeros(4)
        costs = list[float]()
        for left, _, there in tried:
            more = self._proposed(there, scene[1], NEXT, rng)
            then = [one[0] for one in self._outcomes(there, scene[1], knows, more)]
            costs.append(min([left, *then]) + LATER * left)
        return tried[int(np.argmin(costs))][1]

    def _proposed(
        self, corners: Floats, goals: Floats, count: int, rng: np.random.Generator
    ) -> list[tuple[float, Floats]]:
        """About so many pushes (4,), each after its cost: what is left if it is alone."""
        task, present = self._task, on_table(goals, self._layout)
        placed = task.placed(corners[None], goals[None])[0]
        following, left = come_next(self._layout, corners, goals, placed), present & ~placed
        found = self._of(following, corners, goals, count, rng)
        if all(cost > BLOCKED / 2.0 for cost, _ in found) and (following != left).any():
            return self._of(left, corners, goals, count, rng)
        return found

    def _of(
        self, those: Bools, corners: Floats, goals: Floats, count: int, rng: np.random.Generator
    ) -> list[tuple[float, Floats]]:
        """The same of some tokens (K,)."""
        layout, tokens = self._layout, np.flatnonzero(those).tolist()
        poses, desired = layout.poses(corners), layout.poses(goals)
        found: list[tuple[float, Floats]] = []
        for token in tokens:
            error = _error(poses[token], desired[token])
            chosen, costs = self._ranked(token, error, rng)
            clear = self._clear(token, chosen, poses, on_table(goals, layout))
            costs = np.where(clear, costs, costs + BLOCKED) - self._cost(token, error[None])[0]
            named = (token + 0.5) / layout.tokens * 2.0 - 1.0
            for i in np.argsort(costs)[: max(1, count // len(tokens))].tolist():
                action = np.append(named, self._tried[token].actions[chosen[i]])
                found.append((float(costs[i]), action))
        return found

    def _outcomes(
        self, corners: Floats, goals: Floats, knows: Unknowns, pushes: list[tuple[float, Floats]]
    ) -> list[tuple[float, Floats, Floats]]:
        """What is left after those that the engine allows, the least first, pushes and corners."""
        self._trials.begin(corners, goals, knows)
        found = [(one, self._trials.after(one)) for _, one in pushes]
        left = [(self._left(at, goals), one, at) for one, at in found if at is not None]
        return sorted(left, key=itemgetter(0))

    def _left(self, corners: Floats, goals: Floats) -> float:
        """What is left of all tokens: the least pushes first."""
        now, desired, whole = self._layout.poses(corners), self._layout.poses(goals), 0.0
        for token in np.flatnonzero(on_table(goals, self._layout)).tolist():
            error = _error(now[token], desired[token])
            cost = float(self._cost(token, error[None])[0])
            if cost > 1.0:
                after_one = self._cost(token, after(error, self._tried[token].moved)).min()
                whole += 2.0 + float(after_one)
            else:
                whole += 0.2 * cost
        return whole

    def _ranked(self, token: int, error: Floats, rng: np.random.Generator) -> tuple[Ints, Floats]:
        """Pushes (n,), and what is left after them and the best that may follow."""
        moved = self._tried[token].moved
        first = after(error, moved)
        costs = self._cost(token, first)
        order = np.argsort(costs)
        any_of = rng.integers(PUSHES, size=FIRST // 2)
        chosen = np.concatenate([order[: FIRST // 2], any_of])
        second = self._cost(token, after(first[chosen][:, None], moved[None, :SECOND])).min(axis=1)
        one = costs[chosen]
        return chosen, np.where(one <= 1.0, one, 1.0 + second)

    def _cost(self, token: int, errors: Floats) -> Floats:
        """(...) of ways that are left (..., 3), in tolerances."""
        period, config = self._periods[token], self._task.config
        turn = errors[..., 2] - period * np.round(errors[..., 2] / period)
        far = np.hypot(errors[..., 0], errors[..., 1]) / config.within
        cost: Floats = np.hypot(far, turn / config.turned)
        return cost

    def _clear(self, token: int, chosen: Ints, poses: Floats, present: Bools) -> Bools:
        """(n,) whether finger and token keep clear of the other tokens, and of the table's edge."""
        own, layout = self._tried[token], self._layout
        turn, place = np.exp(1j * poses[token, 2]), poses[token, :2] @ (1.0, 1j)
        begin, end = (place + turn * (at[chosen] @ (1.0, 1j)) for at in (own.begins, own.ends))
        edge = 1.0 - self._task.config.finger
        clear = np.ones(len(chosen), np.bool_)
        for at in (begin, end):
            clear &= np.maximum(np.abs(at.real), np.abs(at.imag)) <= edge
        others = [k for k in np.flatnonzero(present).tolist() if k != token]
        if not others:
            return clear
        bodies = layout.body[layout.padded_corners]
        sides = np.zeros(len(others), np.bool_)
        outlines = outlines_at(bodies[others], poses[others], sides)
        for share in np.arange(1, WAY_POINTS + 1) / WAY_POINTS:
            moved = own.moved[chosen] * share
            at = place + turn * (moved[:, :2] @ (1.0, 1j))
            whole = np.stack([at.real, at.imag, poses[token, 2] + moved[:, 2]], axis=1)
            laid = outlines_at(bodies[token], whole, np.zeros(len(whole), np.bool_))
            finger = begin + share * (end - begin)
            for outline in outlines:
                pairs = np.broadcast_to(outline, laid.shape)
                clear &= shared_area(laid, pairs) <= CLEAR * layout.areas[token]
                clear &= apart(outline @ (1.0, 1j), finger) >= self._task.config.finger
        for outline in outlines:
            clear &= apart(outline @ (1.0, 1j), begin) >= self._task.config.finger
        return clear
