"""What a page asks for and is told, over its socket: JSON, checked before it is used.

Legend: K tokens, which are the seven tans. Lengths are in arena units, y up, unless said otherwise.
"""

from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct

from tangram_core.arrays import Bools, Floats
from tangram_core.errors import ConfigError

TANS = 7
MAX_BYTES = 2**18  # of a message
MAX_POINTS = 4_000
FAR = 100.0  # of a coordinate; the arena is 2 wide

Number = Annotated[float, Meta(ge=-FAR, le=FAR)]
Count = Annotated[int, Meta(ge=0, lt=2**53)]
Point = tuple[Number, Number]
Ring = Annotated[list[Point], Meta(min_length=3, max_length=MAX_POINTS)]
Motion = Literal["lift", "push"]


class Tokens(Struct, forbid_unknown_fields=True):
    """Where the tokens lie.

    Attributes:
        poses: K of x, y and angle.
        flipped: K, which lie on their other side.
    """

    poses: Annotated[list[tuple[Number, Number, Number]], Meta(min_length=TANS, max_length=TANS)]
    flipped: Annotated[list[bool], Meta(min_length=TANS, max_length=TANS)]

    @property
    def sides(self) -> tuple[Floats, Bools]:
        """Poses (K, 3) and sides (K,)."""
        return np.array(self.poses, np.float64), np.array(self.flipped, np.bool_)


class Fill(Struct, tag_field="ask", tag="fill", forbid_unknown_fields=True):
    """Find how the tokens fill a silhouette: one of these three.

    Attributes:
        number: of what the page asks for, given back with all answers.
        puzzle: name of one of the library.
        outlines: of a drawing, in any unit; an outline within another is a hole.
        pieces: of a figure that was laid of tans, whose area is known.
        free: the outlines were drawn by a free hand.
    """

    number: Count
    puzzle: Annotated[str, Meta(max_length=64)] | None = None
    outlines: Annotated[list[Ring], Meta(min_length=1, max_length=50)] | None = None
    pieces: Tokens | None = None
    free: bool = False


class Play(Struct, tag_field="ask", tag="play", forbid_unknown_fields=True):
    """Lay a figure; what is being played ends.

    Attributes:
        number: see `Fill`.
        goal: the figure.
        start: where the tokens lie; None: anywhere beside it.
        shown: moves of the same figure that the page had begun to show; others are forgotten.
        motion: whether tokens are carried, or pushed by a finger.
    """

    number: Count
    goal: Tokens
    start: Tokens | None = None
    shown: Count = 0
    motion: Motion = "lift"


class Next(Struct, tag_field="ask", tag="next", forbid_unknown_fields=True):
    """Play one more move: the page asks while it shows the one before."""


class Save(Struct, tag_field="ask", tag="save", forbid_unknown_fields=True):
    """Send what was played as a file.

    Attributes:
        kind: gif, of all moves; svg, of the tokens as they lie; json, a puzzle file of the figure.
        tokens: as they lie.
        name: of the figure.
        shown: see `Play`.
    """

    kind: Literal["gif", "svg", "json"]
    tokens: Tokens
    name: Annotated[str, Meta(max_length=64)] = "figure"
    shown: Count = 0


Asked = Fill | Play | Next | Save
_DECODER = msgspec.json.Decoder(Asked)


def read(text: str | bytes) -> Asked:
    """A page's message.

    Raises:
        ConfigError: it is none, or something in it is out of bounds.
    """
    try:
        asked: Asked = _DECODER.decode(text)
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        raise ConfigError(f"the page's message is not understood ({error}): load it anew") from None
    return asked


def write(told: str, **content: Any) -> str:
    """A message to a page."""
    return msgspec.json.encode({"told": told, **content}).decode()
