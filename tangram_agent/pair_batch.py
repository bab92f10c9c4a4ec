"""From transitions to pairs that actor and critic learn from, with hindsight for several tokens.

Each transition gives some pairs of the token that moved and one piece of the target. The piece is
that of the goal that was played, or in hindsight one of the token's own shape where the token came
to lie, or near it (Sec. III-B for one piece). What the token newly covers of it is computed anew.

Legend: B transitions, P pairs of each, M = B * P, K tokens.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tangram_agent.config import AgentConfig
from tangram_agent.types import Transitions
from tangram_sim.actions import chosen_tokens
from tangram_sim.arrays import Bools, Floats, Ints
from tangram_sim.geometry import outlines, shared_area
from tangram_sim.layout import Layout

_OTHER_SHAPE = 0.15  # share of hindsight pieces that have any shape, not the token's
_OTHER_SIDE = 0.1  # share of hindsight pieces on the other side than the token
_COVERED = 0.3  # share of hindsight pieces that are covered in part already


@dataclass(frozen=True, eq=False)
class PairBatch:
    """M pairs as they were before and after an action, and its value.

    Attributes:
        before, after: (M, 3) poses of the token.
        before_flipped, after_flipped: (M,) whether it lay on its other side.
        token: (M,) which moved.
        goal: (M, 3) pose of the target's piece.
        goal_flipped: (M,) its side.
        piece: (M,) its index.
        covered: (M,) share of the piece that was covered before the action.
        value: (M,) what the token covers newly of it, over the larger of both areas.
    """

    before: Floats
    after: Floats
    before_flipped: Bools
    after_flipped: Bools
    token: Ints
    goal: Floats
    goal_flipped: Bools
    piece: Ints
    covered: Floats
    value: Floats


@dataclass(frozen=True, eq=False)
class ContactBatch(PairBatch):
    """Pairs of tokens that slide, with another token of the same scene for each.

    Attributes:
        other: (M,) its index.
        other_pose: (M, 3) where it lay before the action.
        other_flipped: (M,) on which side.
        pushed: (M,) share of its area that the action pushed away from there.
    """

    other: Ints
    other_pose: Floats
    other_flipped: Bools
    pushed: Floats


def make_pairs(
    batch: Transitions, agent: AgentConfig, layout: Layout, generator: np.random.Generator
) -> PairBatch:
    """Pairs of a batch of transitions, `pairs_per_transition` of each.

    A share of them has the goals that were played, the rest those of the hindsight twins: as many
    parts as there are copies.
    """
    rows = np.repeat(np.arange(batch.count), agent.pairs_per_transition)
    token = chosen_tokens(batch.action.astype(np.float64), layout.tokens)[rows]
    before, before_side = _pose_of(batch.state, layout, rows, token)
    after, after_side = _pose_of(batch.next_state, layout, rows, token)
    strategy = _strategies(agent, len(rows), generator)
    piece = generator.integers(layout.tokens, size=len(rows))
    goal, goal_side = _pose_of(batch.goal, layout, rows, piece)
    covered = np.zeros(len(rows))
    played = strategy == 0
    others = np.arange(layout.tokens) != token[played][:, None]
    covered[played] = covered_share(
        batch.state[rows[played]],
        others,
        batch.goal[rows[played]],
        piece[played],
        layout,
    )
    told = _Relabelled(agent, layout, generator)
    hind = np.flatnonzero(~played)
    piece[hind] = told.pieces(token[hind], piece[hind])
    goal[hind] = told.goals(after[hind], piece[hind], strategy[hind])
    goal_side[hind] = told.sides(after_side[hind], piece[hind])
    covered[hind] = told.covered(len(hind))
    value = newly_covered(after, after_side, token, goal, goal_side, piece, covered, layout)
    return PairBatch(
        before, after, before_side, after_side, token, goal, goal_side, piece, covered, value
    )


def with_contacts(
    pairs: PairBatch, batch: Transitions, layout: Layout, generator: np.random.Generator
) -> ContactBatch:
    """The same pairs, with what their action did to another token, drawn uniformly."""
    rows = np.repeat(np.arange(batch.count), len(pairs.token) // batch.count)
    other = (pairs.token + generator.integers(1, layout.tokens, len(rows))) % layout.tokens
    pose, side = _pose_of(batch.state, layout, rows, other)
    later, later_side = _pose_of(batch.next_state, layout, rows, other)
    before = _outlines_at(pose, side, other, layout)
    areas = np.array([shape.area for shape in layout.shapes])[other]
    kept = shared_area(before, _outlines_at(later, later_side, other, layout)) / areas
    pushed = np.clip(1.0 - kept, 0.0, 1.0)
    return ContactBatch(
        **vars(pairs), other=other, other_pose=pose, other_flipped=side, pushed=pushed
    )


class _Relabelled:
    """Goals of hindsight: pieces where the token came to lie, or near."""

    def __init__(self, agent: AgentConfig, layout: Layout, generator: np.random.Generator) -> None:
        self._layout, self._generator = layout, generator
        self._symmetry = np.array([shape.symmetry for shape in layout.shapes])
        # One row per strategy, the goal that was played first.
        spreads = [(twin.position, twin.position, twin.angle) for twin in agent.hindsight]
        near = [twin.strategy == "near" for twin in agent.hindsight]
        self._spread = np.array([(0.0, 0.0, 0.0), *spreads]) * np.array([0.0, *near])[:, None]
        self._alike = _same_shapes(layout)

    def pieces(self, token: Ints, other: Ints) -> Ints:
        """(M,) mostly a piece of the token's own shape, else the other one."""
        own = np.array([self._generator.choice(self._alike[k]) for k in token], dtype=np.int64)
        return np.where(self._generator.random(len(token)) < _OTHER_SHAPE, other, own)

    def goals(self, after: Floats, piece: Ints, strategy: Ints) -> Floats:
        """(M, 3) at the achieved pose or near it, at any of the turns that look alike."""
        draw = self._generator.standard_normal(after.shape) * self._spread[strategy]
        goal: Floats = after + draw
        order = self._symmetry[piece]
        goal[:, 2] += 2.0 * np.pi / order * self._generator.integers(order)
        return goal

    def sides(self, after: Bools, piece: Ints) -> Bools:
        """(M,) mostly the token's own side, where the piece has two."""
        other = self._generator.random(len(piece)) < _OTHER_SIDE
        return np.asarray((after ^ other) & self._layout.chiral[piece])

    def covered(self, count: int) -> Floats:
        """(M,) mostly nothing, else any share."""
        share = self._generator.random(count)
        return np.where(self._generator.random(count) < _COVERED, share, 0.0)


def covered_share(
    corners: npt.NDArray[np.floating],
    placed: npt.NDArray[np.generic],
    goals: npt.NDArray[np.floating],
    piece: Ints,
    layout: Layout,
) -> Floats:
    """(M,) share of one piece of each target that placed tokens cover, one by one.

    Args:
        corners: (M, V, 2) of the tokens.
        placed: (M, K).
        goals: (M, V, 2) of the targets.
        piece: (M,) which piece.
        layout: of both.
    """
    rows, tokens = np.nonzero(placed)
    own = outlines(np.asarray(corners, np.float64), layout)[rows, tokens]
    wanted = outlines(np.asarray(goals, np.float64), layout)[rows, piece[rows]]
    shared = np.bincount(rows, shared_area(wanted, own), minlength=len(corners))
    areas = np.array([shape.area for shape in layout.shapes])
    share: Floats = np.minimum(shared / areas[piece], 1.0)
    return share


def covers(corners: Floats, goals: Floats, layout: Layout) -> Floats:
    """(B, K, K) area that each token covers of each piece of the target.

    Args:
        corners: (B, V, 2) of the tokens.
        goals: (B, V, 2) of the targets.
        layout: of both.
    """
    count = layout.tokens
    own = np.repeat(outlines(corners, layout), count, axis=1)
    wanted = np.tile(outlines(goals, layout), (1, count, 1, 1))
    shape = (-1, *own.shape[2:])
    return shared_area(wanted.reshape(shape), own.reshape(shape)).reshape(-1, count, count)


def newly_covered(
    pose: Floats,
    flipped: Bools,
    token: Ints,
    goal: Floats,
    goal_flipped: Bools,
    piece: Ints,
    covered: Floats,
    layout: Layout,
) -> Floats:
    """(M,) the area of a piece that a token covers and nothing covered before, as a value.

    Over the larger of both areas: over the token's own a small one inside of a large piece would
    be worth as much as the right one. Where a piece is covered in part, what the token covers is
    taken to be what is left first.
    """
    areas = np.array([shape.area for shape in layout.shapes])
    shared = shared_area(
        _outlines_at(goal, goal_flipped, piece, layout), _outlines_at(pose, flipped, token, layout)
    )
    new = np.minimum(shared, (1.0 - covered) * areas[piece])
    value: Floats = new / np.maximum(areas[piece], areas[token])
    return value


def _outlines_at(pose: Floats, flipped: Bools, token: Ints, layout: Layout) -> Floats:
    """Counter-clockwise corners (M, C, 2) of single tokens."""
    body = layout.body[layout.padded_corners][token]
    body = np.where(flipped[:, None, None], body[:, ::-1] * (1.0, -1.0), body)
    cos, sin = np.cos(pose[:, 2:]), np.sin(pose[:, 2:])
    x, y = body[..., 0], body[..., 1]
    turned = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    moved: Floats = turned + pose[:, None, :2]
    return moved


def _pose_of(
    corners: npt.NDArray[np.floating], layout: Layout, rows: Ints, token: Ints
) -> tuple[Floats, Bools]:
    """Pose (M, 3) and side (M,) of one token of each row."""
    exact = np.asarray(corners, np.float64)
    return layout.poses(exact)[rows, token], layout.flipped(exact)[rows, token]


def _strategies(agent: AgentConfig, count: int, generator: np.random.Generator) -> Ints:
    """(M,) 0 for the goal that was played, i for the i-th twin."""
    copies = [twin.copies if twin.strategy != "none" else 0 for twin in agent.hindsight]
    parts = np.array([1, *copies])
    return generator.choice(len(parts), size=count, p=parts / parts.sum())


def _same_shapes(layout: Layout) -> list[Ints]:
    """For each token the pieces of its own shape."""
    names = np.array([shape.name for shape in layout.shapes])
    return [np.flatnonzero(names == name) for name in names]
