"""Messages between page and server over a socket: JSON, checked before it is used.

Legend: K tokens, the seven tans. Lengths are in arena units, y up, unless said otherwise.
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
FAR = 100.0  # bound of a coordinate; the arena is 2 wide

Number = Annotated[float, Meta(ge=-FAR, le=FAR)]
Count = Annotated[int, Meta(ge=0, lt=2**53)]
Point = tuple[Number, Number]
Ring = Annotated[list[Point], Meta(min_length=3, max_length=MAX_POINTS)]
Motion = Literal["lift", "push"]


class Tokens(Struct, forbid_unknown_fields=True):
    """Where the tokens lie.

    Attributes:
        poses: K poses of x, y and angle.
        flipped: K, whether a token is turned over.
    """

    poses: Annotated[list[tuple[Number, Number, Number]], Meta(min_length=TANS, max_length=TANS)]
    flipped: Annotated[list[bool], Meta(min_length=TANS, max_length=TANS)]

    @property
    def sides(self) -> tuple[Floats, Bools]:
        """Poses (K, 3), and whether each token is turned over (K,), as arrays."""
        return np.array(self.poses, np.float64), np.array(self.flipped, np.bool_)


class Fill(Struct, tag_field="ask", tag="fill", forbid_unknown_fields=True):
    """Request to fill a silhouette: exactly one of puzzle, outlines and pieces.

    Attributes:
        number: number of the request, repeated in all answers.
        puzzle: name of a puzzle of the library.
        outlines: outlines of a drawing, in any unit; one within another is a hole.
        pieces: tans of a figure that a person laid, at their known scale.
        free: whether the outlines were drawn freehand.
    """

    number: Count
    puzzle: Annotated[str, Meta(max_length=64)] | None = None
    outlines: Annotated[list[Ring], Meta(min_length=1, max_length=50)] | None = None
    pieces: Tokens | None = None
    free: bool = False


class Play(Struct, tag_field="ask", tag="play", forbid_unknown_fields=True):
    """Request to lay a figure; a figure that is being laid is given up.

    Attributes:
        number: see `Fill`.
        goal: the figure.
        start: where the tokens lie; None: at random places beside the figure.
        shown: number of moves of this figure that the page has begun to show; later ones are
            dropped.
        motion: lift: tokens are carried; push: a finger pushes them.
    """

    number: Count
    goal: Tokens
    start: Tokens | None = None
    shown: Count = 0
    motion: Motion = "lift"


class Next(Struct, tag_field="ask", tag="next", forbid_unknown_fields=True):
    """Request for one more move; a page sends it while it shows the move before."""


class Save(Struct, tag_field="ask", tag="save", forbid_unknown_fields=True):
    """Request for a file of what was played.

    Attributes:
        kind: gif: all moves; svg: the tokens as they lie; json: a puzzle file of the figure.
        tokens: where the tokens lie.
        name: name of the figure.
        shown: see `Play`.
    """

    kind: Literal["gif", "svg", "json"]
    tokens: Tokens
    name: Annotated[str, Meta(max_length=64)] = "figure"
    shown: Count = 0


Asked = Fill | Play | Next | Save
_DECODER = msgspec.json.Decoder(Asked)


def read(text: str | bytes) -> Asked:
    """Decode a page's message.

    Raises:
        ConfigError: the text is no message, or a value in it is out of bounds.
    """
    try:
        asked: Asked = _DECODER.decode(text)
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        raise ConfigError(f"cannot read the page's message ({error}): reload the page") from None
    return asked


def write(told: str, **content: Any) -> str:
    """Encode a message to a page."""
    return msgspec.json.encode({"told": told, **content}).decode()
