"""What tokens cover of a target's pieces: the exact geometry that critics for several tokens learn.

Legend: B scenes, M single pieces, K tokens, V corners of all tokens, C of the largest.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tangram_core.arrays import Bools, Floats, Ints
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import outlines, outlines_at, shared_area, shared_areas

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

    def instead(self, others: "Lying", where: Bools) -> "Lying":
        """Others in the place of those where (M,) that is said, index for index the same."""
        pose = np.where(where[:, None], others.pose, self.pose)
        return Lying(self.index, pose, np.where(where, others.flipped, self.flipped))

    def outlines(self, layout: Layout) -> Floats:
        """Counter-clockwise corners (M, C, 2)."""
        body = layout.body[layout.padded_corners][self.index]
        return outlines_at(body, self.pose, self.flipped)


def lying(corners: Corners, layout: Layout, rows: Ints, index: Ints) -> Lying:
    """One token (M,) of each of the scenes (M,) among corners (B, V, 2)."""
    exact = np.asarray(corners, np.float64)
    return Lying(index, layout.poses(exact)[rows, index], layout.flipped(exact)[rows, index])


def covering(corners: Corners, goals: Corners, layout: Layout) -> Floats:
    """(B, K, K) area of piece j that token i covers where it lies, placed or not.

    Args:
        corners: (B, V, 2) of the tokens; from pictures, of the pieces that fit them best.
        goals: (B, V, 2) of the targets.
        layout: of both.
    """
    return shared_areas(_fitted(corners, layout), _fitted(goals, layout))


def covered_share(covered: Floats, layout: Layout) -> Floats:
    """(B, K, K) share of piece j that tokens other than i cover, by what `covering` gave.

    So a token that is to move is seen as if it were gone.
    """
    others = covered.sum(axis=1, keepdims=True) - covered
    share: Floats = np.clip(others / layout.areas, 0.0, 1.0)
    return share


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
    own, wanted = layout.areas[token.index], layout.areas[piece.index]
    shared = shared_area(piece.outlines(layout), token.outlines(layout))
    value: Floats = np.minimum(shared, (1.0 - covered) * wanted) / np.maximum(own, wanted)
    return value


def _fitted(corners: Corners, layout: Layout) -> Floats:
    """Outlines (B, K, C, 2) of the exact pieces that fit corners (B, V, 2) best."""
    seen = np.asarray(corners, np.float64)
    return outlines(layout.corners(layout.poses(seen), layout.flipped(seen)), layout)
