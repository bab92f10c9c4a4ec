"""Silhouettes that cannot be filled are told and drawn, and several dissections are drawn."""

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageDraw

from conf.cli import composed
from tangram_agent.runs import load_run
from tangram_core.errors import ConfigError, RunError
from tangram_game.cli import _play
from tangram_game.config import PlayConfig
from tangram_game.figures.silhouettes import RED, read_silhouette
from tangram_sim.puzzles.figures import PACKAGED
from tangram_vision.given import silhouette_files

pytestmark = pytest.mark.slow

SQUARE = [[0, 0], [1, 0], [1, 1], [0, 1]]
STRIP = [[0, 0], [4, 0], [4, 0.25], [0, 0.25]]


@pytest.fixture(autouse=True)
def _no_hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock decides nothing where other work takes the processor."""
    monkeypatch.setattr("tangram_game.figures.silhouettes.SECONDS", 60.0)


def outline(path: Path, *rings: Any, **more: Any) -> str:
    content = {"format": "tangram-outlines", "version": 1, "outlines": list(rings)} | more
    path.write_text(json.dumps(content))
    return str(path)


def refused(name: str, out: Path | None) -> str:
    with pytest.raises(ConfigError) as raised:
        read_silhouette(name, load_run("pretrained/tangram7").task, out=out)
    assert "\n" not in str(raised.value)
    return str(raised.value)


def red(path: Path) -> int:
    with Image.open(path) as picture:
        return int(np.count_nonzero((np.asarray(picture.convert("RGB")) == RED).all(axis=2)))


def test_what_could_be_laid_is_drawn_and_in_red_what_is_missing(tmp_path: Path) -> None:
    """Three tans fit into a strip as high as a small triangle: most of it stays red."""
    strip = outline(tmp_path / "strip.json", STRIP)
    told = refused(strip, tmp_path / "out.png")
    assert f"silhouette={strip} cannot be filled with the seven tans (no dissection: all w" in told
    assert told.endswith(f"; the best attempt is drawn in {tmp_path / 'out.png'}")
    with Image.open(tmp_path / "out.png") as picture:
        shown = np.asarray(picture.convert("RGB"), np.int64)
    ink = np.abs(shown - (55, 60, 68)).sum(axis=2) < 30
    assert 1.0 < red(tmp_path / "out.png") / np.count_nonzero(ink) < 5.0


def test_a_picture_that_is_not_filled_tells_the_best(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disc: no tans come near to it."""
    monkeypatch.setattr("tangram_game.figures.silhouettes.SECONDS", 0.5)
    canvas = Image.new("L", (400, 400), 235)
    ImageDraw.Draw(canvas).ellipse([(100, 100), (300, 300)], 30)
    canvas.save(tmp_path / "it.png")
    told = refused(str(tmp_path / "it.png"), tmp_path / "out.gif")
    assert "it.png was not filled with the seven tans in " in told
    assert "(best found: IoU 0." in told
    assert red(tmp_path / "out.attempt.png") > 300


def test_an_area_of_known_scale_is_told(tmp_path: Path) -> None:
    told = refused(
        outline(tmp_path / "it.json", np.multiply(SQUARE, (0.83, 1)).tolist(), side=1), None
    )
    assert "covers 0.83 of the seven tans: mend the outline or its side" in told
    assert "drawn" not in told
    content = json.loads((PACKAGED / "test.json").read_text())
    del content["puzzles"][1:], content["puzzles"][0]["pieces"][-1]  # a sixteenth
    (tmp_path / "six.json").write_text(json.dumps(content))
    assert "covers 0.94 of the seven tans" in refused(str(tmp_path / "six.json"), None)


def test_an_attempt_lies_where_it_was_asked_for_or_beside_the_film(tmp_path: Path) -> None:
    strip, beside = outline(tmp_path / "strip.json", STRIP), tmp_path / "out.png"
    beside.write_bytes(b"mine")
    attempt = tmp_path / "out.attempt.png"
    assert f"is drawn in {attempt}" in refused(strip, tmp_path / "out.gif")
    assert (beside.read_bytes(), (tmp_path / "out.gif").exists()) == (b"mine", False)
    assert f"is drawn in {beside}" in refused(strip, beside)


def test_an_attempt_that_cannot_be_written_leaves_the_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise RunError("cannot write it: no room")

    monkeypatch.setattr("tangram_game.figures.silhouettes.write_whole", full)
    told = refused(outline(tmp_path / "strip.json", STRIP), tmp_path / "out.png")
    assert told.endswith(
        "(no dissection: all ways were tried, 8 steps): draw sides that are straight, "
        "and corners where tokens have theirs; the best attempt is not drawn: cannot write it: no "
        "room"
    )


@pytest.mark.parametrize("fails", [False, True])
def test_the_command_searches_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    searched, fill = list[str](), silhouette_files.fill_silhouette

    def counted(name: str, *rest: Any) -> Any:
        searched.append(name)
        return fill(name, *rest)

    monkeypatch.setattr(silhouette_files, "fill_silhouette", counted)
    name = outline(tmp_path / "it.json", STRIP if fails else SQUARE)
    given = [f"silhouette={name}", f"out={tmp_path}/it.png", "sim.backend=kinematic"]
    with suppress(ConfigError):
        assert _play(composed("play", given)) == 0
    assert searched == [name]
    assert (tmp_path / "it.png").exists()


@pytest.mark.parametrize(
    ("name", "told"),
    [("square.json", "5 dissections"), ("cat", "2 dissections, all that there are")],
)
def test_so_many_dissections_are_found(tmp_path: Path, name: str, told: str) -> None:
    outline(tmp_path / "square.json", SQUARE)
    source = name if name == "cat" else str(tmp_path / name)
    shown = read_silhouette(source, load_run("pretrained/tangram7").task, 5)
    assert shown.told == told
    assert len(shown.outlines) == int(told[0])
    assert shown.figure.name == Path(name).stem


def test_all_dissections_are_shown_and_the_first_is_played(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tangram_game.show.film.FRAMES_PER_ACTION", 1)
    name, sizes = outline(tmp_path / "it.json", SQUARE), {}
    for out in ("it.png", "it.gif"):
        given = [f"silhouette={name}", "solutions=5", f"out={tmp_path / out}"]
        assert _play(composed("play", [*given, "sim.backend=kinematic"])) == 0
        assert "1 silhouette, coverage 0.99" in (printed := capsys.readouterr().out)
        assert "; 5 dissections" in printed
        with Image.open(tmp_path / out) as picture:
            sizes[out] = picture.size
    assert sizes["it.png"][0] > 1400  # three in a row, and the end
    assert sizes["it.gif"][0] < 600  # as wide as the film


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"solutions": 5}, "^solutions=5 changes nothing with silhouette=null: "),
        ({"solutions": 0, "silhouette": "cat"}, "solutions must be between 1 and 20, got 0"),
        ({"solutions": 21, "silhouette": "cat"}, "solutions must be between 1 and 20, got 21"),
    ],
)
def test_solutions_are_those_of_a_silhouette(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        PlayConfig(**({"run_dir": "pretrained/tangram7"} | settings))


def test_of_a_picture_one_dissection_is_known(tmp_path: Path) -> None:
    task = load_run("pretrained/tangram7").task
    with pytest.raises(ConfigError, match=r"solutions=2 needs an exact outline, and .*it\.png is"):
        read_silhouette(str(tmp_path / "it.png"), task, 2)
