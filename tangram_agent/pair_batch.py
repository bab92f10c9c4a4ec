"""From transitions to pairs that actor and critic learn from, with hindsight for several tokens.

Each transition gives some pairs of the token that moved and one piece of the target. The piece is
that of the goal that was played, or in hindsight one of the token's own shape where the token came
to lie, or near it (Sec. III-B for one piece). What the token newly covers of it is computed anew.

Legend: B transitions, P pairs of each, M = B * P, K tokens.
"""

from dataclasses import dataclass

import numpy as np

from tangram_agent.config import AgentConfig
from tangram_agent.pair_values import (
    Lying,
    covered_share,
    covering,
    lying,
    newly_covered,
    pushed_share,
)
from tangram_agent.types import Transitions
from tangram_sim.actions import chosen_tokens
from tangram_sim.arrays import Bools, Floats, Ints
from tangram_sim.layout import Layout

_CORRECTED = 0.25  # share of pairs that begin where the action ended
_OTHER_SHAPE = 0.15  # share of hindsight pieces that have any shape, not the token's
_OTHER_SIDE = 0.1  # share of hindsight pieces on the other side than the token
_COVERED = 0.3  # share of hindsight pieces that are covered in part already


@dataclass(frozen=True, eq=False)
class PairBatch:
    """M pairs as they were before and after an action, and its value.

    Attributes:
        before, after: (M, 3) poses of the token.
        start: (M, 3) where the actor is asked from: mostly before, else after.
        before_flipped, after_flipped, start_flipped: (M,) whether it lay on its other side.
        token: (M,) which moved.
        goal: (M, 3) pose of the target's piece.
        goal_flipped: (M,) its side.
        piece: (M,) its index.
        covered: (M,) share of the piece that was covered before the action.
        value: (M,) what the token covers newly of it, over the larger of both areas.
    """

    before: Floats
    after: Floats
    start: Floats
    before_flipped: Bools
    after_flipped: Bools
    start_flipped: Bools
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
    before = lying(batch.state, layout, rows, token)
    after = lying(batch.next_state, layout, rows, token)
    strategy = _strategies(agent, len(rows), generator)
    piece, covered = _played(batch, layout, rows, token, generator)
    _Relabelled(agent, layout, generator).replace(piece, covered, after, strategy)
    start = _again(before, after, generator)
    return PairBatch(
        before=before.pose,
        after=after.pose,
        start=start.pose,
        before_flipped=before.flipped,
        after_flipped=after.flipped,
        start_flipped=start.flipped,
        token=token,
        goal=piece.pose,
        goal_flipped=piece.flipped,
        piece=piece.index,
        covered=covered,
        value=newly_covered(after, piece, covered, layout),
    )


def with_contacts(
    pairs: PairBatch, batch: Transitions, layout: Layout, generator: np.random.Generator
) -> ContactBatch:
    """The same pairs, with what their action did to another token, drawn uniformly."""
    rows = np.repeat(np.arange(batch.count), len(pairs.token) // batch.count)
    other = (pairs.token + generator.integers(1, layout.tokens, len(rows))) % layout.tokens
    before = lying(batch.state, layout, rows, other)
    after = lying(batch.next_state, layout, rows, other)
    return ContactBatch(
        **vars(pairs),
        other=other,
        other_pose=before.pose,
        other_flipped=before.flipped,
        pushed=pushed_share(before, after, layout),
    )


def _again(before: Lying, after: Lying, generator: np.random.Generator) -> Lying:
    """Where tokens (M,) are for the actor: mostly before the action, else after it.

    From there it corrects what it proposed itself, which nobody plays: starts are far from targets.
    """
    again = generator.random(len(before.index)) < _CORRECTED
    return Lying(
        before.index,
        np.where(again[:, None], after.pose, before.pose),
        np.where(again, after.flipped, before.flipped),
    )


def _strategies(agent: AgentConfig, count: int, generator: np.random.Generator) -> Ints:
    """(M,) 0 for the goal that was played, i for the i-th twin."""
    copies = [twin.copies if twin.strategy != "none" else 0 for twin in agent.hindsight]
    parts = np.array([1, *copies])
    return generator.choice(len(parts), size=count, p=parts / parts.sum())


def _played(
    batch: Transitions, layout: Layout, rows: Ints, token: Ints, generator: np.random.Generator
) -> tuple[Lying, Floats]:
    """Any piece (M,) of the goals that were played, and what others covered of it before (M,)."""
    piece = generator.integers(layout.tokens, size=len(rows))
    table = covering(batch.state, batch.goal, layout)
    return lying(batch.goal, layout, rows, piece), covered_share(table, layout)[rows, token, piece]


class _Relabelled:
    """Goals of hindsight: pieces where the token came to lie, or near."""

    def __init__(self, agent: AgentConfig, layout: Layout, generator: np.random.Generator) -> None:
        self._layout, self._generator = layout, generator
        self._symmetry = np.array([shape.symmetry for shape in layout.shapes])
        # One row per strategy, the goal that was played first.
        spreads = [(twin.position, twin.position, twin.angle) for twin in agent.hindsight]
        near = [twin.strategy == "near" for twin in agent.hindsight]
        self._spread = np.array([(0.0, 0.0, 0.0), *spreads]) * np.array([0.0, *near])[:, None]

    def replace(self, piece: Lying, covered: Floats, after: Lying, strategy: Ints) -> None:
        """Put hindsight in the place of the pieces (M,) whose strategy is not to keep them."""
        hind = np.flatnonzero(strategy)
        index = self._pieces(after.index[hind], piece.index[hind])
        piece.index[hind] = index
        piece.pose[hind] = self._goals(after.pose[hind], index, strategy[hind])
        piece.flipped[hind] = self._sides(after.flipped[hind], index)
        covered[hind] = self._covered(len(hind))

    def _pieces(self, token: Ints, other: Ints) -> Ints:
        """(M,) mostly a piece of the token's own shape, else the other one."""
        alike, counts = _same_shapes(self._layout)
        own = alike[token, self._generator.integers(counts[token])]
        return np.where(self._generator.random(len(token)) < _OTHER_SHAPE, other, own)

    def _goals(self, after: Floats, piece: Ints, strategy: Ints) -> Floats:
        """(M, 3) at the achieved pose or near it, at any of the turns that look alike."""
        draw = self._generator.standard_normal(after.shape) * self._spread[strategy]
        goal: Floats = after + draw
        order = self._symmetry[piece]
        goal[:, 2] += 2.0 * np.pi / order * self._generator.integers(order)
        return goal

    def _sides(self, after: Bools, piece: Ints) -> Bools:
        """(M,) mostly the token's own side, where the piece has two."""
        other = self._generator.random(len(piece)) < _OTHER_SIDE
        return np.asarray((after ^ other) & self._layout.chiral[piece])

    def _covered(self, count: int) -> Floats:
        """(M,) mostly nothing, else any share."""
        share = self._generator.random(count)
        return np.where(self._generator.random(count) < _COVERED, share, 0.0)


def _same_shapes(layout: Layout) -> tuple[Ints, Ints]:
    """For each token the pieces of its own shape, first in a row (K, K), and their number (K,)."""
    names = np.array([shape.name for shape in layout.shapes])
    alike = names[:, None] == names
    return np.argsort(~alike, axis=1, kind="stable"), alike.sum(axis=1)
