"""tangram-play silhouette=: files of outlines and pictures, and such as cannot be filled."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from PIL import Image, ImageDraw

from tangram_agent.runs import load_run
from tangram_core.errors import ConfigError
from tangram_game.config import EvalConfig, PlayConfig
from tangram_game.evaluate import evaluate_run
from tangram_game.figures.silhouettes import read_silhouette
from tangram_game.play import play_run
from tangram_sim.geometry.rings import covered_area
from tangram_sim.puzzles.figures import PACKAGED, load_puzzle
from tangram_vision.given.silhouette_files import Silhouette, fill_silhouette
from tests.agent.agents.outline.outlines import AGENT as FILLER
from tests.agent.agents.outline.outlines import SIM as OUTLINES
from tests.sim.builders import SEVEN
from tests.vision.aslant import photographed
from tests.worker.builders import write_run

pytestmark = pytest.mark.slow

SQUARE = '<path d="M 1 1 H 9 V 9 H 1 Z"/>'


@pytest.fixture(autouse=True)
def _no_hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock decides nothing where other work takes the processor."""
    monkeypatch.setattr("tangram_vision.solving.SECONDS", 60.0)


def svg(path: Path, *content: str) -> str:
    path.write_text(f'<svg xmlns="http://www.w3.org/2000/svg">{"".join(content)}</svg>')
    return str(path)


def picture(path: Path, ground: int = 235, ink: int = 40) -> str:
    """The cat, turned, drawn large and averaged."""
    puzzle, times = load_puzzle("cat", 1.0), 4
    corners = puzzle.corners @ (1.0, 1j) * np.exp(0.4j) * 75.0 * times
    canvas = Image.new("L", (400 * times, 300 * times), ground)
    for k in range(7):
        own = corners[puzzle.layout.corners_of(k)] + (200.0 - 150.0j) * times
        ImageDraw.Draw(canvas).polygon([(float(z.real), float(-z.imag)) for z in own], ink)
    canvas.reduce(times).save(path)
    return str(path)


def read(name: str) -> object:
    return read_silhouette(name, "it", load_run("pretrained/tangram7").task)


@pytest.mark.parametrize(
    "name",
    [
        *("cat", "cat.png", "dark.jpg", "pale.webp", "cat.gif", "white.png", "lines.png"),
        *("square.svg", "pieces.svg", "levels.tif", "colours.png"),
    ],
)
def test_silhouettes_are_filled_whatever_they_come_from(tmp_path: Path, name: str) -> None:
    picture(tmp_path / "cat.png")
    picture(tmp_path / "cat.gif")
    picture(tmp_path / "pale.webp", ground=255, ink=217)
    with Image.open(tmp_path / "cat.png") as cat:
        ink = cat.convert("L").point(lambda level: (235 - level) * 255 // 195)
    Image.merge("LA", [Image.new("L", ink.size, 255), ink]).save(tmp_path / "white.png")
    picture(tmp_path / "dark.jpg", ground=30, ink=220)
    lines = Image.new("L", (300, 300), 255)
    ImageDraw.Draw(lines).polygon([(50, 90), (210, 50), (250, 210), (90, 250)], None, 0, 3)
    lines.save(tmp_path / "lines.png")
    levels = np.asarray(lines.resize((301, 300)), np.float32)
    Image.fromarray(levels / 255.0).save(tmp_path / "levels.tif")
    colours = Image.new("RGB", (300, 300), "white")
    for ink, corners in (
        ("navy", (50, 50, 250, 50, 250, 250)),
        ("pink", (50, 50, 50, 250, 250, 250)),
    ):
        ImageDraw.Draw(colours).polygon(corners, ink)
    colours.save(tmp_path / "colours.png")
    svg(tmp_path / "square.svg", SQUARE)
    svg(tmp_path / "pieces.svg", '<polygon points="0,0 8,0 8,8"/><polygon points="0,0 8,8 0,8"/>')
    source = name if name == "cat" else str(tmp_path / name)
    shown = read_silhouette(source, "it", load_run("pretrained/tangram7").task)
    assert shown.told.startswith("filled by the search in ")
    assert float(shown.told.split()[-1]) > 0.97
    assert shown.figure.name == Path(name).stem
    width, height = shown.picture.size
    assert shown.outlines.min() >= 0.0
    assert (shown.outlines <= (width, height)).all()


def test_tokens_are_drawn_where_a_tilted_camera_saw_them(tmp_path: Path) -> None:
    puzzle = load_puzzle("cat", 1.0)
    area = covered_area(puzzle.corners, puzzle.layout)
    photographed(area, 15.0, 120.0).save(tmp_path / "aslant.png")
    task = load_run("pretrained/tangram7").task
    shown = read_silhouette(str(tmp_path / "aslant.png"), "it", task)
    tokens = covered_area(shown.outlines, task.layout)
    ink = np.asarray(shown.picture.convert("L")) < 128
    side = np.arange(len(ink)) + 0.5
    drawn = shapely.contains_xy(tokens, *np.meshgrid(side, side))
    assert (drawn & ink).sum() > 0.96 * (drawn | ink).sum()


def test_a_silhouette_is_played(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "cat.png"
    config = PlayConfig(silhouette="cat", out=str(out), changes={"sim": {"backend": "kinematic"}})
    assert play_run(config) == 0
    printed = capsys.readouterr().out
    assert "1 silhouette, coverage 0.99" in printed
    with Image.open(out) as drawn:
        assert drawn.width > drawn.height > 300


@pytest.fixture
def filler(tmp_path: Path) -> Path:
    """A run of an agent of outlines that learned nothing."""
    tokens, sim = {"shapes": list(SEVEN), "scale": 0.6}, {"backend": "kinematic", "arena": 2.0}
    folder = tmp_path / "filler"
    write_run(folder, tokens=tokens, sim=OUTLINES | sim | {"allow_flip": True}, agent=FILLER)
    return folder


def test_an_agent_of_outlines_is_shown_the_bare_silhouette(
    filler: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its two halves are of few colours: those of the tokens are on the right side only."""
    out, name = tmp_path / "out.png", picture(tmp_path / "it.png")
    play_run(PlayConfig(str(filler), silhouette=name, out=str(out)))
    assert "; not filled by the run itself, but filled by the search in" in capsys.readouterr().out
    with Image.open(out) as drawn:
        left = drawn.convert("RGB").crop((0, 0, drawn.width // 2 - 40, drawn.height))
        wide = np.ptp(np.asarray(left, np.int64), axis=-1)
    assert wide.max() < 40  # nothing is of a token's colour


def test_a_puzzle_file_of_one_is_filled(tmp_path: Path) -> None:
    content = json.loads((PACKAGED / "test.json").read_text())
    one = content | {"puzzles": content["puzzles"][:1]}
    (tmp_path / "1.json").write_text(json.dumps(one))
    shown = read_silhouette(str(tmp_path / "1.json"), "it", load_run("pretrained/tangram7").task)
    assert float(shown.told.split()[-1]) > 0.97


def test_a_figure_that_is_cut_off_is_refused(tmp_path: Path) -> None:
    picture(tmp_path / "cat.png")
    with Image.open(tmp_path / "cat.png") as cat:
        both = Image.new("L", (600, 300), 235)
        both.paste(cat, (220, 0))
    ImageDraw.Draw(both).rectangle((0, 100, 3, 103), 40)
    both.save(tmp_path / "speck.png")
    read(str(tmp_path / "speck.png"))
    ImageDraw.Draw(both).rectangle((0, 100, 60, 160), 40)
    both.save(tmp_path / "both.png")
    with pytest.raises(ConfigError, match="is cut off by the picture's edge: leave ground"):
        read(str(tmp_path / "both.png"))


def test_what_fills_a_picture_badly_does_not_fill_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def worse(*given: Any) -> Silhouette:
        drawn = fill_silhouette(*given)
        return replace(drawn, filled=replace(drawn.filled, iou=0.9))

    monkeypatch.setattr("tangram_vision.solving.fill_silhouette", worse)
    task = load_run("pretrained/tangram7").task
    shown = read_silhouette(picture(tmp_path / "cat.png"), "it", task)
    assert not shown.exact


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"out": "cat.png", "silhouette": "cat.png"}, "overwrite silhouette"),
        ({"changes": {"sim": {"targets": "uniform"}}}, "leave silhouette out"),
    ],
)
def test_settings_that_a_silhouette_has_no_use_for_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, settings: dict[str, object], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    picture(tmp_path / "cat.png")
    with pytest.raises(ConfigError, match=message):
        PlayConfig(**({"silhouette": "cat"} | settings))  # type: ignore[arg-type]


@pytest.mark.parametrize("puzzle", [("heart",), None])
def test_a_report_takes_the_scores_of_an_agent_of_outlines(
    tmp_path: Path, puzzle: tuple[str, ...] | None
) -> None:
    """The mean reward of several tokens is of what they cover; every episode is told."""
    out = tmp_path / "scores.json"
    sim = {"backend": "kinematic"}
    few = {} if puzzle else {"episodes": 2}
    config = EvalConfig(
        "pretrained/tangram7_silhouette", puzzle=puzzle, out=str(out), changes={"sim": sim}, **few
    )
    assert evaluate_run(config) == 0
    report = json.loads(out.read_text())
    for scores in (report, *report["baselines"].values()):
        assert len(scores["coverage_each"]) == scores["episodes"] == (2 if puzzle is None else 1)
        assert scores["mean_reward"] == pytest.approx(
            2.0 * np.mean(scores["coverage_each"]) - 1.0, abs=1e-5
        )
