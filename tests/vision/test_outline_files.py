"""Files of outlines: read, bounded, and joined to one area."""

import json
import time
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tangram_core.arrays import Floats
from tangram_core.errors import ConfigError
from tangram_vision.given.outline_files import MAX_MEETINGS, _meetings, read_outline
from tangram_vision.given.silhouette_files import Silhouette, _traced, fill_silhouette
from tests.sim.builders import SEVEN, layout_of

pytestmark = pytest.mark.fast

LAYOUT = layout_of(*SEVEN, scale=0.6)
SQUARE = [[0, 0], [1, 0], [1, 1], [0, 1]]
TOP = '{"format": "tangram-outlines", "version": 1, "outlines": '


def ring(count: int, radius: Any = 1.0) -> Floats:
    turn = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return np.column_stack([np.cos(turn), np.sin(turn)]) * np.reshape(radius, (-1, 1))


def comb(teeth: int) -> Floats:
    across = np.repeat(np.arange(2 * teeth) / (2.0 * teeth), 2)
    up = np.tile([0.1, 1.0, 1.0, 0.1], teeth)
    return np.vstack([np.column_stack([across, up]), [[1.0, 0.1], [1.0, 0.0], [0.0, 0.0]]])


def write(path: Path, *rings: Any, **more: Any) -> str:
    drawn = [np.asarray(one).tolist() for one in rings]
    content = {"format": "tangram-outlines", "version": 1, "outlines": drawn} | more
    path.write_text(json.dumps(content))
    return str(path)


def filled(path: Path, *rings: Any, **more: Any) -> Silhouette:
    return fill_silhouette(write(path, *rings, **more), "it", LAYOUT, 0.6, 1.0)


def test_an_outline_within_another_is_a_hole_and_within_that_an_island(tmp_path: Path) -> None:
    every = [np.array(SQUARE) * (10.0 - 2.0 * i) + i for i in range(4)]
    drawn = read_outline(write(tmp_path / "it.json", *every[::-1], side=3), "it")
    assert drawn.area.area == pytest.approx(100 - 64 + 36 - 16)
    assert drawn.side == 3.0
    assert read_outline(write(tmp_path / "it.json", SQUARE), "it").side is None
    shown = filled(tmp_path / "it.json", *every)
    row = shown.mask[shown.mask.shape[0] // 2]
    assert np.count_nonzero(np.diff(row.astype(np.int8)) == 1) == 4


def test_digits_far_from_the_origin_are_kept(tmp_path: Path) -> None:
    path = write(tmp_path / "it.json", np.array(SQUARE) * 1e-3 + 9e5)
    assert read_outline(path, "it").area.area == pytest.approx(1e-6, rel=1e-5)


@pytest.mark.parametrize(("width", "share"), [(0.83, 0.83), (1.2, 1.2), (1.0, None), (1.04, None)])
def test_a_side_tells_the_area(tmp_path: Path, width: float, share: float | None) -> None:
    """A drawing of ten units for the full square's side."""
    drawn = filled(tmp_path / "it.json", np.array(SQUARE) * (10.0 * width, 10.0), side=10)
    assert drawn.share == (None if share is None else pytest.approx(share, abs=0.005))
    assert drawn.area.area == pytest.approx(LAYOUT.areas.sum())


def test_without_a_side_nothing_is_said_of_the_area(tmp_path: Path) -> None:
    drawn = filled(tmp_path / "it.json", np.array(SQUARE) * 17.0)
    assert drawn.share is None
    assert drawn.filled.solved


WRONG = {
    f"{TOP}{{}}}}": r"outlines must be a list of 1 to 100, got \{\}",
    f"{TOP}{[ring(10_000).tolist()]}}}": "outline 1 must be a list of 3 to 2000 corners, got 100",
    f"{TOP}[{SQUARE}, [[0, 0], [NaN, 1], [1, 1]]]}}": r"outline 2: a corner must be \[x, y\], fin",
    f"{TOP}[[[0, 0], [1, 1e999], [1, 1]]]}}": r"finite and within \+-1e\+06",
    f"{TOP}[[[0, 0], [1, {'9' * 5000}], [1, 1]]]}}": "is not JSON that can be read",
    f"{TOP}[[[0, 0], [1, true], [1, 1]]]}}": "outline 1: a corner must be",
    f'{TOP}[{SQUARE}], "side": NaN}}': "side must be a number",
    f"{TOP}{np.random.default_rng(0).random((1, 200, 2)).tolist()}}}": "meet more than 1000 times",
    f"{TOP}{[comb(240).tolist(), comb(240)[:, ::-1].tolist()]}}}": "meet more than 1000 times",
    f"{TOP}{[[[x, 0] for x in np.random.default_rng(0).random(400).tolist()]]}}}": "meet more than",
    "[" * 1_000_000: "is not JSON that can be read",
}


@pytest.mark.parametrize("text", WRONG, ids=range(len(WRONG)))
def test_what_no_outline_can_be_is_told_in_one_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "it.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match=WRONG[text]) as raised:
        read_outline(str(path), "it")
    assert len(str(raised.value)) < 300
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "rings",
    [
        [ring(2_000)],
        [ring(2_000, 1.0 + 0.2 * np.random.default_rng(0).random(2_000))],
        [ring(2_000, 1.0 + 0.5 * (np.arange(2_000) % 2))],
        [np.random.default_rng(0).random((50, 2))],
        [ring(3, 0.1) + (i % 10, i // 10) for i in range(100)],
        [ring(19, 1.0 - i / 101) for i in range(100)],
        [comb(15), comb(15)[:, ::-1]],
        [np.array([[0.0, 0.0], [1e6, 0.0], [1e6, 1e-3]])],
    ],
)
def test_what_nothing_fills_is_left_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rings: list[Floats]
) -> None:
    """By a clock on which a look takes 50 ms: it is looked at in time, and not for long after."""
    looks = count()
    monkeypatch.setattr(time, "thread_time", lambda: 0.05 * next(looks))
    drawn = filled(tmp_path / "it.json", *rings)
    assert not drawn.filled.solved
    assert next(looks) < 40  # 20 of them are the time that it is given


def test_sides_that_meet_are_counted_but_for_neighbours() -> None:
    square, tooth = np.array(SQUARE, np.float64), np.array([[0.2, 0.5], [0.4, 2.0], [0.6, 0.5]])
    assert _meetings([square]) == 0
    assert _meetings([square, square + 3.0]) == 0
    assert _meetings([square, tooth]) == 2
    assert _meetings([square, square + (1.0, 0.0)]) == 7  # one whole side, at its ends others
    assert _meetings([square[[0, 2, 1, 3]]]) == 1
    assert _meetings([np.random.default_rng(0).random((2_000, 2))]) < 2 * MAX_MEETINGS + 2_000


def test_a_picture_is_traced_with_its_holes_and_what_lies_in_them() -> None:
    cover = np.zeros((60, 60), np.float32)
    cover[10:50, 10:50] = 1.0
    cover[20:30, 20:30] = 0.0
    cover[24:26, 24:26] = 1.0
    area = _traced(cover, 0.1)
    # Half a pixel's corners are cut off, each an eighth of it.
    expected = (40**2 - 10**2 + 2**2) - 4 / 8 + 4 / 8 - 4 / 8
    assert area.area == pytest.approx(expected * 0.01)
    assert area.bounds == pytest.approx((1.0, -5.0, 5.0, -1.0))
