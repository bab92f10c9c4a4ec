"""Areas of a target's pieces that tokens cover: the exact values that the pair critic learns.

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
    """Poses of M single tokens, or of M pieces of targets.

    Attributes:
        index: (M,) index in the layout's tokens.
        pose: (M, 3) x, y and angle.
        flipped: (M,) whether it lies on its other side.
    """

    index: Ints
    pose: Floats
    flipped: Bools

    def instead(self, others: "Lying", where: Bools) -> "Lying":
        """A copy with the poses of others where (M,) is true; both have the same `index`."""
        pose = np.where(where[:, None], others.pose, self.pose)
        return Lying(self.index, pose, np.where(where, others.flipped, self.flipped))

    def outlines(self, layout: Layout) -> Floats:
        """Counter-clockwise corners (M, C, 2)."""
        body = layout.body[layout.padded_corners][self.index]
        return outlines_at(body, self.pose, self.flipped)


def lying(corners: Corners, layout: Layout, rows: Ints, index: Ints) -> Lying:
    """The token index (M,) in the scene rows (M,), for M pairs of both; corners are (B, V, 2)."""
    exact = np.asarray(corners, np.float64)
    return Lying(index, layout.poses(exact)[rows, index], layout.flipped(exact)[rows, index])


def covering(corners: Corners, goals: Corners, layout: Layout) -> Floats:
    """Areas (B, K, K) of piece j that token i covers, whether the token is placed or not.

    Args:
        corners: (B, V, 2) of the tokens; exact tokens are fitted to corners from pictures.
        goals: (B, V, 2) of the targets.
        layout: layout of both.
    """
    return shared_areas(_fitted(corners, layout), _fitted(goals, layout))


def covered_share(covered: Floats, layout: Layout) -> Floats:
    """Shares (B, K, K) of piece j that tokens other than i cover, from the areas of `covering`.

    So the token that moves does not count.
    """
    others = covered.sum(axis=1, keepdims=True) - covered
    share: Floats = np.clip(others / layout.areas, 0.0, 1.0)
    return share


def newly_covered(token: Lying, piece: Lying, covered: Floats, layout: Layout) -> Floats:
    """Values (M,) of tokens on pieces: the newly covered area over the larger area of the two.

    Over the token's own area a small token in a large piece would have the same value as the right
    token. In a partly covered piece the token is assumed to cover the free part first.

    Args:
        token: M tokens.
        piece: a piece of the target for each token.
        covered: (M,) share of the piece that is covered already, in [0, 1].
        layout: layout of both.
    """
    own, wanted = layout.areas[token.index], layout.areas[piece.index]
    shared = shared_area(piece.outlines(layout), token.outlines(layout))
    value: Floats = np.minimum(shared, (1.0 - covered) * wanted) / np.maximum(own, wanted)
    return value


def _fitted(corners: Corners, layout: Layout) -> Floats:
    """Outlines (B, K, C, 2) of the exact tokens that fit corners (B, V, 2) best."""
    seen = np.asarray(corners, np.float64)
    return outlines(layout.corners(layout.poses(seen), layout.flipped(seen)), layout)
