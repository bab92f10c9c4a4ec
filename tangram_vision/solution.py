"""The answer as data: where each token lies, to be written down and read by other programs.

`solution.schema.json` beside this file is for programs that check files.
"""

from math import ceil
from typing import Literal

import msgspec
import numpy as np

from tangram_core.arrays import Floats
from tangram_sim.drawing.strokes import colour_of
from tangram_sim.geometry.dissections import Dissection
from tangram_sim.geometry.layout import Layout

Point = tuple[float, float]
Kind = Literal["filled", "nearest", "seen"]
_ROUND = 6  # digits after the point


class Token(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One token where it lies.

    Attributes:
        order: when it is laid, from 1: the larger ones first.
        shape: its name, as in `tokens.shapes`.
        x, y: its centre of area, in sides of the full square that tans are cut from, y up, from the
            middle of the figure.
        angle: radians by which the shape is turned, against the clock, after it was turned over.
        flipped: whether it is turned over, about its x axis.
        corners: as x and y.
        pixels: the same corners in `Solution.picture`, y down, (0, 0) its upper left corner.
    """

    order: int
    shape: str
    x: float
    y: float
    angle: float
    flipped: bool
    corners: list[Point]
    pixels: list[Point]


class Picture(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What `pixels` count in: the picture as given; of an SVG its page; else one of our own."""

    width: int
    height: int

    @staticmethod
    def of(page: tuple[float, float]) -> "Picture":
        """Of a page's width and height, rounded up."""
        return Picture(ceil(page[0]), ceil(page[1]))


class Solution(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How tokens make a figure.

    Attributes:
        source: the figure, as it was named.
        kind: filled: they fill it; nearest: nothing fills it, and they come as near as was found;
            seen: they were found in a photograph.
        told: the same in words.
        iou: area that tokens and figure share over the area of both together.
        seconds: of processor time that it took. Of tokens that were seen both are None.
        picture: its size.
        tokens: in the order of laying.
    """

    format: Literal["tangram-solution"] = "tangram-solution"
    version: Literal[1] = 1
    source: str
    kind: Kind
    told: str
    iou: float | None
    seconds: float | None
    picture: Picture
    tokens: list[Token]

    def json(self) -> bytes:
        """As a file."""
        return msgspec.json.format(msgspec.json.encode(self), indent=1) + b"\n"

    def svg(self) -> bytes:
        """As a drawing of the size of the picture, a polygon for each token."""
        width, height = self.picture.width, self.picture.height
        head = f'width="{width}" height="{height}" viewBox="0 0 {width} {height}"'
        lines = [f'<svg xmlns="http://www.w3.org/2000/svg" {head}>']
        for number, one in enumerate(self.tokens):
            points = " ".join(f"{x:g},{y:g}" for x, y in one.pixels)
            colour = "#{:02x}{:02x}{:02x}".format(*colour_of(number))
            lines.append(
                f'<polygon id="{one.shape}-{one.order}" fill="{colour}" points="{points}"/>'
            )
        return "\n".join([*lines, "</svg>", ""]).encode()


def tokens_of(layout: Layout, scale: float, lies: Dissection, pixels: Floats) -> list[Token]:
    """Tokens as they lie, the larger ones first.

    Args:
        layout: the tokens.
        scale: side of the full square in its units.
        lies: how they lie, with y up.
        pixels: (V, 2) corners in the picture.
    """
    corners = layout.corners(lies.poses, lies.flipped)
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2.0
    own, centres = (corners - middle) / scale, (lies.poses[:, :2] - middle) / scale
    return [
        Token(
            order=order,
            shape=layout.shapes[k].name,
            x=_rounded(centres[k, 0]),
            y=_rounded(centres[k, 1]),
            angle=_rounded(lies.poses[k, 2]),
            flipped=bool(lies.flipped[k]),
            corners=_points(own[layout.corners_of(k)]),
            pixels=_points(pixels[layout.corners_of(k)]),
        )
        for order, k in enumerate(np.argsort(-layout.areas, kind="stable").tolist(), 1)
    ]


def _points(values: Floats) -> list[Point]:
    return [(_rounded(x), _rounded(y)) for x, y in values]


def _rounded(value: float) -> float:
    return round(float(value), _ROUND) + 0.0  # no -0.0
