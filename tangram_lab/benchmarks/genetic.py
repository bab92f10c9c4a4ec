"""A rival of the search: a genetic algorithm over the places of an outline's tokens.

A child takes the tokens that lie on one side of a random line from one parent, and those on the
other side from another (cut and splice). Then some tokens are taken up, one after the other, and
laid where the best of some tries says, with noise (mutation). It replaces the first parent where it
is no worse: so parents stay different from each other (crowding). Where all stagnate, all begin
anew.
"""

from dataclasses import dataclass

import numpy as np

from tangram_lab.benchmarks.covering import Attempt, Board, States
from tangram_sim.arrays import Ints
from tangram_vision.silhouettes import Filled


@dataclass(frozen=True)
class Breeding:
    """How they breed.

    Attributes:
        states: B, parents.
        tries: M of a token that mutates.
        mutations: tokens of a child.
        crossed: share of children that have two parents.
        rivals: of which the best becomes the second parent.
        noise: of tries, shares of the outline.
        patience: generations without a better one.
    """

    states: int = 32
    tries: int = 8
    mutations: int = 2
    crossed: float = 0.5
    rivals: int = 2
    noise: float = 0.005
    patience: int = 200


def bred(attempt: Attempt, rng: np.random.Generator, way: Breeding = Breeding()) -> Filled:
    """The best filling that was found, as soon as it counts as one."""
    board, shape = attempt.board, (way.states, way.tries)
    while True:
        parents = board.random(way.states, rng)
        left, least, since = parents.uncovered(), 1.0, 0
        while since < way.patience:
            rivals = rng.integers(way.states, size=(way.states, way.rivals))
            others = rivals[np.arange(way.states), left[rivals].argmin(axis=1)]
            others = np.where(rng.random(way.states) < way.crossed, others, np.arange(way.states))
            children = _spliced(board, parents, others, rng)
            for _ in range(way.mutations):
                tokens = rng.integers(board.layout.tokens, size=way.states)
                tries = board.tries(children, tokens, way.tries, rng)
                drawn = tries.gain + way.noise * rng.gumbel(size=shape)
                children.lay(tokens, tries, drawn.argmax(axis=1))
                attempt.evaluations += tries.gain.size
            found = children.uncovered()
            parents.replace(found <= left, children)
            left = np.minimum(left, found)
            since = 0 if left.min() < least else since + 1
            least = float(left.min())
            if attempt.look(parents):
                return attempt.result()


def _spliced(board: Board, parents: States, others: Ints, rng: np.random.Generator) -> States:
    """Children of all parents and the others (B,), cut along a line through the outline."""
    count = len(others)
    across = np.exp(2j * np.pi * rng.random((count, 1)))
    beside = (parents.place - rng.choice(board.points, (count, 1))) * across.conj()
    kept = beside.real > 0.0
    return States(
        np.where(kept, parents.place, parents.place[others]),
        np.where(kept, parents.lie, parents.lie[others]),
        np.where(kept[..., None], parents.masks, parents.masks[others]),
    )
