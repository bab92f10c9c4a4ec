"""Transitions as pairs of a token and a piece of the target, with hindsight goals.

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

_PAIRS = 8  # pairs that a transition of several tokens gives in an update
_CORRECTED = 0.25  # share of pairs that begin where the action ended
_OTHER_SHAPE = 0.15  # share of hindsight pieces that have any shape, not the token's
_OTHER_SIDE = 0.1  # share of hindsight pieces on the other side than the token
_COVERED = 0.3  # share of hindsight pieces that are covered in part already


@dataclass(frozen=True, eq=False)
class PairBatch:
    """M pairs before and after an action, and the value of the action.

    Attributes:
        before, after: the moved token before and after the action.
        start: the token for which the actor proposes a velocity, mostly as before the action. A
            share is as after it: so the actor learns to correct its own proposals.
        velocity: (M, 3) of the action.
        piece: the piece of the target.
        covered: (M,) share of the piece that was covered before the action.
        reward: (M,) value of the action: with one token the environment's reward; with several the
            newly covered area of the piece, over the larger area of token and piece.
        done: (M,) 1 where the target does not count the next state.
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

    With one token each transition is one pair, with its goal and reward in the replay buffer. With
    several tokens each transition gives `_PAIRS` pairs of the moved token and a random piece. One
    part of the pairs has the played goals. Each kind of hindsight has as many parts as copies.
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
        # A random piece of the played goals, and the share that other tokens covered before.
        piece = lying(batch.goal, layout, rows, generator.integers(layout.tokens, size=len(rows)))
        table = covered_share(covering(batch.state, batch.goal, layout), layout)
        covered = table[rows, token, piece.index]
        _relabel(piece, covered, after, strategy, hindsight, layout, generator)
        reward, done = newly_covered(after, piece, covered, layout), np.ones(len(rows), np.uint8)
    else:
        piece, covered = lying(batch.goal, layout, rows, token), np.zeros(len(rows))
        # Most hindsight goals are the token's own pose: without a random symmetric turn the actor
        # would know them by their angle.
        piece.pose[:, 2] += _alike(piece.index, layout, generator)
        reward, done = batch.reward.astype(np.float64), batch.done
    start = after.instead(before, generator.random(len(rows)) >= _CORRECTED)
    velocity = batch.action[rows, -3:]
    return PairBatch(before, after, start, velocity, piece, covered, reward, done)


def _alike(piece: Ints, layout: Layout, generator: np.random.Generator) -> Floats:
    """Random turns (M,) after which pieces (M,) look the same."""
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
    """Replace pieces (M,) by hindsight pieces at the token's new pose, or near it.

    Strategy (M,) is the number of the kind of hindsight; 0 keeps the piece. Most new pieces have
    the token's shape and side, and nothing of them is covered.
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
