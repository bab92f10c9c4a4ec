"""What tokens cover of a target's pieces: the exact geometry that critics for several tokens learn.

Legend: B scenes, M single pieces, K tokens, V corners of all tokens, C of the largest.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tangram_sim.arrays import Bools, Floats, Ints
from tangram_sim.geometry import outlines, shared_area
from tangram_sim.layout import Layout

Corners = npt.NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class Lying:
    """M single tokens, or pieces of targets, as they lie.

    Attributes:
        index: (M,) which of the layout's tokens.
        pose: (M, 3).
        flipped: (M,) whether it lies on its other side.
    """

    index: Ints
    pose: Floats
    flipped: Bools

    def outlines(self, layout: Layout) -> Floats:
        """Counter-clockwise corners (M, C, 2)."""
        body = layout.body[layout.padded_corners][self.index]
        body = np.where(self.flipped[:, None, None], body[:, ::-1] * (1.0, -1.0), body)
        cos, sin = np.cos(self.pose[:, 2:]), np.sin(self.pose[:, 2:])
        x, y = body[..., 0], body[..., 1]
        turned = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
        moved: Floats = turned + self.pose[:, None, :2]
        return moved


def lying(corners: Corners, layout: Layout, rows: Ints, index: Ints) -> Lying:
    """One token (M,) of each of the scenes (M,) among corners (B, V, 2)."""
    exact = np.asarray(corners, np.float64)
    return Lying(index, layout.poses(exact)[rows, index], layout.flipped(exact)[rows, index])


def covering(corners: Corners, goals: Corners, layout: Layout) -> Floats:
    """(B, K, K) area of piece j that token i covers where it lies, placed or not.

    Args:
        corners: (B, V, 2) of the tokens; with noise, of the pieces that fit them best.
        goals: (B, V, 2) of the targets.
        layout: of both.
    """
    count = layout.tokens
    own = np.repeat(_fitted(corners, layout), count, axis=1)
    wanted = np.tile(_fitted(goals, layout), (1, count, 1, 1))
    shape = (-1, *own.shape[2:])
    shared = shared_area(wanted.reshape(shape), own.reshape(shape))
    return shared.reshape(-1, count, count)


def covered_share(covered: Floats, layout: Layout) -> Floats:
    """(B, K, K) share of piece j that tokens other than i cover, by what `covering` gave.

    So a token that is to move is seen as if it were gone.
    """
    others = covered.sum(axis=1, keepdims=True) - covered
    share: Floats = np.clip(others / areas(layout), 0.0, 1.0)
    return share


def worths(covered: Floats, layout: Layout) -> Floats:
    """(B, K) sum over all pieces of each token's values, by what `covering` gave."""
    own = areas(layout)
    worth: Floats = (covered / np.maximum(own[:, None], own)).sum(axis=2)
    return worth


def newly_covered(token: Lying, piece: Lying, covered: Floats, layout: Layout) -> Floats:
    """(M,) the area of a piece that a token covers and nothing covered before, as a value.

    Over the larger of both areas: over the token's own a small one inside of a large piece would
    be worth as much as the right one. Where a piece is covered in part, what the token covers is
    taken to be what is left first.

    Args:
        token: M tokens.
        piece: the piece of the target for each.
        covered: (M,) share of it that is covered already, in [0, 1].
        layout: of both.
    """
    own, wanted = areas(layout)[token.index], areas(layout)[piece.index]
    shared = shared_area(piece.outlines(layout), token.outlines(layout))
    value: Floats = np.minimum(shared, (1.0 - covered) * wanted) / np.maximum(own, wanted)
    return value


def pushed_share(before: Lying, after: Lying, layout: Layout) -> Floats:
    """(M,) share of tokens' areas that does not lie where it lay before."""
    kept = shared_area(before.outlines(layout), after.outlines(layout))
    share: Floats = np.clip(1.0 - kept / areas(layout)[before.index], 0.0, 1.0)
    return share


def areas(layout: Layout) -> Floats:
    """(K,) areas of the tokens."""
    return np.array([shape.area for shape in layout.shapes])


def _fitted(corners: Corners, layout: Layout) -> Floats:
    """Outlines (B, K, C, 2) of the exact pieces that fit corners (B, V, 2) best."""
    seen = np.asarray(corners, np.float64)
    return outlines(layout.corners(layout.poses(seen), layout.flipped(seen)), layout)
