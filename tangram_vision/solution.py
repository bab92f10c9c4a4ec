"""The answer as data: where each token lies, for files that other programs read.

`solution.schema.json` beside this file is the JSON schema of these files.
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
_ROUND = 6  # decimal places


class Token(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A token and its pose.

    Attributes:
        order: number in the order of laying, from 1; larger tokens come first.
        shape: name of the shape, as in `tokens.shapes`.
        x, y: centre of area, from the middle of the figure, y up. The unit is the side of the full
            square that the tans are cut from.
        angle: counterclockwise turn in radians, after the shape was turned over.
        flipped: whether the shape is turned over, about its x axis.
        corners: x and y of each corner, in the unit above.
        pixels: the same corners in `Solution.picture`, y down; (0, 0) is its upper left corner.
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
    """Size of the picture that `pixels` refer to: as given, an SVG's page, or drawn from a file."""

    width: int
    height: int

    @staticmethod
    def of(page: tuple[float, float]) -> "Picture":
        """The size of a page (width, height), rounded up."""
        return Picture(ceil(page[0]), ceil(page[1]))


class Solution(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where the tokens of a figure lie.

    Attributes:
        source: the figure, as the user named it.
        kind: filled: the tokens fill the figure; nearest: they come as near as a search found;
            seen: they were found in a photograph.
        told: the result in words.
        iou: intersection over union of tokens and figure; None for the kind seen.
        seconds: processor time that was used; None for the kind seen.
        picture: size of the picture.
        tokens: all tokens, in the order of laying.
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
        """The solution as the content of a JSON file."""
        return msgspec.json.format(msgspec.json.encode(self), indent=1) + b"\n"

    def svg(self) -> bytes:
        """The solution as an SVG file of the picture's size, with a polygon for each token."""
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
    """Tokens with their poses, the larger ones first.

    Args:
        layout: the tokens.
        scale: side of the full square, in units of the layout.
        lies: poses of the tokens, y up.
        pixels: (V, 2) corners of all tokens in the picture.
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
