"""Files that a user brings, and what is done with them."""

import json
import sys
from collections.abc import Callable, Iterable
from functools import cache
from importlib.metadata import packages_distributions
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import shapely
from packaging.utils import canonicalize_name
from PIL import Image, ImageDraw

from tangram_agent.runs import read_changed
from tangram_game.figures.photographs import read_photograph
from tangram_game.figures.puzzles import find_figures, play_figures
from tangram_game.figures.silhouettes import read_silhouette
from tangram_game.figures.targets import PUZZLE, SILHOUETTE, solved, told_apart
from tangram_sim.puzzles.figures import parse_puzzles
from tangram_tasks.place import Place
from tangram_tasks.rivals.baselines import exact_policy
from tangram_vision.given import svg_files
from tests.agent.builders import setup
from tests.game.figures.puzzle_files import GAME, SIM, drawn

# What is done


@cache
def task() -> Place:
    return read_changed("pretrained/tangram7", {}).task


def take(name: str) -> None:
    """As tangram-play target=NAME out=solution.json, and what is played of a puzzle."""
    kind = told_apart(name, task())
    if kind == PUZZLE:
        find_figures(name, task())
    found = solved(name, f"target={name}", task(), kind)
    assert found.kind in ("filled", "seen"), found.told


def take_for_one_figure(name: str) -> None:
    solved(name, f"silhouette={name}", task(), SILHOUETTE)


def play_silhouette(name: str) -> None:
    read_silhouette(name, f"silhouette={name}", task())


def play_photograph(name: str) -> None:
    assert told_apart(name, task()) == "photograph"
    read_photograph(name, task())


def parse(name: str) -> None:
    parse_puzzles(Path(name).read_text(), "it")


def play_by_run(name: str, arena: float = 2.0, shapes: Iterable[str] = GAME["shapes"]) -> None:
    sim = SIM | {"arena": arena, "mirrored": 0.0}
    find_figures(name, setup(GAME | {"shapes": list(shapes)}, **sim).task)


def play_of_library(name: str, observe: str = "corners") -> None:
    one = task().with_sim(backend="kinematic", observe=observe, pixels=64)
    figures = find_figures(None, one, [Path(name).name])
    play_figures(one, figures, lambda _: exact_policy(one.layout, one.sim), 0)


def take_without(module: str, name: str) -> None:
    """Where it is not installed."""
    fails = svg_files._DRAW.replace("resvg_py", "resvg_gone")
    with mock.patch.dict(sys.modules), mock.patch.object(svg_files, "_DRAW", fails):
        if module == "cv2":
            for other in [one for one in sys.modules if one.startswith("tangram_vision")]:
                del sys.modules[other]
            sys.modules["cv2"] = None  # type: ignore[assignment]
        take(name)


def brings(modules: dict[str, str], name: str) -> None:
    """Whether packages that an error names have these modules; and the file is taken with them."""
    for package, module in modules.items():
        (found,) = {*packages_distributions()[module]}
        assert canonicalize_name(found) == package
    take(name)


class Given(NamedTuple):
    """A file, or none, and what is done with it."""

    name: str
    content: Any = None
    how: Callable[[str], None] = take

    def do(self, folder: Path) -> None:
        path = folder / self.name
        path.unlink(missing_ok=True)
        if isinstance(self.content, Image.Image):
            self.content.save(path)
        elif isinstance(self.content, Path):
            path.symlink_to(self.content)
        elif isinstance(self.content, bytes):
            path.write_bytes(self.content)
        elif self.content is not None:
            text = self.content if isinstance(self.content, str) else json.dumps(self.content)
            path.write_text(text)
        self.how(str(path))


# What is given

SQUARE = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]


def edited(content: Any, place: str, value: Any) -> Any:
    """The same JSON with another value there, as at puzzles/0/name."""
    content = json.loads(json.dumps(content))
    *way, last = [int(one) if one.isdigit() else one for one in place.split("/")]
    inner = content
    for one in way:
        inner = inner[one]
    inner[last] = value
    return content


def outlines(*rings: Any) -> dict[str, Any]:
    return {"format": "tangram-outlines", "version": 1, "outlines": list(rings)}


def strips(count: int, upright: bool = True) -> list[Any]:
    """The square in so many."""
    ends = np.linspace(0.0, 1.0, count + 1).tolist()
    rings = [[[a, 0.0], [b, 0.0], [b, 1.0], [a, 1.0]] for a, b in pairwise(ends)]
    return rings if upright else [[corner[::-1] for corner in ring] for ring in rings]


def with_corners(rings: Any) -> dict[str, Any]:
    """The same outlines with a thousand needless corners each."""
    fine = [shapely.segmentize(shapely.Polygon(ring), 0.0025).exterior.coords for ring in rings]
    return outlines(*[np.asarray(one)[:-1].tolist() for one in fine])


def simplified(content: Any) -> dict[str, Any]:
    """One outline with straight sides around all."""
    whole = shapely.union_all([shapely.Polygon(one) for one in content["outlines"]], grid_size=1e-6)
    return outlines(np.asarray(whole.simplify(1e-3).exterior.coords)[:-1].tolist())


def tans_in_a_row(gap: float) -> dict[str, Any]:
    pieces = [np.array(piece["corners"]) for piece in drawn("cat")["pieces"]]
    row = [one - one.mean(axis=0) + (gap * k, 0.0) for k, one in enumerate(pieces)]
    return outlines(*[one.tolist() for one in row])


def picture(rings: Any = (SQUARE,), side: int = 160, ink: int = 40, mode: str = "L") -> Image.Image:
    """A drawing as a picture, with a margin."""
    canvas = Image.new(mode, (side, side), 235)
    for ring in rings:
        points = (np.asarray(ring) * (0.6, -0.6) + (0.2, 0.8)) * side
        ImageDraw.Draw(canvas).polygon([(x, y) for x, y in points.tolist()], ink)
    return canvas


def triangle(filled: bool) -> Image.Image:
    """Of one tone, or two of its sides as thin lines."""
    canvas = Image.new("L", (1280, 1280), 255)
    corners = [(60, 60), (60, 1220), (1220, 1220)]
    if filled:
        ImageDraw.Draw(canvas).polygon(corners, 0)
    else:
        ImageDraw.Draw(canvas).line(corners, 0, 1)
    return canvas


def photograph(gap: float = 0.5, unit: float = 100.0, count: int = 7) -> Image.Image:
    """So many of the seven tokens in two rows, so far apart; pixels of an arena unit."""
    layout = task().layout
    poses = [(gap * (k // 2 + 1.0), -gap * (k % 2 + 1.0), 0.3 * k) for k in range(7)]
    corners = layout.corners(np.array(poses)) * (unit, -unit) * 4.0
    canvas = Image.new("L", (round(20.0 * gap * unit), round(12.0 * gap * unit)), 220)
    for k in range(count):
        points = corners[layout.corners_of(k)].tolist()
        ImageDraw.Draw(canvas).polygon([(x, y) for x, y in points], 60)
    return canvas.reduce(4)


def encoded(image: Image.Image, kind: str) -> bytes:
    stream = BytesIO()
    image.save(stream, format=kind)
    return stream.getvalue()


def decoded(data: bytes) -> Image.Image:
    return Image.open(BytesIO(data))


def svg(content: Any, **how: Any) -> Given:
    return Given("it.svg", content, **how)


def png(content: Any, **how: Any) -> Given:
    return Given("it.png", content, **how)


def file(content: Any, **how: Any) -> Given:
    return Given("it.json", content, **how)


SPACE = "http://www.w3.org/2000/svg"
HEAD = f'<svg xmlns="{SPACE}" viewBox="0 0 300 300">'
SIDES = '<path d="M50 50H250V250H50Z"/>'
SVG = f"{HEAD}{SIDES}</svg>"
PNG = png(picture())
