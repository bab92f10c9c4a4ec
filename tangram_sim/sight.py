"""What an agent sees where pictures are its only source: tokens as they were found, and which not.

What is found has no name: of tokens that look alike, each is taken for the one that lay nearest
when the agent looked last. So an agent's tokens need not be the world's, see `Sight.hands`.

Legend: B environments, K tokens, V corners, P pixels along a side of a picture.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tangram_sim.arrays import Bools, Floats, Ints, Pixels
from tangram_sim.layout import Layout


@dataclass(frozen=True, eq=False)
class Look:
    """What one picture shows.

    Attributes:
        corners: (V, 2) of the tokens, alike ones in any order.
        known: (K,) those that lie somewhere as far as is known; the corners of others say nothing.
        sure: (K,) those that surely lie there.
    """

    corners: Floats
    known: Bools
    sure: Bools


class Eye(Protocol):
    """Finds tokens in a picture (P, P)."""

    def __call__(self, picture: Pixels, /) -> Look: ...  # noqa: D102


class Sight:
    """What is seen of B environments.

    Attributes:
        corners: (B, V, 2) of the tokens; of one that is missing where it lay last, or in the middle
            of the arena.
        missing: (B, K) tokens that are not found, or not surely.
        goals: (B, V, 2) of the target; a piece that is missing lies where its token began.
        goals_missing: (B, K) pieces of the target, alike.
    """

    def __init__(self, layout: Layout, eye: Eye, count: int) -> None:
        self._layout, self._eye = layout, eye
        names = [shape.name for shape in layout.shapes]
        self._alike = [
            np.array([token for token, own in enumerate(names) if own == name])
            for name in dict.fromkeys(names)
        ]
        middle = layout.corners(np.zeros((layout.tokens, 3)))
        self.corners: Floats = np.repeat(middle[None], count, axis=0)
        self.missing: Bools = np.ones((count, layout.tokens), np.bool_)
        self.goals: Floats = self.corners.copy()
        self.goals_missing: Bools = self.missing.copy()
        self._middle = middle

    def begin(self, targets: Pixels, states: Pixels) -> None:
        """Look at pictures (B, P, P) of targets and starts."""
        # What the world holds is a copy of this: a row is never changed in place.
        self.corners, self.missing = self.corners.copy(), self.missing.copy()
        self.goals, self.goals_missing = self.corners.copy(), self.missing.copy()
        for b, (target, state) in enumerate(zip(targets, states, strict=True)):
            self.corners[b], self.missing[b] = self._middle, True
            self._take(b, self._eye(state), moved=None)
            wanted = self._eye(target)
            gone = ~(wanted.known & wanted.sure)
            corner_gone = gone[self._layout.token_of_corner]
            self.goals[b] = np.where(corner_gone[:, None], self.corners[b], wanted.corners)
            self.goals_missing[b] = gone

    def follow(self, states: Pixels, moved: Sequence[int]) -> None:
        """Look at pictures (B, P, P) after tokens (B,) have moved, as the agent names them."""
        self.corners, self.missing = self.corners.copy(), self.missing.copy()
        for b, (state, token) in enumerate(zip(states, moved, strict=True)):
            self._take(b, self._eye(state), token)

    def hands(self, tokens: Ints, corners: Floats) -> Ints:
        """(B,) which tokens of the world lie where the agent sees tokens (B,): those it would grab.

        Args:
            tokens: as the agent names them.
            corners: (B, V, 2) as they are.
        """
        found = tokens.copy()
        seen, true = self._layout.bases(self.corners), self._layout.bases(corners)
        for b, token in enumerate(tokens.tolist()):
            alike = next(own for own in self._alike if token in own)
            if len(alike) > 1:
                here, there = seen[b, alike], true[b, alike]
                first = [i for i, missing in enumerate(self.missing[b, alike]) if not missing]
                of = _nearest(here, there, first)
                found[b] = alike[of[int(np.flatnonzero(alike == token)[0])]]
        return found

    def _take(self, b: int, look: Look, moved: int | None) -> None:
        """Take over what was seen of an environment."""
        layout = self._layout
        before, now = layout.bases(self.corners[b]), layout.bases(look.corners)
        corners, missing = self.corners[b].copy(), np.ones(layout.tokens, np.bool_)
        for alike in self._alike:
            shown = alike[look.known[alike]]
            # Those that did not move say which one did.
            still = [i for i, one in enumerate(alike) if one != moved and not self.missing[b, one]]
            of = _nearest(before[alike], now[shown], still)
            for i, token in enumerate(alike.tolist()):
                if of[i] < len(shown):
                    one = int(shown[of[i]])
                    corners[layout.corners_of(token)] = look.corners[layout.corners_of(one)]
                    missing[token] = not look.sure[one]
        self.corners[b], self.missing[b] = corners, missing


def _nearest(places: Floats, others: Floats, first: Sequence[int]) -> list[int]:
    """For each of places (n, 2) another one of others (m, 2), nearest first; m where none is left.

    Args:
        places: of n things.
        others: of m things.
        first: those of the n that choose before the rest does.
    """
    far = np.linalg.norm(places[:, None] - others[None], axis=-1)
    chosen = [len(others)] * len(places)
    left = set(range(len(others)))
    for group in (list(first), [i for i in range(len(places)) if i not in first]):
        while group and left:
            _, i, j = min((far[i, j], i, j) for i in group for j in left)
            chosen[i] = j
            group.remove(i)
            left.remove(j)
    return chosen
