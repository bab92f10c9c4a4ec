"""Transforms, points and paths as SVG writes them, and text that is none."""

from collections.abc import Callable
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tangram_sim.arrays import Floats
from tangram_sim.errors import ConfigError
from tangram_sim.svg_attributes import path_points, polygon_points, transform_matrix

pytestmark = pytest.mark.fast


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
        ("L1 2", "it: a path must start with M, got 'L1 2'"),
        ("3M1 2", "it: a path must start with M, got '3M1 2'"),
        (
            "M1 2C1 2 3 4 5 6",
            "it: a path must be one outline of M, L, H, V, Z, got C at step 2: dr",
        ),
        (
            "M1 2 3 4 5 6M1 2",
            "it: a path must be one outline of M, L, H, V, Z, got M at step 2: dr",
        ),
        ("M1 2L3 4ZL5 6", "it: a path must end with its first Z: draw one piece per path"),
        ("M1", "it: M takes 2 or a multiple of it numbers, got 1"),
        ("M1 2H", "it: H takes 1 or a multiple of it numbers, got 0"),
        ("M1 2Z3", "it: Z takes no numbers, got 1"),
        ("M1 2L3 #", "it: numbers cannot be read from '3 #'"),
        ("M1 2L3 e", "it: numbers cannot be read from '3 e'"),
        ("M1 1e999", "it: numbers must be finite, got '1 1e999'"),
        ("M" + "1 " * 66, "it: at most 64 numbers, got 66: draw straight lines"),
    ],
)
def test_other_paths_are_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        path_points(text, "it")
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize("read", [path_points, polygon_points, transform_matrix])
def test_attributes_are_bounded(read: Callable[[str, str], Floats]) -> None:
    with pytest.raises(ConfigError, match="it: an attribute must have at most 4096 characters"):
        read("M" * 4097, "it")


def test_points_must_be_pairs() -> None:
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
        ("skewX(3)", "it: a transform must be matrix, translate, scale or rotate with its numbers"),
        ("rotate(1 2)", "it: a transform must be matrix, translate, scale or rotate with its num"),
        ("scale()", "it: a transform must be matrix, translate, scale or rotate with its numbers"),
        ("scale(2", "it: transform 'scale(2' cannot be read: check its brackets"),
        ("scale(2))", "it: transform 'scale(2))' cannot be read: check its brackets"),
        ("scale(a)", "it, transform scale: numbers cannot be read from 'a'"),
        ("scale(1e999)", "it, transform scale: numbers must be finite, got '1e999'"),
    ],
)
def test_other_transforms_are_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        transform_matrix(text, "it")
    assert str(caught.value).startswith(message)


@settings(max_examples=200, deadline=None)
@given(st.text("MLHVZmlhvzC0123.,-+e ()translcomix", max_size=30))
def test_whatever_stands_in_an_attribute_is_read_or_refused(text: str) -> None:
    for read, size in ((path_points, 2), (polygon_points, 2), (transform_matrix, 3)):
        for attribute in (text, f"M1 2{text}", f"scale({text})"):
            with suppress(ConfigError):
                assert read(attribute, "it").shape[1] == size
