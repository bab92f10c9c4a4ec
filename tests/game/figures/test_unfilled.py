"""Silhouettes that cannot be filled are approached."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageDraw

from conf.cli import composed
from tangram_agent.runs import load_run
from tangram_game.cli import _play
from tangram_game.figures.silhouettes import RED, read_silhouette
from tangram_vision import solving

pytestmark = pytest.mark.slow

SQUARE = [[0, 0], [1, 0], [1, 1], [0, 1]]
STRIP = [[0, 0], [3, 0], [3, 0.33], [0, 0.33]]


@pytest.fixture(autouse=True)
def _no_hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock decides nothing where other work takes the processor."""
    monkeypatch.setattr("tangram_vision.solving.SECONDS", 60.0)
    monkeypatch.setattr("tangram_vision.solving.NEAREST_SECONDS", 60.0)


def outline(path: Path, *rings: Any, **more: Any) -> str:
    content = {"format": "tangram-outlines", "version": 1, "outlines": list(rings)} | more
    path.write_text(json.dumps(content))
    return str(path)


def near(name: str, least: float) -> str:
    """What is told of a figure that nothing fills, and that comes so near."""
    shown = read_silhouette(name, name, load_run("pretrained/tangram7").task)
    assert not shown.exact
    why, _, how = shown.told.partition("; ")
    assert float(how.removeprefix("the nearest figure has IoU ").removesuffix(" with it")) > least
    differs = (np.asarray(shown.picture.convert("RGB")) == RED).all(axis=2)
    assert np.count_nonzero(differs) > 300
    return why


def test_what_nothing_fills_is_approached_and_red_where_it_differs(tmp_path: Path) -> None:
    strip = outline(tmp_path / "strip.json", STRIP)
    told = near(strip, 0.5)
    assert re.fullmatch(
        r"cannot be filled with the seven tans: all ways were tried, \d+ steps", told
    )


def test_so_is_a_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disc: no tans fill it."""
    monkeypatch.setattr("tangram_vision.solving.SECONDS", 0.5)
    canvas = Image.new("L", (400, 400), 235)
    ImageDraw.Draw(canvas).ellipse([(100, 100), (300, 300)], 30)
    canvas.save(tmp_path / "it.png")
    assert near(str(tmp_path / "it.png"), 0.8).startswith("was not filled with the seven tans in ")


def test_so_is_one_that_tells_another_size(tmp_path: Path) -> None:
    wide = outline(tmp_path / "it.json", STRIP, side=1.25)
    assert "is 0.63 times as large as the seven tans by its side, and not filled" in near(wide, 0.5)


def test_a_wrong_size_is_no_matter_where_tans_fill_the_figure(tmp_path: Path) -> None:
    large = outline(tmp_path / "it.json", SQUARE, side=0.5)
    shown = read_silhouette(large, large, load_run("pretrained/tangram7").task)
    assert shown.exact


@pytest.mark.parametrize("fails", [False, True])
def test_the_command_searches_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    searched, fill = list[str](), solving.fill_silhouette

    def counted(name: str, *rest: Any) -> Any:
        searched.append(name)
        return fill(name, *rest)

    monkeypatch.setattr(solving, "fill_silhouette", counted)
    name = outline(tmp_path / "it.json", STRIP if fails else SQUARE)
    given = [f"silhouette={name}", f"out={tmp_path}/it.png", "sim.backend=kinematic"]
    assert _play(composed("play", given)) == 0
    assert searched == [name]
    assert (tmp_path / "it.png").exists()
