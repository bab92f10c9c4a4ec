"""The script that makes the package's puzzles: what it writes, and designs that are none."""

import re
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from tangram_lab.experiments import puzzles as puzzles_module
from tangram_lab.experiments.designs import PAPER, TEST, TRAIN
from tangram_lab.experiments.puzzles import GRID, atoms, figure_pieces, file_text, sheet, tilings
from tangram_sim.errors import ConfigError
from tangram_sim.puzzles import PACKAGED, library

pytestmark = pytest.mark.fast


@pytest.mark.parametrize(("split", "designs"), [("train", TRAIN), ("test", TEST), ("paper", PAPER)])
def test_the_packaged_files_are_those_of_the_designs(
    split: str, designs: Mapping[str, str]
) -> None:
    """But for the last digit: a machine's sines and roots may round otherwise."""
    number = r"-?\d+\.\d+"
    kept = (PACKAGED / f"{split}.json").read_text(encoding="utf-8")
    made = file_text(designs)
    assert re.sub(number, "0.0", kept) == re.sub(number, "0.0", made)
    numbers = ([float(one) for one in re.findall(number, text)] for text in (kept, made))
    np.testing.assert_allclose(*numbers, rtol=0, atol=1.5e-12)


def test_a_part_is_turned_about_its_first_corner_and_moved() -> None:
    ((kind, corners),) = figure_pieces("S ^1 @1+2h,-0.5r")
    assert kind == "small_triangle"
    h, r = 0.5**0.5, 2.0**0.5
    first = np.array([1 + 2 * h, -0.5 * r])
    np.testing.assert_allclose(corners / GRID, [first, first + (h, h), first + (-h, h)], atol=1e-12)


def test_an_outline_is_filled() -> None:
    pieces = figure_pieces("LLMSSQP 0,0 4,0 4,2 0,2")
    kinds = sorted(kind for kind, _ in pieces)
    assert len(kinds) == 7
    corners = np.concatenate([corners for _, corners in pieces]) / GRID
    np.testing.assert_allclose((corners.min(axis=0), corners.max(axis=0)), [(0, 0), (4, 2)])


def test_all_tilings_of_an_outline_are_found() -> None:
    area = atoms([[(0, 0), (2, 0), (2, 1), (0, 1)]])
    assert len(area) == 8
    assert len(list(tilings("SSP", area))) == 2  # the two small triangles in either order
    assert not list(tilings("SSS", area))


@pytest.mark.parametrize(
    ("design", "message"),
    [
        ("X", "figure 'it': a part must be 'LETTERS outline .turn @x,y', got 'X'"),
        ("Q ^9", "figure 'it': a part must be 'LETTERS outline .turn @x,y', got 'Q .9'"),
        ("LL 0,0 1,0 1,1 0,1", "figure 'it': LL do not fill .* whose area is 1"),
        ("Q / Q @0.5,0.5", "off their shapes and lie 0.177 deep in each other"),
    ],
)
def test_a_wrong_design_is_refused(design: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        file_text({"it": design})


def test_the_sheet_shows_every_figure() -> None:
    few = library("test")[:3]
    assert sheet(few, columns=3, size=40).width > 3 * 40


@pytest.mark.parametrize(("option", "status"), [("--help", 0), ("out=x", 2)])
def test_help_and_what_is_unknown_write_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str, status: int
) -> None:
    monkeypatch.setattr(puzzles_module, "ROOT", tmp_path)
    monkeypatch.setattr(sys, "argv", ["puzzles", option])
    with pytest.raises(SystemExit) as ended:
        puzzles_module.main()
    assert ended.value.code == status
    assert list(tmp_path.iterdir()) == []
