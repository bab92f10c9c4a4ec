"""Each error of what a user brings names a remedy. Here it is followed, and works."""

import ast
import json
import re
import sys
from base64 import b64decode, b64encode
from collections.abc import Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from PIL import ImageOps

from tangram_core.errors import ConfigError
from tangram_vision.given import svg_files
from tests.game.figures.puzzle_files import drawn
from tests.vision.brought import (
    HEAD,
    PNG,
    SIDES,
    SPACE,
    SQUARE,
    SVG,
    Given,
    brings,
    decoded,
    edited,
    encoded,
    file,
    outlines,
    parse,
    photograph,
    picture,
    play_by_run,
    play_of_library,
    play_photograph,
    play_silhouette,
    png,
    simplified,
    strips,
    svg,
    take_for_one_figure,
    take_without,
    tans_in_a_row,
    triangle,
    with_corners,
)

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
# Whose errors these are; what a puzzle's pieces must be is told by tangram_sim/puzzles/assembly.py.
FILES = ("tangram_vision/**/*.py", "tangram_game/figures/*.py", "tangram_sim/puzzles/sketches.py")
WORKED: list[Given] = []  # remedies that several errors name are tried once


SHAPES = ("large_triangle", "large_triangle", "medium_triangle", "small_triangle", "small_triangle")
PUZZLES = {"format": "tangram-puzzles", "version": 1, "puzzles": [drawn("cat")]}
TWO = PUZZLES | {"puzzles": [drawn("cat"), drawn("dog")]}
OUTLINE = outlines(SQUARE)
TEXT = json.dumps(OUTLINE, indent=1)
LONG = json.dumps(TWO) + " " * 4 * 2**20

# What an error tells -> a right file, where it is wrong, and what stands there then.
EDITS: dict[str, tuple[dict[str, Any], str, Any]] = {
    "exactly the keys format, version, puzzles": (PUZZLES, "title", "mine"),
    "format must be 'tangram-puzzles', got 'mine'": (PUZZLES, "format", "mine"),
    "version must be 1, got 2: write the file anew": (PUZZLES, "version", 2),
    "puzzles must be a list of 1 to 1000, got 0": (PUZZLES, "puzzles", []),
    "exactly the keys name, pieces": (PUZZLES, "puzzles/0/title", "mine"),
    "name must be 1 to 64 printable characters": (PUZZLES, "puzzles/0/name", ""),
    "pieces must be a list of 1 to 16, got 0": (PUZZLES, "puzzles/0/pieces", []),
    "exactly the keys shape, corners": (PUZZLES, "puzzles/0/pieces/0/name", "ear"),
    "shape must be one of large_triangle, ": (PUZZLES, "puzzles/0/pieces/0/shape", "ear"),
    "corners must be a list of 3 pairs, got 0": (PUZZLES, "puzzles/0/pieces/0/corners", []),
    "a corner must be .x, y., finite": (PUZZLES, "puzzles/0/pieces/0/corners/0", [0, "1"]),
    "keys format, version, outlines, and optionally side": (OUTLINE, "title", "mine"),
    "side must be .* leave it out where it is not known": (OUTLINE, "side", 0),
    "outline 1 must be a list of 3 to 2000 corners": (OUTLINE, "outlines/0", [[0, 0]]),
}
HALF, REST = [[0, 0], [1, 0], [1, 1]], [[-0.1, 0.1], [0.9, 1.1], [-0.1, 1.1]]
MANY, CROSSED = with_corners(strips(2)), outlines(*strips(40), *strips(40, upright=False))
SQUASHED = SVG.replace("<path", '<path style="transform:scale(1, 2) translate(9px, 0px)"')
SQUASHED = SQUASHED.replace("M50 50H250V250H50Z", "M30 25H230V125H30Z")
DATA = b64encode(encoded(picture(), "PNG")).decode()
IMAGE = f'{HEAD}<image href="data:image/png;base64,{DATA}"/></svg>'
ENTITIES = f'<!DOCTYPE svg [<!ENTITY ns "{SPACE}">]>{SVG.replace(SPACE, "&ns;")}'
DEEP = HEAD + "<g>" * 600 + SIDES + "</g>" * 600 + "</svg>"
UTF16 = f'<?xml version="1.0" encoding="UTF-16"?>{SVG}'.encode("utf-16")
HUGE, VAST = picture(side=8100, ink=0, mode="1"), picture(side=9600, ink=0, mode="1")
FAINT, TINY, TGA = picture(ink=228), picture(side=28), encoded(picture(), "TGA")
EDGE = picture((HALF, REST)).crop((0, 24, 160, 160))
TIGHT = picture([[[0, 0], [1, 0], [0.5, 0.5]]]).crop((32, 80, 129, 129))

# What an error tells -> what brings it about, and what each remedy that it names makes of that.
CASES: dict[str, tuple[Given, ...]] = {
    **{told: (file(edited(*edit)), file(edit[0])) for told, edit in EDITS.items()},
    "is no file: check the path": (svg(None), svg(SVG)),
    "it has no ending: rename it, a picture to it.png": (
        Given("it", encoded(picture(), "PNG")),
        PNG,
    ),
    "cannot be read .*: give a copy that you may": (svg(Path("/proc/self/mem")), svg(SVG)),
    "larger than .*: split it, or give a PNG": (file(LONG), file(PUZZLES), PNG),
    "longer than .*: split it": (file(LONG, how=parse), file(PUZZLES, how=parse)),
    "not UTF-8: save it as UTF-8": (svg(UTF16), svg(UTF16.decode("utf-16"))),
    "a key is given twice .*: remove one": (file(TEXT.replace("{", '{"version": 1,')), file(TEXT)),
    "not JSON .*: check line 4 and the one before": (file(TEXT.replace("1,", "1")), file(TEXT)),
    "not JSON .*: check its .* numbers": (file(TEXT.replace("1.0", "9" * 5000)), file(TEXT)),
    "belongs to an earlier puzzle: rename one": (
        file(edited(TWO, "puzzles/1/name", "my_cat"), how=play_by_run),
        file(TWO, how=play_by_run),
    ),
    "has 2 puzzles.*: use a file with one puzzle": (file(TWO), file(PUZZLES)),
    "outlines must be a list of 1 to 100, got 101": (
        file(outlines(*strips(101))),
        file(outlines(*strips(100))),
    ),
    "more than 2000 corners: draw straight sides, or give a PNG": (
        file(MANY),
        file(simplified(MANY)),
        png(picture(MANY["outlines"])),
    ),
    "meet more than 1000 times: draw outlines that do not cross, or give a PNG": (
        file(CROSSED),
        file(simplified(CROSSED)),
        png(picture(CROSSED["outlines"])),
    ),
    "it.json draws nothing that has an area: draw an outline": (
        file(outlines([[0, 0], [1, 0], [0.5, 0]])),
        file(outlines([[0, 0], [1, 0], [0.5, 0.5]])),
    ),
    "it.svg draws nothing that has an area: draw an outline": (
        svg(SVG.replace("H250V250H50Z", "L250 250")),
        svg(SVG),
    ),
    "it reaches out of its page: enlarge its viewBox, or width and height": (
        svg(SVG.replace("0 0 300 300", "0 0 200 200")),
        svg(SVG),
    ),
    "cannot be drawn .*: remove its filters and nested groups, or give a PNG": (
        svg(DEEP),
        svg(re.sub("</?g>", "", DEEP)),
        PNG,
    ),
    "needs resvg, which is missing: pip install resvg-py": (
        svg(SVG, how=partial(take_without, "resvg")),
        svg(SVG, how=partial(brings, {"resvg-py": "resvg_py"})),
    ),
    "write out what each &name; stands for, then delete them, or give a PNG": (
        svg(ENTITIES),
        svg(re.sub("<!DOCTYPE.*?]>", "", ENTITIES).replace("&ns;", SPACE)),
        PNG,
    ),
    "is not XML .*: save it anew as SVG, or give a PNG": (svg(HEAD + SIDES), svg(SVG), PNG),
    "is no <svg> but a <html>: save the <svg> in it alone": (svg(f"<html>{SVG}</html>"), svg(SVG)),
    "an element <text>: convert it to paths": (
        svg(SVG.replace("</svg>", '<text x="90" y="90">I</text></svg>')),
        svg(SVG.replace("</svg>", '<path d="M90 90V80H91V90Z"/></svg>')),
    ),
    "an element <image>: give the picture itself": (svg(IMAGE), png(b64decode(DATA))),
    "a style with a transform, rotate, scale or translate: write it as the attribute transform, "
    "without px and deg": (
        svg(SQUASHED),
        svg(re.sub('style="transform:(.*?)px(.*?)px', r'transform="\1\2', SQUASHED)),
    ),
    "it.png has more than 64 million pixels: make it smaller": (
        png(HUGE),
        png(HUGE.resize((900, 900))),
    ),
    "vast.png has more than 64 million pixels: make it smaller": (
        Given("vast.png", VAST),
        png(VAST.resize((900, 900))),
    ),
    "at least 32 along each side are needed: take a larger picture": (png(TINY), PNG),
    **{
        f"is no {kind.upper()} that can be read.*: save it anew as PNG or JPEG": (
            Given(f"it.{kind}", TGA),
            png(decoded(TGA)),
            Given("it.jfif", encoded(decoded(TGA), "JPEG")),
        )
        for kind in ("png", "heic", "tga")
    },
    "shows nothing that is .*: take it with dark tokens on light ground, or light ones on dark": (
        png(FAINT),
        PNG,
        png(ImageOps.invert(picture())),
    ),
    "shows nothing .*, and with ground all around": (
        png(TIGHT),
        png(ImageOps.expand(TIGHT, 60, 235)),
    ),
    "cut off by the picture's edge: leave ground around the silhouette": (
        png(EDGE),
        png(ImageOps.expand(EDGE, 60, 235)),
    ),
    "lines that are too thin to have an area: fill the figure with one tone": (
        png(triangle(filled=False)),
        png(triangle(filled=True)),
    ),
    "not found: .*: lay them all in the picture .*; or set silhouette=.* if it is one figure": (
        png(photograph(count=6)),
        png(photograph()),
        png(photograph(count=6), how=take_for_one_figure),
    ),
    "are too small: .*: take it from nearer, or with more pixels; or set silhouette=": (
        png(photograph(unit=30.0)),
        png(photograph()),
        png(photograph(unit=30.0), how=take_for_one_figure),
    ),
    "lay tokens nearer together, or write out=solution.json, which needs no arena": (
        png(photograph(gap=0.9), how=play_photograph),
        png(photograph(), how=play_photograph),
        png(photograph(gap=0.9)),
    ),
    "draw it less long, or write out=solution.json, which needs no arena": (
        file(tans_in_a_row(1.0), how=play_silhouette),
        file(OUTLINE, how=play_silhouette),
        file(tans_in_a_row(1.0)),
    ),
    "name a run of a larger arena or of smaller tokens": (
        file(PUZZLES, how=partial(play_by_run, arena=1.0)),
        file(PUZZLES, how=play_by_run),
    ),
    "name a run of the puzzle's pieces": (
        file(PUZZLES | {"puzzles": [drawn("cat", range(5))]}),
        file(
            PUZZLES | {"puzzles": [drawn("cat", range(5))]}, how=partial(play_by_run, shapes=SHAPES)
        ),
    ),
    "no puzzle 'dragon' in the library: choose from .*cat": (
        Given("dragon", how=play_of_library),
        Given("cat", how=play_of_library),
    ),
    "cannot tell the pieces of a puzzle apart, which touch: set sim.observe=corners": (
        Given("cat", how=partial(play_of_library, observe="pictures")),
        Given("cat", how=play_of_library),
    ),
    "install opencv-python-headless and shapely, or name a puzzle, as in puzzle=cat": (
        png(picture(), how=partial(take_without, "cv2")),
        png(
            picture(), how=partial(brings, {"opencv-python-headless": "cv2", "shapely": "shapely"})
        ),
        Given("cat", how=play_of_library),
    ),
}


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small drawings, and no search for what comes nearest: nearly all is the full square."""
    monkeypatch.setattr(svg_files, "SIDE", 160)
    monkeypatch.setattr(svg_files, "_BORDER", 20)
    monkeypatch.setattr("tangram_vision.solving.SECONDS", 1.0)
    monkeypatch.setattr("tangram_vision.solving.NEAREST_SECONDS", 0.05)


@pytest.mark.parametrize("told", CASES)
def test_a_remedy_that_an_error_names_works(told: str, tmp_path: Path) -> None:
    given, *remedies = CASES[told]
    with pytest.raises(ConfigError, match=told):
        given.do(tmp_path)
    for remedy in remedies:
        if remedy not in WORKED:
            remedy.do(tmp_path)
            WORKED.append(remedy)


def without_case(paths: Iterable[Path], reached: set[tuple[str, int]]) -> list[str]:
    """Errors of files, by their code, that are raised in none of these lines."""
    return [
        ast.unparse(one)
        for path in paths
        for one in ast.walk(ast.parse(path.read_text()))
        if isinstance(one, ast.Raise)
        and not {(str(path), line) for line in range(one.lineno, one.end_lineno + 1)} & reached
    ]


def test_each_error_has_a_case(tmp_path: Path) -> None:
    files = [path for pattern in FILES for path in ROOT.glob(pattern)]
    names, reached = {*map(str, files)}, set[tuple[str, int]]()

    def trace(frame: FrameType, event: str, _: object) -> Any:
        if frame.f_code.co_filename in names:
            if event == "exception":
                reached.add((frame.f_code.co_filename, frame.f_lineno))
            return trace
        return None

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        for given, *_ in CASES.values():
            with suppress(ConfigError):
                given.do(tmp_path)
    finally:
        sys.settrace(before)
    assert without_case(files, reached) == [], "add them to CASES"
    (tmp_path / "new.py").write_text("raise ConfigError('new')")
    assert without_case([tmp_path / "new.py"], reached) == ["raise ConfigError('new')"]
