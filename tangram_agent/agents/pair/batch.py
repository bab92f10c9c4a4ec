"""Transitions as pairs of a token and a piece of the target, with the goals of hindsight.

Legend: M pairs, K tokens, V corners.
"""

from dataclasses import dataclass

import numpy as np

from tangram_agent.agents.pair.coverage import Lying, covered_share, covering, lying, newly_covered
from tangram_agent.base.config import RelabelConfig
from tangram_agent.base.relabelling import spread
from tangram_agent.base.types import Flags, Transitions
from tangram_core.arrays import Bools, Floats, Ints, Singles
from tangram_sim.geometry.layout import Layout
from tangram_sim.motion.actions import chosen_tokens

_PAIRS = 8  # of a transition of several tokens in one update
_CORRECTED = 0.25  # share of pairs that begin where the action ended
_OTHER_SHAPE = 0.15  # share of hindsight pieces that have any shape, not the token's
_OTHER_SIDE = 0.1  # share of hindsight pieces on the other side than the token
_COVERED = 0.3  # share of hindsight pieces that are covered in part already


@dataclass(frozen=True, eq=False)
class PairBatch:
    """M pairs as they were before and after an action, and what that is worth.

    Attributes:
        before, after: (M, 3) poses of the token.
        start: (M, 3) where the actor is asked from: mostly before, else where it came to, to mend
            what it proposed itself: nobody plays that, as starts are far from targets.
        before_flipped, after_flipped, start_flipped: (M,) whether it lay on its other side.
        velocity: (M, 3) of the action.
        token: (M,) which moved.
        goal: (M, 3) pose of the target's piece.
        goal_flipped: (M,) its side.
        piece: (M,) its index.
        covered: (M,) share of the piece that was covered before the action.
        reward: (M,) what the action is worth: with several tokens what the token covers newly of
            the piece, over the larger of both areas; with one the environment's reward.
        done: (M,) 1 where nothing follows.
    """

    before: Floats
    after: Floats
    start: Floats
    before_flipped: Bools
    after_flipped: Bools
    start_flipped: Bools
    velocity: Singles
    token: Ints
    goal: Floats
    goal_flipped: Bools
    piece: Ints
    covered: Floats
    reward: Floats
    done: Flags


def make_pairs(
    batch: Transitions,
    layout: Layout,
    hindsight: tuple[RelabelConfig, ...],
    generator: np.random.Generator,
) -> PairBatch:
    """Pairs of a batch of transitions.

    One token and its piece are the whole scene: each transition is a pair, with the goal that it
    has in the replay and the environment's reward for that. With several tokens each transition
    gives `_PAIRS`, of the token that moved and any piece, a share of them with the
    goals that were played, the rest with those of hindsight: as many parts as there are copies.
    """
    several = layout.tokens > 1
    each = _PAIRS if several else 1
    rows = np.repeat(np.arange(batch.count), each)
    token = chosen_tokens(batch.action.astype(np.float64), layout.tokens)[rows]
    before = lying(batch.state, layout, rows, token)
    after = lying(batch.next_state, layout, rows, token)
    if several:
        strategy = _strategies(hindsight, len(rows), generator)
        piece, covered = _played(batch, layout, rows, token, generator)
        _Relabelled(hindsight, layout, generator).replace(piece, covered, after, strategy)
        reward, done = newly_covered(after, piece, covered, layout), np.ones(len(rows), np.uint8)
    else:
        piece, covered = lying(batch.goal, layout, rows, token), np.zeros(len(rows))
        # Most goals are where the token came to lie: else it would know them by its own turn.
        piece.pose[:, 2] += _alike(piece.index, layout, generator)
        reward, done = batch.reward.astype(np.float64), batch.done
    again = generator.random(len(rows)) < _CORRECTED
    start = after.instead(before, ~again)
    return PairBatch(
        before=before.pose,
        after=after.pose,
        start=start.pose,
        before_flipped=before.flipped,
        after_flipped=after.flipped,
        start_flipped=start.flipped,
        velocity=batch.action[rows, -3:],
        token=token,
        goal=piece.pose,
        goal_flipped=piece.flipped,
        piece=piece.index,
        covered=covered,
        reward=reward,
        done=done,
    )


def _alike(piece: Ints, layout: Layout, generator: np.random.Generator) -> Floats:
    """(M,) any of the turns by which pieces (M,) look the same."""
    order = np.array([shape.symmetry for shape in layout.shapes])[piece]
    turn: Floats = 2.0 * np.pi / order * generator.integers(order)
    return turn


def _strategies(
    hindsight: tuple[RelabelConfig, ...], count: int, generator: np.random.Generator
) -> Ints:
    """(M,) 0 for the goal that was played, i for the i-th kind of hindsight."""
    parts = np.array([1, *(relabel.copies for relabel in hindsight)])
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

    def __init__(
        self,
        hindsight: tuple[RelabelConfig, ...],
        layout: Layout,
        generator: np.random.Generator,
    ) -> None:
        self._layout, self._generator = layout, generator
        # One row per strategy, the goal that was played first.
        self._spread = np.array([(0.0, 0.0, 0.0), *map(spread, hindsight)])

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
        goal[:, 2] += _alike(piece, self._layout, self._generator)
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
