"""Puzzles as SVG drawings, and drawings and attributes that are none."""

import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tangram_core.arrays import Floats
from tangram_core.errors import ConfigError
from tangram_sim.puzzles.figures import load_puzzle, parse_svg_puzzle, read_puzzles
from tangram_sim.puzzles.svg_attributes import path_points, polygon_points, transform_matrix
from tests.sim.puzzles.drawings import FIGURES, distance, figure

pytestmark = pytest.mark.fast

FORMS = "a transform must be matrix, translate, scale, rotate or skew with its numbers"
SIZE = 137.0  # of the full square, in the drawing's units


def corners_of(name: str) -> list[Floats]:
    """In the drawing: y points down."""
    entries = figure(name)["pieces"]
    return [np.array(piece["corners"]) * (SIZE, -SIZE) + (300, 200) for piece in entries]


def polygon(corners: Floats, more: str = "") -> str:
    points = " ".join(f"{x:.9f},{y:.9f}" for x, y in corners)
    return f'<polygon points="{points}" {more}/>'


def drawing(*elements: str) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 600 400">{"".join(elements)}</svg>'
    )


def whole(name: str) -> str:
    return drawing(*(polygon(corners) for corners in corners_of(name)))


# Round trips


def check_drawn(text: str, name: str) -> None:
    (puzzle,) = parse_svg_puzzle(text, name)
    assert (puzzle.name, puzzle.pieces) == (name, load_puzzle(name).pieces)
    assert distance(puzzle.corners, load_puzzle(name), 0.0) < 1e-6


@pytest.mark.parametrize("name", sorted(FIGURES))
def test_a_figure_drawn_as_polygons_comes_back(name: str) -> None:
    check_drawn('<?xml version="1.0" encoding="UTF-8"?>\n' + whole(name), name)


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
    check_drawn(drawing(*(path_of(corners, style) for corners in corners_of("lady"))), "lady")


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
    check_drawn(drawing(*parts), "cat")


def test_a_mirroring_transform_turns_the_parallelogram_over() -> None:
    text = drawing(f'<g transform="scale(-1 1)">{whole("cat")}</g>')
    (puzzle,) = parse_svg_puzzle(text, "cat")
    assert {*puzzle.pieces, *load_puzzle("cat").pieces} >= {"parallelogram_mirrored"}
    assert puzzle.pieces[-1] != load_puzzle("cat").pieces[-1]


def test_pieces_are_read_as_drawing_tools_write_them() -> None:
    """A square as a turned <rect>, nodes within an edge, an outline as a polyline, and skew."""
    square, *triangles, parallelogram = corners_of("cat")
    side, turn = np.linalg.norm(square[1] - square[0]), square[1] - square[0]
    angle = np.degrees(np.arctan2(turn[1], turn[0]))
    (x, y), sign = square[0], np.sign(np.linalg.det([turn, square[2] - square[1]]))
    rect = (
        f'<rect x="0" y="{0.0 if sign > 0 else -side}px" rx="1" width="{side}" height="{side}px" '
        f'transform="translate({x} {y}) rotate({angle})"/>'
    )
    first = np.insert(triangles[0], 1, triangles[0][:2].mean(axis=0), axis=0)
    skew = np.linalg.inv(transform_matrix("skewX(20) skewY(-5)", "it"))[:2, :2]
    skewed = polygon(parallelogram @ skew.T, 'transform="skewX(20) skewY(-5)"')
    line = polygon(triangles[1]).replace("polygon", "polyline")
    rest = [polygon(corners) for corners in triangles[2:]]
    doctype = '<!DOCTYPE svg PUBLIC "-//W3C//DTD SVG 1.1//EN" "svg11.dtd">'
    check_drawn(doctype + drawing(polygon(first), line, *rest, rect, skewed), "cat")


def test_what_is_not_drawn_or_no_polygon_does_not_count(tmp_path: Path) -> None:
    extra = polygon(np.array([(0, 0), (9, 0), (0, 9)]))
    hidden = f"<defs>{extra}</defs><clipPath>{extra}</clipPath>"
    hidden += f'<g style="fill:red;display: none">{extra}</g><g visibility="hidden">{extra}</g>'
    named, other = "<title>A cat</title><!-- by hand -->", '<rect width="600" height="400"/>'
    other += '<rect width="100%" height="100%"/><circle r="9"/>'
    path = tmp_path / "cat.SVG"
    path.write_text(drawing(named, hidden, other, whole("cat")))
    assert [puzzle.name for puzzle in read_puzzles(path)] == ["cat"]
    sized = whole("cat").replace('viewBox="0 0 600 400"', 'width="600px" height="400px"')
    path.write_text(sized.replace("</svg>", '<rect width="600" height="400"/></svg>'))
    assert [puzzle.name for puzzle in read_puzzles(path)] == ["cat"]


# Refusals

TRIANGLE = '<polygon points="0,0 1,0 0,1"/>'
NESTED = "SVG 'it' nests deeper than 50 groups: ungroup it"
DOCTYPE = "SVG 'it' must have no ENTITY and no DOCTYPE with [...]: delete them"
FAR = "SVG 'it', polygon 1 must lie within +-1e+06: scale it down"
FIVE = '<polygon points="0,0 1,0 1,1 0,1 -1,.5"/>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "SVG 'it' is not XML: no element found: line 1, column 0"),
        ("<svg>&a;</svg>", "SVG 'it' is not XML: undefined entity"),
        ("<html/>", "SVG 'it' must be an <svg> element, got <html>"),
        ("<svg/>", "puzzle 'it': must draw 7 polygons or paths, got 0"),
        (f"<svg>{TRIANGLE * 17}</svg>", "SVG 'it' draws more than 16 polygons: draw 7"),
        ("<!DOCTYPE svg[]><svg/>", DOCTYPE),
        ("<svg><!ENTITY a></svg>", DOCTYPE),
        ("<!doctype " * 20_000, "SVG 'it' is not XML: syntax error"),  # in no time
        (f"<svg>{'<g/>' * 900_000}</svg>", "SVG 'it' has more than 20000 tags: draw 7 polygons"),
        (f"<svg>{'<rect width=1in />' * 7}</svg>".replace("1in", "'1in'"), "width: numbers cannot"),
        ('<!doctype s [<!ENTITY a "b">]><svg>&a;</svg>', DOCTYPE),
        (f"<svg>{'<g>' * 60}{'</g>' * 60}</svg>", NESTED),
        (f"<svg>{'<g>' * 9_000}{'</g>' * 9_000}</svg>", NESTED),
        (f"<svg>{' ' * 2**22}</svg>", "SVG 'it' is longer than 4194304 characters: simplify"),
        (f"<svg>{TRIANGLE * 6}{FIVE}</svg>", "piece 7: must have 3 or 4 corners, got 5"),
        (f"<svg>{TRIANGLE.replace('0,1', '2,0') * 7}</svg>", "must have 3 or 4 corners, got 0"),
        (f"<svg>{TRIANGLE * 7}</svg>", "has 0 large_triangle (must be 2), 7 medium_triangle (mus"),
        (f'<svg><g transform="scale(1e7)">{TRIANGLE}</g></svg>', FAR),
    ],
)
def test_a_drawing_that_is_no_puzzle_is_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_svg_puzzle(text, "it")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_declared_encoding_cannot_hide_a_doctype(tmp_path: Path) -> None:
    path = tmp_path / "cat.svg"
    path.write_bytes("<!DOCTYPE svg[]><svg/>".encode("utf-16"))
    with pytest.raises(ConfigError, match="is not UTF-8: save it as UTF-8"):
        read_puzzles(path)
    path.write_text('<?xml version="1.0" encoding="UTF-7"?>+ADwAIQ-DOCTYPE svg+AD4-<svg/>')
    with pytest.raises(ConfigError, match="SVG 'cat' is not XML"):
        read_puzzles(path)


@pytest.mark.parametrize(
    ("text", "points"),
    [
        ("M1,2L3,4 5,6Z", [(1, 2), (3, 4), (5, 6)]),
        (" m1 2 3 4l5 6z ", [(1, 2), (4, 6), (9, 12)]),
        ("M1 2H5V7h-1v-1.5z", [(1, 2), (5, 2), (5, 7), (4, 7), (4, 5.5)]),
        ("M.5.5-1-1,1e1-2E-1", [(0.5, 0.5), (-1, -1), (10, -0.2)]),
        ("M0 0H1 2 3", [(0, 0), (1, 0), (2, 0), (3, 0)]),
    ],
)
def test_paths_of_straight_lines_are_read(text: str, points: list[tuple[float, float]]) -> None:
    np.testing.assert_allclose(path_points(text, "it"), points)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "it: a path must start with M, got ''"),
        ("3M1 2", "it: a path must start with M, got '3M1 2'"),
        ("M1 2C1 2 3 4 5 6", "it: a path must be one outline of M, L, H, V, Z, got C at step 2: d"),
        ("M1 2L3 4ZL5 6", "it: a path must end with its first Z: draw one piece per path"),
        ("M1", "it: M takes 2 or a multiple of it numbers, got 1"),
        ("M1 2H", "it: H takes 1 or a multiple of it numbers, got 0"),
        ("M1 2Z3", "it: Z takes no numbers, got 1"),
        ("M1 2L3 #", "it: numbers cannot be read from '3 #'"),
        ("M1 1e999", "it: numbers must be finite, got '1 1e999'"),
        ("M" + "1 " * 66, "it: at most 64 numbers, got 66: draw straight lines"),
    ],
)
def test_other_paths_are_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}"):
        path_points(text, "it")


@pytest.mark.parametrize("read", [path_points, polygon_points, transform_matrix])
def test_attributes_are_bounded(read: Callable[[str, str], Floats]) -> None:
    with pytest.raises(ConfigError, match="it: an attribute must have at most 4096 characters"):
        read("M" * 4097, "it")
    with pytest.raises(ConfigError, match="it: points must be pairs, got 3 numbers: add one"):
        polygon_points("1 2 3", "it")


@pytest.mark.parametrize(
    ("text", "goal"),
    [
        ("", (1, 2)),
        ("translate(3)", (4, 2)),
        ("translate(3,4)", (4, 6)),
        ("scale(2)", (2, 4)),
        ("scale(2 -1)", (2, -2)),
        ("rotate(90)", (-2, 1)),
        ("rotate(90 1 1)", (0, 1)),
        ("matrix(1 2 3 4 5 6)", (12, 16)),
        ("translate(3) scale(2)", (5, 4)),
        ("scale(2), translate(3)", (8, 4)),
    ],
)
def test_transforms_move_points(text: str, goal: tuple[float, float]) -> None:
    np.testing.assert_allclose((transform_matrix(text, "it") @ (1, 2, 1))[:2], goal, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("skewX(3 4)", f"it: {FORMS}"),
        ("shear(3)", f"it: {FORMS}"),
        ("scale(2", "it: transform 'scale(2' cannot be read: check its brackets"),
        ("scale(a)", "it, transform scale: numbers cannot be read from 'a'"),
        ("scale(1e999)", "it, transform scale: numbers must be finite, got '1e999'"),
    ],
)
def test_other_transforms_are_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}"):
        transform_matrix(text, "it")


@settings(max_examples=200)
@given(st.text("MLHVZmlhvzC0123.,-+e ()translcomix", max_size=30))
def test_whatever_stands_in_an_attribute_is_read_or_refused(text: str) -> None:
    for read, size in ((path_points, 2), (polygon_points, 2), (transform_matrix, 3)):
        for attribute in (text, f"M1 2{text}", f"scale({text})"):
            with suppress(ConfigError):
                assert read(attribute, "it").shape[1] == size
