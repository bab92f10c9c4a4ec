"""Fill a page's figure with the seven tans, or find their nearest figure.

A drawing is written to a file, and read like any untrusted file, see
`tangram_vision.given.silhouette_files`. If no tans fill it, the answer says why.

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
FREE_SECONDS = 1.0  # for the search of a freehand drawing, which tans hardly ever fill
HEAPS = 3  # separate groups of tans in a figure laid by a person, at most
LAYOUT = "the layout"
_SHOWN = 480  # pixels along the longer side of the silhouette's picture
_ROUND = 5  # decimal places of numbers that are sent


@dataclass(frozen=True, eq=False)
class Answer:
    """How the tokens fill a silhouette.

    Attributes:
        goal: poses and sides of the tokens, in the middle of the arena.
        exact: whether the tokens fill the silhouette; if not, they are the nearest figure found.
        iou: intersection over union of tokens and silhouette.
        how: how the silhouette was filled, or why not, in words.
        seen: PNG of the silhouette in black, as a data URL.
        size: width and height of that PNG.
        pieces: K outlines (V, 2) of the tokens, in pixels of that PNG, y down.
        outline: N rings (M, 2) of the silhouette, in the arena.
        laid: N rings (M, 2) of the area that the tokens cover, in the arena.
        solution: poses of the tokens in the given figure, as data.
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
    """Fill the silhouette of a page's request.

    Raises:
        ConfigError: the silhouette has no area, or its figure reaches out of the arena.
    """
    if sum(one is not None for one in (asked.puzzle, asked.outlines, asked.pieces)) != 1:
        raise ConfigError("send exactly one of puzzle, outlines and pieces")
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
            raise ConfigError(f"the tans lie in {heaps} groups: move them until they touch")
        every = [corners[layout.corners_of(k)].tolist() for k in range(layout.tokens)]
        content |= {"outlines": every, "side": scale}
    with TemporaryDirectory(prefix="tangram-studio-") as folder:
        path = Path(folder) / "drawing.json"
        path.write_text(json.dumps(content), encoding="utf-8")
        source = "the drawing" if asked.pieces is None else LAYOUT
        return _filled(str(path), source, asked.free)


def fill_file(name: str, data: bytes) -> Answer:
    """Fill the silhouette of a file: a picture, an SVG, or JSON of outlines or a puzzle.

    Args:
        name: name of the file; only its ending matters.
        data: content of the file.

    Raises:
        ConfigError: the file cannot be used.
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
    """Data for a new page: the tokens, their full square's side, their area, and the library."""
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
        how = "Drawn freehand."
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
    """A small PNG of the silhouette as a data URL, and its size over that of the picture."""
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
