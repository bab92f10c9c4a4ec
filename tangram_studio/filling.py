"""What a page shows -> how the seven tans fill it, or which figure of them comes nearest.

A drawing goes the way of a file: it is written down and read without trust, see
`tangram_vision.given.silhouette_files`. What no tans fill is told why, and approached.

Legend: K tokens, V corners, N rings.
"""

import base64
import json
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import shapely
from PIL import Image

from tangram_core.arrays import Floats
from tangram_core.errors import ConfigError
from tangram_game.figures.puzzles import check_inside
from tangram_sim.drawing.strokes import colour_of
from tangram_sim.geometry.areas import Area, polygons
from tangram_sim.geometry.dissections import Dissection
from tangram_sim.puzzles.figures import library, load_puzzle
from tangram_sim.targets.targets import placement, turned_figure
from tangram_studio.messages import Fill
from tangram_studio.playing import Sides, player
from tangram_vision.given.outline_files import FORMAT, VERSION
from tangram_vision.given.picture_files import READ
from tangram_vision.given.silhouette_files import Silhouette
from tangram_vision.silhouettes.silhouettes import silhouette
from tangram_vision.solution import Solution
from tangram_vision.solving import SECONDS, answer
from tangram_vision.solving import Answer as Answered

FILES = (*READ, ".json")
FREE_SECONDS = 1.0  # of a search where sides are not straight, so that hardly anything fits
HEAPS = 3  # parts of a figure that is laid, at most
LAYOUT = "the layout"
_SHOWN = 480  # pixels along the longer side of what is seen
_ROUND = 5  # digits of what is sent


@dataclass(frozen=True, eq=False)
class Answer:
    """How a silhouette is filled.

    Attributes:
        goal: the tokens in the middle of the arena.
        exact: whether they fill it; if not they come as near as was found.
        iou: area that tokens and silhouette share over the area of both together.
        how: it was filled, or why not.
        seen: PNG of what was seen, a black figure.
        size: its width and height.
        pieces: K outlines of (V, 2), pixels of that picture, y down.
        outline: N rings of (M, 2) of the silhouette in the arena.
        laid: N rings of what the tokens cover.
        solution: where the tokens lie in what was given, as data.
    """

    goal: Sides
    exact: bool
    iou: float
    how: str
    seen: str
    size: tuple[int, int]
    pieces: list[list[list[float]]]
    outline: list[list[list[float]]]
    laid: list[list[list[float]]]
    solution: Solution


def fill(asked: Fill) -> Answer:
    """Fill what a page asks for.

    Raises:
        ConfigError: it draws nothing that has an area, or reaches out of the arena.
    """
    if sum(one is not None for one in (asked.puzzle, asked.outlines, asked.pieces)) != 1:
        raise ConfigError("a puzzle, a drawing or pieces are to be filled, one of them")
    layout, scale = player().layout, player().run.task.tokens.scale
    if asked.puzzle is not None:
        load_puzzle(asked.puzzle)  # a name of the library, not of a file
        return _filled(asked.puzzle, "the puzzle")
    content = {"format": FORMAT, "version": VERSION, "outlines": asked.outlines}
    if asked.pieces is not None:
        poses, flipped = asked.pieces.sides
        corners = layout.corners(poses, flipped)
        heaps = len(shapely.get_parts(silhouette(layout, Dissection(poses, flipped))))
        if heaps > HEAPS:
            raise ConfigError(f"the tans lie in {heaps} heaps: push them together until they touch")
        every = [corners[layout.corners_of(k)].tolist() for k in range(layout.tokens)]
        content |= {"outlines": every, "side": scale}
    with TemporaryDirectory(prefix="tangram-studio-") as folder:
        path = Path(folder) / "drawing.json"
        path.write_text(json.dumps(content), encoding="utf-8")
        source = "the drawing" if asked.pieces is None else LAYOUT
        return _filled(str(path), source, asked.free)


def fill_file(name: str, data: bytes) -> Answer:
    """Fill what a file shows: a picture, an SVG, outlines or a puzzle as JSON.

    Args:
        name: of the file; only its ending matters.
        data: its content.

    Raises:
        ConfigError: it cannot be used.
    """
    suffix = Path(name).suffix.lower()
    if suffix not in FILES:
        raise ConfigError(
            f"a file of the kind '{suffix or name[:40]}' cannot be read: drop one of "
            f"{', '.join(FILES)}"
        )
    with TemporaryDirectory(prefix="tangram-studio-") as folder:
        path = Path(folder) / f"file{suffix}"
        path.write_bytes(data)
        return _filled(str(path), "the file")


def tans() -> dict[str, object]:
    """What a page is told at first: the tokens, their full square's side and area, the library."""
    own = player()
    layout, scale = own.layout, own.run.task.tokens.scale
    chiral = layout.chiral.tolist()
    tokens = [
        {
            "name": shape.name,
            "corners": layout.body[layout.corners_of(k)].round(_ROUND).tolist(),
            "colour": "#{:02x}{:02x}{:02x}".format(*colour_of(k)),
            "chiral": chiral[k],
        }
        for k, shape in enumerate(layout.shapes)
    ]
    every = [puzzle for split in ("train", "test") for puzzle in library(split, scale)]
    figures = [
        {"name": puzzle.name, "outline": _rings(silhouette(layout, Dissection(*sides)))}
        for puzzle, sides in ((one, placement(one, layout)) for one in every)
    ]
    return {
        "tokens": tokens,
        "side": scale,
        "area": float(layout.areas.sum()),
        "figures": figures,
    }


def _filled(name: str, source: str, free: bool = False) -> Answer:
    task = player().run.task
    seconds = FREE_SECONDS if free else SECONDS
    found = answer(name, source, task.layout, task.tokens.scale, seconds)
    if source == LAYOUT and found.drawn.share is not None:
        raise ConfigError("the tans lie on each other: move them apart")
    first = found.drawn.filled
    how = f"{source[0].upper()}{source[1:]} {found.told.partition(';')[0]}."
    if found.exact:
        how = f"filled by the {first.by} in {first.seconds:.2f} s"
    elif free:
        how = "Drawn by a free hand."
    solution = found.solution(task.layout, task.tokens.scale, source.removeprefix("the "))
    return _answer(found, how, solution)


def _answer(answered: Answered, how: str, solution: Solution) -> Answer:
    task, drawn, found = player().run.task, answered.drawn, answered.lies
    layout = task.layout
    poses = turned_figure(layout, (found.poses, found.flipped), 0.0)
    check_inside("the figure", task, layout.corners(poses, found.flipped), "draw it less long")
    seen, share = _seen(drawn)
    corners = drawn.corners(layout, found) * share
    pieces = [corners[layout.corners_of(k)].round(1).tolist() for k in range(layout.tokens)]
    moved = poses[0, :2] - found.poses[0, :2]
    area = shapely.transform(drawn.area, lambda points: points + moved)
    goal = Sides(poses, found.flipped)
    width, height = (round(side * share) for side in drawn.picture.size)
    laid = silhouette(layout, Dissection(poses, found.flipped))
    rings = _rings(area), _rings(laid)
    exact, iou, size = answered.exact, answered.iou, (width, height)
    return Answer(goal, exact, iou, how, seen, size, pieces, *rings, solution)


def _seen(drawn: Silhouette) -> tuple[str, float]:
    """A small PNG of what was seen as an address, and the share by which it is smaller."""
    mask = Image.fromarray(np.where(drawn.mask, 0, 255).astype(np.uint8))
    share = min(1.0, _SHOWN / max(mask.size))
    mask = mask.resize([round(side * share) for side in mask.size], Image.Resampling.BOX)
    data = BytesIO()
    mask.quantize(16).save(data, format="PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(data.getvalue()).decode(), share


def _rings(area: Area) -> list[list[list[float]]]:
    every = []
    for part in polygons(area):
        for ring in (part.exterior, *part.interiors):
            points: Floats = np.asarray(ring.coords)[:-1]
            every.append(points.round(_ROUND).tolist())
    return every
