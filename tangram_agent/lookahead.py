"""Looking ahead where tokens push each other: a beam over orders, places and ways of two legs.

A guide proposes: where tokens may go, and what a token that slides there pushes away of pieces
that lie in place. A world says what an action really comes to, neighbours of neighbours included.
A node is a scene as some actions have left it. What is left to do there is valued by the best order
of all tokens left, as the guide sees it, found exactly over sets of tokens and pieces.

Legend: B scenes, K tokens, M options. Shares and losses are of the area of the whole target.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np

from tangram_agent.foresight import Foresight, Guide, Table
from tangram_agent.types import Past
from tangram_sim.actions import chosen_tokens, velocities_of
from tangram_sim.actuation import full_scale
from tangram_sim.arrays import Bools, Floats, Ints
from tangram_sim.config import SimConfig
from tangram_sim.geometry import outlines, shared_areas
from tangram_sim.kinematics import wrap
from tangram_sim.layout import Layout

_DONE = 0.99  # share of a piece that is as good as all of it
_TRIED = 6  # options of a node that the world is asked for
_ALIKE = 3  # of them, at most so many of one token and one piece
_STOPS = 8  # directions in which a way of two legs may come to its piece,
_AWAY = (0.8, 1.6)  # and from how far, in radii of the largest token
_PERFECT = 0.999  # share of the target beyond which nothing better is looked for,
_ENOUGH = 0.98  # and beyond which that is not done again at the next action
_LEG = 1e-4  # what an action more must bring at least
_SAME = 1e-3  # a scene is what was foreseen: arena units and radians
_LOST = 3e-3  # predicted losses below that are the guide's noise


@dataclass(frozen=True, eq=False)
class Step:
    """One action of a plan.

    Attributes:
        before: (K, 3) poses at which it is meant to be played.
        token: which token moves; None: nothing more is to be done.
        pose: (3,) where it goes.
    """

    before: Floats
    token: int | None
    pose: Floats


class _Plan(NamedTuple):
    """What is to be played, and the share of the target that is covered then."""

    covered: float
    steps: tuple[Step, ...]


@dataclass(frozen=True, eq=False)
class _Options:
    """M ways to places.

    Attributes:
        row: (M,) in which scene.
        token: (M,) which token.
        piece: (M,) for which piece.
        legs: (M,) actions that it takes; 0: the token stays where it lies.
        stops: (M, 2, 3) poses that it takes in turn; the last one twice where it is one leg.
        gain: (M,) what it covers there.
        loss: (M, K) what it pushes away of each piece, if that is in place.
    """

    row: Ints
    token: Ints
    piece: Ints
    legs: Ints
    stops: Floats
    gain: Floats
    loss: Floats

    def at(self, index: Ints) -> "_Options":
        return _Options(*(part[index] for part in vars(self).values()))

    def __add__(self, other: "_Options") -> "_Options":
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return _Options(*(np.concatenate(pair) for pair in pairs))


@dataclass(frozen=True, eq=False)
class _Node:
    """What some actions came to.

    Attributes:
        poses: (K, 3) of the tokens.
        actions: (K,) that each token has left.
        steps: how it was reached.
        covered: share of the target that is covered.
        promise: the share that may come to be.
        best: the most promising options, each a token and the poses (L, 3) that it takes in turn.
    """

    poses: Floats
    actions: Ints
    steps: tuple[Step, ...]
    covered: float
    promise: float
    best: list[tuple[int, Floats]]


class Lookahead:
    """Plans from what is seen, and keeps to a plan while the world does what it foresaw."""

    def __init__(
        self, layout: Layout, sim: SimConfig, guide: Guide, world: Foresight, beam: int
    ) -> None:
        """Make one.

        Args:
            layout: of few tokens, see `setup.MAX_PLANNED`.
            sim: the world that is played in.
            guide: who proposes.
            world: what actions are tried in.
            beam: nodes of each depth that are followed.
        """
        self._layout, self._sim, self._guide = layout, sim, guide
        self._world, self._beam = world, beam
        self._share: Floats = layout.areas / layout.areas.sum()
        masks = np.arange(1 << layout.tokens)
        self._taken = (masks[:, None] >> np.arange(layout.tokens)) & 1  # (2^K, K)
        self._plans: dict[bytes, _Plan] = {}
        # What a way pushes away of pieces in place is the same in every node of a plan.
        self._pushed: dict[bytes, Floats] = {}

    def choose(
        self, corners: Floats, placed: Bools, goals: Floats, past: Past | None
    ) -> tuple[Ints, Floats]:
        """Which token (B,) goes to which pose (B, 3); one that stays where nothing is to be done.

        Args:
            corners: (B, V, 2) of the tokens.
            placed: (B, K) which tokens are placed.
            goals: (B, V, 2) of the target.
            past: what was done in these episodes before; None: nothing.
        """
        layout, poses = self._layout, self._layout.poses(corners)
        tables = [
            Table(*rows)
            for rows in zip(
                poses,
                layout.flipped(corners),
                layout.poses(goals),
                layout.flipped(goals),
                strict=True,
            )
        ]
        left = np.where(placed, 0, self._sim.actions_per_token)
        if past is not None:
            for b, actions in enumerate(past.actions):
                named = chosen_tokens(actions, layout.tokens)
                left[b] = np.maximum(left[b] - np.bincount(named, minlength=layout.tokens), 0)
        tokens = np.argmin(placed, axis=1)
        wanted = poses[np.arange(len(tokens)), tokens]
        for b, step in enumerate(self._steps(tables, left)):
            if step.token is not None:
                tokens[b], wanted[b] = step.token, step.pose
        return tokens, wanted

    def forget(self) -> None:
        """Drop the plans: what guided them is another one now."""
        self._plans.clear()

    def _steps(self, tables: Sequence[Table], actions: Ints) -> list[Step]:
        """The next action in every scene, each token having so many left, (B, K)."""
        kept, steps = dict[bytes, _Plan](), list[Step]()
        for table, left in zip(tables, actions, strict=True):
            key = table.goal.tobytes()
            plan = self._plans.get(key)
            if plan is not None and not self._foreseen(plan.steps[0], table):
                plan = None
            # With fewer tokens left a plan costs less, and sees farther.
            if plan is None or plan.covered < _ENOUGH:
                found = self._plan(table, left)
                plan = found if plan is None or found.covered > plan.covered else plan
            first, *rest = plan.steps
            steps.append(first)
            kept[key] = _Plan(plan.covered, tuple(rest) or plan.steps)  # the last one does nothing
        self._plans = kept
        return steps

    def _foreseen(self, step: Step, table: Table) -> bool:
        off = table.poses - step.before
        off[:, 2] = wrap(off[:, 2])
        return bool(np.abs(off).max() <= _SAME)

    def _plan(self, table: Table, actions: Ints) -> _Plan:
        self._pushed.clear()
        [best] = self._nodes(replace(table, poses=table.poses[None]), actions[None], [()])
        beam = [best]
        while beam and best.covered < _PERFECT:
            found = self._children(table, beam)
            best = max([best, *found], key=lambda node: node.covered - _LEG * len(node.steps))
            beam = self._kept(found, best)
        return _Plan(best.covered, (*best.steps, Step(best.poses, None, np.zeros(3))))

    def _kept(self, nodes: Iterable[_Node], best: _Node) -> list[_Node]:
        """The most promising nodes, those that are alike once."""
        kept = dict[bytes, _Node]()
        for node in sorted(nodes, key=lambda node: -node.promise):
            if node.best and node.promise > best.covered + _LEG and len(kept) < self._beam:
                kept.setdefault(node.poses.round(2).tobytes() + node.actions.tobytes(), node)
        return list(kept.values())

    def _children(self, table: Table, nodes: Sequence[_Node]) -> list[_Node]:
        """What the most promising options come to."""
        tried = [(node, token, stops) for node in nodes for token, stops in node.best]
        if not tried:
            return []
        token = np.array([moving for _, moving, _ in tried])
        poses, actions = (
            np.stack([getattr(node, name) for node, _, _ in tried]) for name in ("poses", "actions")
        )
        steps = [node.steps for node, _, _ in tried]
        for leg in range(2):
            rows = np.array([b for b, (_, _, stops) in enumerate(tried) if leg < len(stops)], int)
            if len(rows):
                stop = np.stack([tried[b][2][leg] for b in rows])
                for b, pose in zip(rows.tolist(), stop, strict=True):
                    steps[b] = (*steps[b], Step(poses[b].copy(), int(token[b]), pose))
                share = velocities_of(stop - poses[rows, token[rows]], self._sim)
                way = np.clip(share, -1.0, 1.0) * full_scale(self._sim)
                scenes = replace(table, poses=poses[rows])
                poses[rows] = self._world.slid(scenes, token[rows], way)
                actions[rows, token[rows]] -= 1
        return self._nodes(replace(table, poses=poses), actions, steps)

    def _nodes(self, table: Table, actions: Ints, steps: Sequence[tuple[Step, ...]]) -> list[_Node]:
        areas = self._layout.areas
        shared = shared_areas(self._outlines(table.poses, table.flipped), self._goals(table))
        # Rounding must not decide between ways that are equally good.
        now = (np.minimum(shared.sum(axis=1) / areas, 1.0) @ self._share).round(6)
        lies = shared / np.maximum(areas[:, None], areas)
        left = (actions > 0) & ~(lies >= _DONE).any(axis=2)
        covered = np.minimum((shared * ~left[..., None]).sum(axis=1) / areas, 1.0)
        options = self._options(table, actions, left, covered, lies)
        base, taken, nodes = covered @ self._share, covered > _DONE, list[_Node]()
        for b, poses in enumerate(table.poses):
            own = options.at(np.flatnonzero(options.row == b))
            promise, totals = self._promises(own, left[b], taken[b])
            best = self._most_promising(own, totals)
            promised = float(base[b]) + promise
            nodes.append(_Node(poses, actions[b], steps[b], float(now[b]), promised, best))
        return nodes

    def _options(
        self, table: Table, actions: Ints, left: Bools, covered: Floats, lies: Floats
    ) -> _Options:
        """Every token left, straight or by two legs to places, or where it lies."""
        places, areas = self._guide.places(table, left, covered), self._layout.areas
        larger = np.maximum(areas[places.token], areas[places.piece]) / areas[places.piece]
        gain = np.minimum(places.value * larger, 1.0 - covered[places.row, places.piece])
        # A token that a turn maps onto itself may lie in several ways.
        turns = self._layout.symmetries[places.token]
        index = np.repeat(np.arange(len(turns)), turns)
        number = np.arange(len(index)) - (turns.cumsum() - turns)[index]
        pose = places.pose[index]
        pose[:, 2] += 2.0 * np.pi * number / turns[index]
        row, token, piece = (part[index] for part in (places.row, places.token, places.piece))
        straight = _Options(
            row=row,
            token=token,
            piece=piece,
            legs=np.ones(len(token), dtype=np.int64),
            stops=np.stack([pose, pose], axis=1),
            gain=gain[index] * self._share[piece],
            loss=self._losses(table, token, piece, table.poses[row, token], pose),
        )
        # Of ways round to turns that look alike one is enough.
        around = self._around(table, straight.at(np.flatnonzero(number == 0)), actions)
        return straight + around + self._staying(table, left, covered, lies)

    def _around(self, table: Table, straight: _Options, actions: Ints) -> _Options:
        """Ways of two legs where the straight one costs: turn on the first one, then shift."""
        costs = (straight.loss.sum(axis=1) > 0.0) & (actions[straight.row, straight.token] > 1)
        costly = straight.at(np.flatnonzero(costs))
        angle = 2.0 * np.pi * np.arange(_STOPS) / _STOPS
        circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(_STOPS)])
        away = np.concatenate([circle * far * self._layout.radii.max() for far in _AWAY])
        around = costly.at(np.repeat(np.arange(len(costly.token)), len(away)))
        around.stops[:, 0] += np.tile(away, (len(costly.token), 1))
        inside = (np.abs(around.stops[:, 0, :2]) <= self._sim.arena / 2.0).all(axis=1)
        around = around.at(np.flatnonzero(inside))
        token, piece, stops = around.token, around.piece, around.stops
        # Both legs together: what is asked of a guide takes about as long for many ways.
        starts = np.concatenate([table.poses[around.row, token], stops[:, 0]])
        ends = np.concatenate([stops[:, 0], stops[:, 1]])
        legs = self._losses(table, np.tile(token, 2), np.tile(piece, 2), starts, ends)
        loss = np.maximum(*np.split(legs, 2))
        return replace(around, legs=around.legs + 1, gain=around.gain - _LEG, loss=loss)

    def _staying(self, table: Table, left: Bools, covered: Floats, lies: Floats) -> _Options:
        """Tokens left that cover a part of a piece where they lie."""
        row, token, piece = np.nonzero(lies * left[..., None] > 0.0)
        pose = table.poses[row, token]
        gain = np.minimum(lies[row, token, piece], 1.0 - covered[row, piece])
        return _Options(
            row=row,
            token=token,
            piece=piece,
            legs=np.zeros(len(token), dtype=np.int64),
            stops=np.stack([pose, pose], axis=1),
            gain=gain * self._share[piece],
            loss=np.zeros((len(token), self._layout.tokens)),
        )

    def _losses(self, table: Table, token: Ints, piece: Ints, start: Floats, end: Floats) -> Floats:
        if not len(token):
            return np.zeros((0, self._layout.tokens))
        ways = np.column_stack([token, start, end]).round(3)
        keys = [way.tobytes() for way in ways]
        new = {key: m for m, key in enumerate(keys) if key not in self._pushed}
        if new:
            rows = list(new.values())
            pushed = self._guide.pushed(table, token[rows], start[rows], end[rows])
            self._pushed.update(zip(new, pushed, strict=True))
        known = np.stack([self._pushed[key] for key in keys])
        known[np.arange(len(token)), piece] = 0.0
        return np.where(known > _LOST, known, 0.0) * self._share

    def _promises(self, options: _Options, left: Bools, taken: Bools) -> tuple[float, Floats]:
        """What the best order of all tokens left adds, and the best after each option, (M,)."""
        net = options.gain[:, None] - options.loss @ self._taken.T  # (M, 2^K)
        pairs = dict[tuple[int, int], Floats]()
        for m, pair in enumerate(zip(options.token.tolist(), options.piece.tolist(), strict=True)):
            pairs[pair] = np.maximum(pairs[pair], net[m]) if pair in pairs else net[m]
        moves = [(1 << i, 1 << j, row.tolist()) for (i, j), row in pairs.items()]

        @cache
        def rest(tokens: int, pieces: int) -> float:
            most = 0.0
            for token, piece, row in moves:
                if tokens & token and not pieces & piece:
                    most = max(most, row[pieces] + rest(tokens ^ token, pieces | piece))
            return most

        tokens, pieces = _mask(left), _mask(taken)
        after = [
            net[m, pieces] + rest(tokens ^ (1 << i), pieces | (1 << j))
            for m, (i, j) in enumerate(
                zip(options.token.tolist(), options.piece.tolist(), strict=True)
            )
        ]
        after_or_never = np.where((options.legs > 0) & ~taken[options.piece], after, -np.inf)
        return rest(tokens, pieces), after_or_never

    def _most_promising(self, options: _Options, totals: Floats) -> list[tuple[int, Floats]]:
        best, alike = list[tuple[int, Floats]](), dict[tuple[int, int], int]()
        for m in np.argsort(-totals, kind="stable").tolist():
            pair = int(options.token[m]), int(options.piece[m])
            if totals[m] > -np.inf and alike.get(pair, 0) < _ALIKE and len(best) < _TRIED:
                alike[pair] = alike.get(pair, 0) + 1
                best.append((pair[0], options.stops[m, 2 - options.legs[m] :]))
        return best

    def _outlines(self, poses: Floats, flipped: Bools) -> Floats:
        return outlines(self._layout.corners(poses, flipped), self._layout)

    def _goals(self, table: Table) -> Floats:
        return self._outlines(table.goal[None], table.goal_flipped)


def _mask(flags: Bools) -> int:
    """Flags (K,) as the bits of a number."""
    return int(flags @ (1 << np.arange(len(flags))))
