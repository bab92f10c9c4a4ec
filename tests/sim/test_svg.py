"""Puzzles as SVG drawings, and drawings that are none."""

from pathlib import Path

import numpy as np
import pytest

from tangram_sim.arrays import Floats
from tangram_sim.errors import ConfigError
from tangram_sim.puzzles import load_puzzle, parse_svg_puzzle, read_puzzles
from tangram_sim.svg_attributes import transform_matrix
from tests.sim.drawings import FIGURES, figure
from tests.sim.test_fitting import distance

pytestmark = pytest.mark.fast

SIZE = 137.0  # of the full square, in the drawing's units


def corners_of(name: str) -> list[Floats]:
    """In the drawing: y points down."""
    entries = figure(name)["pieces"]
    return [np.array(piece["corners"]) * (SIZE, -SIZE) + (300, 200) for piece in entries]


def polygon(corners: Floats, more: str = "") -> str:
    points = " ".join(f"{x:.9f},{y:.9f}" for x, y in corners)
    return f'<polygon points="{points}" {more}/>'


def drawing(*elements: str) -> str:
    inside = "\n".join(elements)
    return f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 600 400">{inside}</svg>'


def whole(name: str) -> str:
    return drawing(*(polygon(corners) for corners in corners_of(name)))


# Round trips


@pytest.mark.parametrize("name", sorted(FIGURES))
def test_a_figure_drawn_as_polygons_comes_back(name: str, tmp_path: Path) -> None:
    path = tmp_path / f"{name}.SVG"
    path.write_text('<?xml version="1.0" encoding="UTF-8"?>\n' + whole(name))
    (puzzle,) = read_puzzles(path).puzzles
    true = load_puzzle(name)
    assert (puzzle.name, puzzle.pieces) == (name, true.pieces)
    assert distance(puzzle.corners, true, 0.0) < 1e-6


def path_of(corners: Floats, style: int) -> str:
    (x, y), *rest = corners
    steps = np.diff(corners, axis=0)
    if style == 0:
        text = f"M{x},{y}L" + " ".join(f"{a} {b}" for a, b in rest) + "Z"
    elif style == 1:
        text = f"m {x} {y} " + " ".join(f"l{a:.12f},{b:.12f}" for a, b in steps) + " z"
    else:  # further pairs of M are lines; back to the start, not closed
        text = f"M {x} {y} " + " ".join(f"{a},{b}" for a, b in [*rest, corners[0]])
    return f'<path fill="red" d="{text}"/>'


@pytest.mark.parametrize("style", [0, 1, 2])
def test_a_figure_drawn_as_paths_comes_back(style: int) -> None:
    text = drawing(*(path_of(corners, style) for corners in corners_of("lady")))
    (puzzle,) = parse_svg_puzzle(text, "lady").puzzles
    assert distance(puzzle.corners, load_puzzle("lady"), 0.0) < 1e-6


def test_transforms_of_elements_and_groups_apply_from_the_inside_out() -> None:
    parts = []
    for k, corners in enumerate(corners_of("cat")):
        # Each piece lies turned about a point, shrunk and moved; the transforms undo that.
        turn = f"rotate({10 * k} 40 {k})"
        motion = transform_matrix(f"translate(5) scale(2 2) {turn} matrix(0 1 -1 0 3 -4)", "it")
        inverse = np.linalg.inv(motion)
        local = corners @ inverse[:2, :2].T + inverse[:2, 2]
        inner = polygon(local, f'transform="{turn},matrix(0,1,-1,0,3,-4)"')
        parts.append(f'<g transform="translate(5)"><g><g transform="scale(2)">{inner}</g></g></g>')
    (puzzle,) = parse_svg_puzzle(drawing(*parts), "cat").puzzles
    assert distance(puzzle.corners, load_puzzle("cat"), 0.0) < 1e-6


def test_a_mirroring_transform_turns_the_parallelogram_over() -> None:
    text = drawing(f'<g transform="scale(-1 1)">{whole("cat")}</g>')
    (puzzle,) = parse_svg_puzzle(text, "cat").puzzles
    assert {*puzzle.pieces, *load_puzzle("cat").pieces} >= {"parallelogram_mirrored"}
    assert puzzle.pieces[-1] != load_puzzle("cat").pieces[-1]


def test_what_is_not_drawn_or_no_polygon_does_not_count() -> None:
    extra = polygon(np.array([(0, 0), (9, 0), (0, 9)]))
    text = drawing(
        "<title>A cat</title><!-- by hand -->",
        f"<defs>{extra}</defs><clipPath>{extra}</clipPath>",
        '<rect width="600" height="400"/>',
        whole("cat"),
    )
    assert len(parse_svg_puzzle(text, "cat").puzzles) == 1


# Refusals

TRIANGLE = '<polygon points="0,0 1,0 0,1"/>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "SVG 'it' is not XML: no element found: line 1, column 0"),
        ("<svg>", "SVG 'it' is not XML: no element found: line 1, column 5"),
        ("<html/>", "SVG 'it' must be an <svg> element, got <html>"),
        ("<svg/>", "puzzle 'it': must draw 7 polygons or paths, got 0"),
        (f"<svg>{TRIANGLE * 6}</svg>", "puzzle 'it': must draw 7 polygons or paths, got 6"),
        (f"<svg>{TRIANGLE * 17}</svg>", "SVG 'it' draws more than 16 polygons: draw 7"),
        ("<!DOCTYPE svg><svg/>", "SVG 'it' must have no DOCTYPE and no ENTITY: delete them"),
        (
            '<!doctype s [<!ENTITY a "b">]><svg>&a;</svg>',
            "SVG 'it' must have no DOCTYPE and no ENTITY: delete them",
        ),
        ("<svg>&a;</svg>", "SVG 'it' is not XML: undefined entity"),
        ("<svg>" + "<g>" * 60 + "</g>" * 60 + "</svg>", "SVG 'it' nests deeper than 50 groups: un"),
        (
            "<svg>" + "<g>" * 50_000 + "</g>" * 50_000 + "</svg>",
            "SVG 'it' nests deeper than 50 groups: ungroup it",
        ),
        ("<svg>" + " " * 2**22 + "</svg>", "SVG 'it' is longer than 4194304 characters: simplify"),
        (
            f'<svg>{TRIANGLE * 6}<polygon points="0,0 1,0 1,1 0,1 0,.5"/></svg>',
            "puzzle 'it', piece 7: must have 3 or 4 corners, got 5",
        ),
        (
            f"<svg>{TRIANGLE * 6}<polygon/></svg>",
            "puzzle 'it', piece 7: must have 3 or 4 corners, got 0",
        ),
        (f"<svg>{TRIANGLE.replace('1', '0') * 7}</svg>", "must have 3 or 4 corners, got"),
        (
            "<svg>" + '<polygon points="0,0 1,0 2,0"/>' * 7 + "</svg>",
            "puzzle 'it': its polygons have no area: draw them larger",
        ),
        (
            f"<svg>{TRIANGLE * 7}</svg>",
            "puzzle 'it': has 0 large_triangle (must be 2), 7 medium_triangle (must be 1), 0 small",
        ),
        (
            f'<svg><g transform="scale(1e7)">{TRIANGLE}</g></svg>',
            "SVG 'it', polygon 1 must lie within +-1e+06: scale it down",
        ),
        (
            f'<svg><g transform="scale(1e300) scale(1e300)">{TRIANGLE}</g></svg>',
            "SVG 'it', polygon 1 must lie within +-1e+06: scale it down",
        ),
    ],
)
def test_a_drawing_that_is_no_puzzle_is_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_svg_puzzle(text, "it")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_skip_invalid_returns_the_faults_of_a_drawing() -> None:
    pieces = [polygon(corners) for corners in corners_of("cat")]
    loaded = parse_svg_puzzle(drawing(*pieces[:6]), "cat", skip_invalid=True)
    assert loaded.puzzles == ()
    assert loaded.faults == ("puzzle 'cat': must draw 7 polygons or paths, got 6",)


def test_a_declared_encoding_cannot_hide_a_doctype(tmp_path: Path) -> None:
    path = tmp_path / "cat.svg"
    path.write_bytes("<!DOCTYPE svg><svg/>".encode("utf-16"))
    with pytest.raises(ConfigError, match="is not UTF-8: save it as UTF-8"):
        read_puzzles(path)
    path.write_text('<?xml version="1.0" encoding="UTF-7"?>+ADwAIQ-DOCTYPE svg+AD4-<svg/>')
    with pytest.raises(ConfigError, match="SVG 'cat' is not XML"):
        read_puzzles(path)
