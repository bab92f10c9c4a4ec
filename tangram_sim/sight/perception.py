"""What an agent sees where pictures are its only source: tokens as they were found, and which not.

What is found has no name: of tokens that look alike, each is taken for the one that lay nearest
when the agent looked last. So an agent's tokens need not be the world's, see `Sight.hands`. Nor is
it seen how far a token turned that looks alike after a part of a turn: it is taken to have turned
about as it was told.

Legend: B environments, K tokens, V corners, P pixels along a side of a picture.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tangram_core.arrays import Bools, Floats, Ints, Pixels
from tangram_sim.geometry.layout import Layout

_STILL = 0.03  # radians, and share of a token's radius, up to which nothing moved


@dataclass(frozen=True, eq=False)
class Look:
    """What one picture shows.

    Attributes:
        poses: (K, 3) x, y and angle of the tokens, alike ones in any order.
        flipped: (K,) which lie on their other side.
        known: (K,) which lie there, or could lie otherwise as well; poses of others say nothing.
        sure: (K,) those of them that surely lie there.
    """

    poses: Floats
    flipped: Bools
    known: Bools
    sure: Bools


Eye = Callable[[Pixels], Look]  # finds tokens in a picture (P, P)


class Sight:
    """What is seen of B environments.

    Attributes:
        corners: (B, V, 2) of the tokens; of one that is missing where it lay last, or was told to
            go, and before it was ever found in the middle of the arena.
        missing: (B, K) tokens that are not found, or not surely.
        away: (B, K) tokens not surely seen that should have left the picture by what they were
            told.
        goals: (B, V, 2) of the target; a piece that is not found lies where its token began.
        goals_sure: (B, K) which of its pieces are surely seen.
    """

    def __init__(self, layout: Layout, eye: Eye, count: int, arena: float) -> None:
        self._layout, self._eye, self._half = layout, eye, arena / 2.0
        names = [shape.name for shape in layout.shapes]
        self._alike = [
            np.array([token for token, own in enumerate(names) if own == name])
            for name in dict.fromkeys(names)
        ]
        self._poses: Floats = np.zeros((count, layout.tokens, 3))
        self._flipped: Bools = np.zeros((count, layout.tokens), np.bool_)
        self.missing: Bools = np.ones_like(self._flipped)
        self.away: Bools = np.zeros_like(self._flipped)
        self.corners: Floats = layout.corners(self._poses)
        self.goals, self.goals_sure = self.corners, ~self.missing

    def begin(
        self,
        targets: Pixels,
        states: Pixels,
        goals: Floats | None = None,
        named: Floats | float = 0.0,
    ) -> None:
        """Look at pictures (B, P, P) of targets and starts, or of starts where goals are known.

        Goals (B, V, 2) are as a look before has found them; by poses `named` (B, K, 3), where they
        are given, equal tokens are told apart.
        """
        self._poses[:], self._flipped[:] = named, False
        self.missing = np.ones_like(self.missing)
        count = len(self._poses)
        self.follow(states, np.zeros(count, np.int64), np.zeros((count, 3)))
        if goals is not None:
            self.goals, self.goals_sure = goals, np.ones_like(self.missing)
            return
        poses, flipped, sure = self._poses.copy(), self._flipped.copy(), ~self.missing
        for b, target in enumerate(targets):
            look = self._eye(target)
            known = look.known  # a piece that could lie otherwise as well is covered there, too
            poses[b, known], flipped[b, known] = look.poses[known], look.flipped[known]
            sure[b] = look.sure
        self.goals, self.goals_sure = self._layout.corners(poses, flipped), sure

    def follow(self, states: Pixels, moved: Ints, ways: Floats) -> None:
        """Look at pictures (B, P, P) after tokens (B,), as the agent names them, have moved.

        They were told to go ways (B, 3): x, y and turn.
        """
        # What was given away before stays as it is.
        self.missing = self.missing.copy()
        for b, (state, token) in enumerate(zip(states, moved.tolist(), strict=True)):
            self._take(b, self._eye(state), token, ways[b])
        self.corners = self._layout.corners(self._poses, self._flipped)
        beyond = np.abs(self.corners).max(axis=2) > self._half
        out = np.logical_or.reduceat(beyond, self._layout.starts[:-1], axis=1)
        self.away = self.missing & out

    def hands(self, tokens: Ints, corners: Floats) -> Ints:
        """(B,) which tokens of the world lie where the agent sees tokens (B,): those it would grab.

        The corners (B, V, 2) are as they are.
        """
        found, true = tokens.copy(), self._layout.bases(corners)
        for b, token in enumerate(tokens.tolist()):
            alike = next(own for own in self._alike if token in own)
            if len(alike) > 1:
                sure = np.flatnonzero(~self.missing[b, alike]).tolist()
                of = _nearest(self._poses[b, alike, :2], true[b, alike], sure)
                found[b] = alike[of[int(np.flatnonzero(alike == token)[0])]]
        return found

    def _take(self, b: int, look: Look, moved: int, way: Floats) -> None:
        """Take over what was seen of an environment, after a token was told to go a way (3,)."""
        missing, gone = np.ones_like(self.missing[b]), self.missing[b]
        for alike in self._alike:
            shown = alike[look.known[alike]]
            # Those that did not move say which one did.
            still = [i for i, one in enumerate(alike) if one != moved and not gone[one]]
            of = _nearest(self._poses[b, alike, :2], look.poses[shown, :2], still)
            for i, token in enumerate(alike.tolist()):
                if of[i] < len(shown):
                    one = int(shown[of[i]])
                    told = float(way[2]) if token == moved else 0.0
                    self._poses[b, token] = self._near(b, token, look.poses[one], told)
                    self._flipped[b, token] = look.flipped[one]
                    missing[token] = not look.sure[one]
                elif token == moved:
                    self._poses[b, token] += way
        self.missing[b] = missing

    def _near(self, b: int, token: int, pose: Floats, told: float) -> Floats:
        """A pose (3,) of a token at that of the turns that look alike which it made."""
        before, step = self._poses[b, token], 2.0 * np.pi / self._layout.symmetries[token]
        way = pose - before
        stayed = way[2] - step * np.round(way[2] / step)
        # What looks as before did not move, whatever it was told.
        if np.hypot(*way[:2]) > _STILL * self._layout.radii[token] or abs(stayed) > _STILL:
            stayed = way[2] - step * np.round((way[2] - told) / step)
        return np.array([*pose[:2], before[2] + stayed])


def _nearest(places: Floats, others: Floats, first: Sequence[int]) -> list[int]:
    """For each of places (n, 2) another one of others (m, 2), nearest first; m where none is left.

    Those of the n that are `first` choose before the rest does.
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
