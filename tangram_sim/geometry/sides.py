"""The different shapes of a layout, a chiral shape once for each of its sides."""

from dataclasses import dataclass
from functools import lru_cache

from tangram_core.arrays import Floats
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.shapes import Shape, mirror_image, turn_onto

_NO_TURN = 1e-6  # radians


@dataclass(frozen=True, eq=False)
class Side:
    """A shape on one of its sides.

    Attributes:
        shape: number among the different shapes of a layout.
        flipped: whether a chiral shape is turned over.
        corners: (C, 2) counter-clockwise.
        different: number of corners that no rotation of the shape maps onto each other.
        area: of the shape.
        tokens: indices of the layout's tokens with this shape.
    """

    shape: int
    flipped: bool
    corners: Floats
    different: int
    area: float
    tokens: tuple[int, ...]


@lru_cache(maxsize=8)
def sides_of(layout: Layout) -> tuple[Side, ...]:
    """All different shapes of a layout; chiral ones appear on both sides."""
    found: list[tuple[Shape, list[int]]] = []
    for token, shape in enumerate(layout.shapes):
        alike = (tokens for one, tokens in found if _same(one, shape))
        tokens = next(alike, None)
        if tokens is None:
            found.append((shape, [token]))
        else:
            tokens.append(token)
    return tuple(
        Side(
            number,
            flipped,
            mirror_image(shape.corners) if flipped else shape.corners,
            len(shape.corners) // shape.symmetry,
            shape.area,
            tuple(tokens),
        )
        for number, (shape, tokens) in enumerate(found)
        for flipped in ((False, True) if shape.mirror is None else (False,))
    )


def _same(one: Shape, other: Shape) -> bool:
    turn = turn_onto(one.corners, other.corners)
    return turn is not None and abs(turn) < _NO_TURN
