"""Refine poses of tokens by their edges in a picture, to a fraction of a pixel.

On a short line across an edge, the covered length gives the position of the edge, even if it is
blurred. All lines of a token together are a least-squares problem in x, y and turn.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from tangram_core.arrays import Bools, Floats, Ints, Singles
from tangram_vision.pictures.kinds import Kind, lines_of

WIDE, NARROW = 3.0, 2.0  # pixels of a line on each side of an edge, at first and at last
_ROUNDS = (WIDE, WIDE, WIDE, NARROW, NARROW)


class Outlines:
    """Short lines across the edges of several tokens.

    Attributes:
        z: (M, J) samples of all lines, as complex numbers in the body frame of their tokens.
        owner: (M,) number of each line's token.
    """

    def __init__(self, kinds: Sequence[Kind], reach: float) -> None:
        every = [lines_of(kind, reach) for kind in kinds]
        counts = [len(lines.x) for lines in every]
        self.z = np.concatenate([lines.x + 1j * lines.y for lines in every])
        self.owner: Ints = np.repeat(np.arange(len(kinds)), counts)
        self.expected = np.concatenate([lines.expected for lines in every])
        self.change = np.concatenate([lines.change for lines in every])
        self._solve = np.concatenate([lines.solve for lines in every], axis=1)
        self._starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
        self._counts = np.array(counts)

    def off(self, poses: Floats, cover: Singles, base: Ints) -> Floats:
        """(M,) covered length of each line minus the expected length, in pixels.

        Args:
            poses: (N, 3) poses of the tokens; x and y in pixels from the picture's upper left
                corner, y up.
            cover: pictures (P, P) of coverage, one below the other.
            base: (N,) first row of each token's picture.
        """
        pixels = cover.shape[1]
        place = (poses[:, 0] + 1j * poses[:, 1])[self.owner]
        z = self.z * np.exp(1j * poses[:, 2])[self.owner][:, None] + place[:, None]
        column = np.clip(z.real - 0.5, 0, pixels - 1).astype(np.float32)
        row = np.clip(-z.imag - 0.5, 0, pixels - 1) + base[self.owner][:, None]
        level = cv2.remap(cover, column, row.astype(np.float32), cv2.INTER_LINEAR)
        off: Floats = level.sum(axis=1) * 0.5 - self.expected
        return off

    def move(self, poses: Floats, off: Floats) -> Floats:
        """Poses (N, 3) after one least-squares step; `off` (M,) holds the errors of the lines."""
        step = np.add.reduceat(self._solve * off, self._starts, axis=1).T
        return self._stepped(poses, step)

    def move_seen(self, poses: Floats, off: Floats, seen: Bools) -> Floats:
        """Poses (N, 3) after a least-squares step by visible lines alone, where `seen` (M,)."""
        change = self.change * seen[:, None]
        matrix = np.add.reduceat(change[:, :, None] * change[:, None], self._starts, axis=0)
        right = np.add.reduceat(change * off[:, None], self._starts, axis=0)
        trace = np.trace(matrix, axis1=1, axis2=2)
        # Regularised: if only one edge is seen, the position along it is unknown.
        matrix += (1e-3 * trace + 1e-9)[:, None, None] * np.eye(3)
        return self._stepped(poses, np.linalg.solve(matrix, right[..., None])[..., 0])

    def _stepped(self, poses: Floats, step: Floats) -> Floats:
        shift = (step[:, 0] + 1j * step[:, 1]) * np.exp(1j * poses[:, 2])
        stepped: Floats = poses + np.column_stack([shift.real, shift.imag, step[:, 2]])
        return stepped

    def spread(self, off: Floats) -> Floats:
        """(N,) root mean square of each token's line errors, in pixels."""
        squares: Floats = np.sqrt(np.add.reduceat(off**2, self._starts) / self._counts)
        return squares


def refined(
    kinds: Sequence[Kind], poses: Floats, cover: Singles, base: Ints
) -> tuple[Floats, Floats]:
    """Refined poses (N, 3) from rough ones, and their remaining errors (N,) in pixels."""
    outlines = {reach: Outlines(kinds, reach) for reach in set(_ROUNDS)}
    for reach in _ROUNDS:
        lines = outlines[reach]
        poses = lines.move(poses, lines.off(poses, cover, base))
    lines = outlines[NARROW]
    return poses, lines.spread(lines.off(poses, cover, base))
