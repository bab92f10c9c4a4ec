"""Perception from pictures alone: which tokens were found and where, and which are missing.

A picture has no names. Among equal tokens, a found one is taken for the token that was nearest to
its place in the picture before. So an agent's indices of tokens can differ from the world's, see
`Sight.hands`. A symmetric token looks the same at several angles. Of these the one nearest to the
commanded rotation is taken.

Legend: B environments, K tokens, V corners, P pixels along a side of a picture.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tangram_core.arrays import Bools, Floats, Ints, Pixels
from tangram_sim.geometry.layout import Layout

_STILL = 0.03  # smaller motions count as none: radians, and share of a token's radius


@dataclass(frozen=True, eq=False)
class Look:
    """Tokens found in one picture.

    Attributes:
        poses: (K, 3) x, y and angle of the tokens; equal tokens have any order.
        flipped: (K,) tokens that are turned over.
        known: (K,) tokens with a possible pose; the poses of the others mean nothing.
        sure: (K,) known tokens that can have no other pose.
    """

    poses: Floats
    flipped: Bools
    known: Bools
    sure: Bools


Eye = Callable[[Pixels], Look]  # finds tokens in a picture (P, P)


class Sight:
    """Tokens and targets as found in pictures of B environments.

    Attributes:
        corners: (B, V, 2) of the tokens. A token that is not found keeps its last pose, moved as
            commanded; before it is first found, this is the middle of the arena.
        missing: (B, K) tokens that are not found, or not surely.
        away: (B, K) missing tokens whose estimated pose reaches out of the picture.
        goals: (B, V, 2) of the target; a piece that is not found gets its token's first pose.
        goals_sure: (B, K) target pieces that are surely found.
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
        """Look at the first pictures of an episode.

        Args:
            targets: (B, P, P) of the targets; ignored if `goals` are given.
            states: (B, P, P) of the tokens.
            goals: (B, V, 2) as an earlier look found them; None: find them in `targets`.
            named: (B, K, 3) earlier poses of the tokens, to tell equal ones apart.
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
            known = look.known  # an unsure piece, too: the target covers its place
            poses[b, known], flipped[b, known] = look.poses[known], look.flipped[known]
            sure[b] = look.sure
        self.goals, self.goals_sure = self._layout.corners(poses, flipped), sure

    def follow(self, states: Pixels, moved: Ints, ways: Floats) -> None:
        """Look at pictures (B, P, P) after tokens `moved` (B,) have moved.

        `moved` are the agent's indices, `ways` (B, 3) the commanded motions: x, y and angle.
        """
        # A copy: arrays handed out before must not change.
        self.missing = self.missing.copy()
        for b, (state, token) in enumerate(zip(states, moved.tolist(), strict=True)):
            self._take(b, self._eye(state), token, ways[b])
        self.corners = self._layout.corners(self._poses, self._flipped)
        beyond = np.abs(self.corners).max(axis=2) > self._half
        out = np.logical_or.reduceat(beyond, self._layout.starts[:-1], axis=1)
        self.away = self.missing & out

    def hands(self, tokens: Ints, corners: Floats) -> Ints:
        """Indices (B,) in the world of the tokens (B,) that the agent names: those it would grab.

        `corners` (B, V, 2) are the exact ones.
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
        """Update the poses of one environment after a token was commanded to move by `way` (3,)."""
        missing, gone = np.ones_like(self.missing[b]), self.missing[b]
        for alike in self._alike:
            shown = alike[look.known[alike]]
            # Match tokens that did not move first: the one left over has moved.
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
        """A found pose (3,), with the likeliest of the angles that look the same."""
        before, step = self._poses[b, token], 2.0 * np.pi / self._layout.symmetries[token]
        way = pose - before
        stayed = way[2] - step * np.round(way[2] / step)
        # A token that looks as before did not move, whatever the command.
        if np.hypot(*way[:2]) > _STILL * self._layout.radii[token] or abs(stayed) > _STILL:
            stayed = way[2] - step * np.round((way[2] - told) / step)
        return np.array([*pose[:2], before[2] + stayed])


def _nearest(places: Floats, others: Floats, first: Sequence[int]) -> list[int]:
    """Match places (n, 2) to different ones of others (m, 2), nearest pairs first.

    Places in `first` are matched before the rest. The result is m for a place without a match.
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
