"""Who plays without learning: by pushes of each shape tried alone, and by trials in an engine.

What a push does to a token that lies alone is written down in the token's own frame, at the middle
of what is unknown. A decision looks for the push, or the two pushes, after which least is left to
go, among those that keep finger and token clear of the others. A planner then tries the best of
them in an engine of its own, and others around the best of these (the cross-entropy method).

Legend: N pushes of a shape, n of them, K tokens, V corners, C corners of a token.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from tangram_core.arrays import Bools, Floats, Ints, Singles
from tangram_core.spec import Arrays
from tangram_core.task import Generators, History
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import outlines_at, shared_area
from tangram_sim.geometry.shapes import Shape
from tangram_sim.world.pushing import PushTable, Unknowns
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
TRIED, ROUNDS = 24, 3  # a planner's pushes in an engine at first, and how often as many follow
BEST = 6  # around which they are drawn
AROUND = 0.25  # deviation of their numbers at first; each round halves it
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
    middle = Unknowns(np.ones(1), np.full(1, spread), friction, np.zeros((1, 2)))
    table.place(np.zeros((1, 3)), present, middle)
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

    def __init__(
        self, task: "Push", env: "PushEnv", tried: int = 1, rounds: int = 0, knows: str = "middle"
    ) -> None:
        """Try pushes of each shape.

        Args:
            task: what is played.
            env: where.
            tried: pushes that are tried in an engine before one is played; 1: none.
            rounds: how often as many around the best are tried, too.
            knows: of friction and centres of mass: middle, of what they are drawn from; all; wrong,
                the finger's friction and the lever of the table's twice the middle.
        """
        self._middle, config = middle(task), task.config
        self._env, self._count, self._rounds, self._knows = env, tried, rounds, knows
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
        own = self._middle
        if self._knows == "middle":
            return own
        return replace(own, spread=own.spread * WRONG, finger=own.finger * WRONG)

    def _best(
        self, corners: Floats, goals: Floats, knows: Unknowns, rng: np.random.Generator
    ) -> Floats:
        task, layout = self._task, self._layout
        corners, goals = np.asarray(corners, np.float64), np.asarray(goals, np.float64)
        poses, desired = layout.poses(corners), layout.poses(goals)
        present = on_table(goals, layout)
        placed = task.placed(corners[None], goals[None])[0]
        left = np.flatnonzero(present & ~placed).tolist()
        found: list[tuple[float, Floats]] = []
        for token in left:
            error = _error(poses[token], desired[token])
            chosen, costs = self._ranked(token, error, rng)
            clear = self._clear(token, chosen, poses, present)
            costs = np.where(clear, costs, costs + BLOCKED) - self._cost(token, error[None])[0]
            named = (token + 0.5) / layout.tokens * 2.0 - 1.0
            for i in np.argsort(costs)[: max(1, self._count // len(left))].tolist():
                action = np.append(named, self._tried[token].actions[chosen[i]])
                found.append((float(costs[i]), action))
        if not found:
            return np.zeros(4)
        if self._count > 1:
            self._trials.begin(corners, goals, knows)
            scene = desired, present
            found = [(self._after(one, *scene), one) for _, one in found]
            for number in range(self._rounds):
                best = sorted(found, key=_cost)[:BEST]
                chosen = rng.integers(len(best), size=self._count)
                noise = rng.normal(size=(self._count, 3)) * AROUND / 2.0**number
                others = [_moved(best[i][1], by) for i, by in zip(chosen, noise, strict=True)]
                found += [(self._after(one, *scene), one) for one in others]
        return min(found, key=_cost)[1]

    def _after(self, action: Floats, desired: Floats, present: Bools) -> float:
        """What is left of all tokens after a push, tried in the engine: the least pushes first."""
        corners = self._trials.after(action)
        if corners is None:
            return BLOCKED
        now, whole = self._layout.poses(corners), 0.0
        for token in np.flatnonzero(present).tolist():
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


def _cost(found: tuple[float, Floats]) -> float:
    return found[0]


def _moved(action: Floats, by: Floats) -> Floats:
    """Another push (4,) of the same token; where its edge ends it begins."""
    where, turn, far = action[1:] + by
    return np.array([action[0], (where + 1.0) % 2.0 - 1.0, *np.clip((turn, far), -1.0, 1.0)])
