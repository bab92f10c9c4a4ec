"""Transitions as pairs of a token and a piece of the target, with the goals of hindsight.

Legend: M pairs, K tokens, V corners.
"""

from dataclasses import dataclass

import numpy as np

from tangram_agent.agents.pair.coverage import Lying, covered_share, covering, lying, newly_covered
from tangram_agent.base.config import RelabelConfig
from tangram_agent.base.relabelling import spread
from tangram_agent.base.types import Flags, Transitions
from tangram_core.arrays import Floats, Ints, Singles
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
        before, after: the token that moved.
        start: where the actor is asked from: mostly before, else where it came to, to mend what it
            proposed itself: nobody plays that, as starts are far from targets.
        velocity: (M, 3) of the action.
        piece: of the target.
        covered: (M,) share of the piece that was covered before the action.
        reward: (M,) what the action is worth: with several tokens what the token covers newly of
            the piece, over the larger of both areas; with one the environment's reward.
        done: (M,) 1 where nothing follows.
    """

    before: Lying
    after: Lying
    start: Lying
    velocity: Singles
    piece: Lying
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
        # One part for the goals that were played, then as many for each kind as it has copies.
        parts = np.array([1, *(relabel.copies for relabel in hindsight)])
        strategy = generator.choice(len(parts), size=len(rows), p=parts / parts.sum())
        # Any piece of the goals that were played, and what others covered of it before.
        piece = lying(batch.goal, layout, rows, generator.integers(layout.tokens, size=len(rows)))
        table = covered_share(covering(batch.state, batch.goal, layout), layout)
        covered = table[rows, token, piece.index]
        _relabel(piece, covered, after, strategy, hindsight, layout, generator)
        reward, done = newly_covered(after, piece, covered, layout), np.ones(len(rows), np.uint8)
    else:
        piece, covered = lying(batch.goal, layout, rows, token), np.zeros(len(rows))
        # Most goals are where the token came to lie: else it would know them by its own turn.
        piece.pose[:, 2] += _alike(piece.index, layout, generator)
        reward, done = batch.reward.astype(np.float64), batch.done
    start = after.instead(before, generator.random(len(rows)) >= _CORRECTED)
    velocity = batch.action[rows, -3:]
    return PairBatch(before, after, start, velocity, piece, covered, reward, done)


def _alike(piece: Ints, layout: Layout, generator: np.random.Generator) -> Floats:
    """(M,) any of the turns by which pieces (M,) look the same."""
    order = np.array([shape.symmetry for shape in layout.shapes])[piece]
    turn: Floats = 2.0 * np.pi / order * generator.integers(order)
    return turn


def _relabel(
    piece: Lying,
    covered: Floats,
    after: Lying,
    strategy: Ints,
    hindsight: tuple[RelabelConfig, ...],
    layout: Layout,
    generator: np.random.Generator,
) -> None:
    """Put hindsight in the place of pieces (M,): where the token came to lie, or near.

    Strategy i, (M,), is its i-th kind; 0 keeps the piece. Mostly it becomes one of the token's own
    shape and side, of which nothing is covered.
    """
    hind = np.flatnonzero(strategy)
    size, token = len(hind), after.index[hind]
    alike, counts = _same_shapes(layout)
    own = alike[token, generator.integers(counts[token])]
    index = np.where(generator.random(size) < _OTHER_SHAPE, piece.index[hind], own)
    deviations = np.array([(0.0, 0.0, 0.0), *map(spread, hindsight)])[strategy[hind]]
    pose = after.pose[hind] + generator.standard_normal((size, 3)) * deviations
    pose[:, 2] += _alike(index, layout, generator)
    other_side = generator.random(size) < _OTHER_SIDE
    share = generator.random(size)
    piece.index[hind], piece.pose[hind] = index, pose
    piece.flipped[hind] = (after.flipped[hind] ^ other_side) & layout.chiral[index]
    covered[hind] = np.where(generator.random(size) < _COVERED, share, 0.0)


def _same_shapes(layout: Layout) -> tuple[Ints, Ints]:
    """For each token the pieces of its own shape, first in a row (K, K), and their number (K,)."""
    names = np.array([shape.name for shape in layout.shapes])
    alike = names[:, None] == names
    return np.argsort(~alike, axis=1, kind="stable"), alike.sum(axis=1)
