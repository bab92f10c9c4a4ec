"""tangram-play target=: one word for puzzles, drawings and photographs; and its data."""

import json
from inspect import cleandoc
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import numpy as np
import pytest
from PIL import Image, ImageDraw

from conf.cli import composed
from tangram_agent.runs import load_run
from tangram_core.errors import ConfigError
from tangram_game.cli import _play
from tangram_game.figures.targets import told_apart
from tangram_sim.puzzles.figures import PACKAGED
from tangram_vision import solve
from tangram_vision.given.silhouette_files import fill_silhouette
from tangram_vision.solution import Solution
from tests.sim.builders import SEVEN, layout_of

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _no_hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock decides nothing of what comes nearest."""
    monkeypatch.setattr("tangram_vision.solving.NEAREST_SECONDS", 60.0)


ROOT = Path(__file__).parents[3]
SCHEMA = ROOT / "tangram_vision" / "solution.schema.json"
PICTURES = ROOT / "docs" / "images"
BOAT = [[(60, 250), (340, 250), (280, 320), (120, 320)], [(190, 250), (190, 100), (300, 240)]]


def boat(path: Path) -> str:
    """As a beginner draws it: no tans fill it."""
    canvas = Image.new("L", (400, 400), 255)
    for corners in BOAT:
        ImageDraw.Draw(canvas).polygon(corners, 0)
    canvas.save(path)
    return str(path)


def schema() -> dict[str, Any]:
    """Of the file; written anew by python -m tests.game.figures.test_targets."""
    found = msgspec.json.schema(Solution)
    for one in found["$defs"].values():
        one["description"] = cleandoc(one["description"])
    return found


def read_solution(path: Path) -> Solution:
    return msgspec.json.decode(path.read_bytes(), type=Solution)


def filled_again(found: Solution, mask: np.ndarray) -> float:
    """IoU of what a solution draws in its picture and of what was there."""
    canvas = Image.new("1", (found.picture.width, found.picture.height))
    for one in found.tokens:
        ImageDraw.Draw(canvas).polygon(one.pixels, 1)
    drawn = np.asarray(canvas)
    return float((drawn & mask).sum() / (drawn | mask).sum())


def test_a_target_is_told_apart(tmp_path: Path) -> None:
    task = load_run("pretrained/tangram7").task
    outline = {"format": "tangram-outlines", "version": 1, "outlines": [[[0, 0], [1, 0], [1, 1]]]}
    (tmp_path / "it.json").write_text(json.dumps(outline))
    (tmp_path / "it.svg").write_text("<svg/>")
    for target, kind in (
        ("cat", "puzzle"),
        (PACKAGED / "test.json", "puzzle"),
        (tmp_path / "it.json", "silhouette"),
        (tmp_path / "it.svg", "silhouette"),
        (PICTURES / "silhouette.png", "silhouette"),
        (PICTURES / "photograph.jpg", "photograph"),
    ):
        assert told_apart(str(target), task) == kind
    with pytest.raises(ConfigError, match=r"^target=gone\.png "):
        told_apart("gone.png", task)


@pytest.mark.parametrize("target", ["cat", "silhouette.png", "boat.png"])
def test_a_solution_fills_what_it_says_it_fills(target: str, tmp_path: Path) -> None:
    """Drawn anew from the file it has the IoU that stands in it."""
    name = {"boat.png": boat(tmp_path / "boat.png"), "cat": "cat"}.get(
        target, str(PICTURES / target)
    )
    out = tmp_path / "solution.json"
    assert _play(composed("play", [f"target={name}", f"out={out}"])) == 0
    found, layout = read_solution(out), layout_of(*SEVEN, scale=1.0)
    assert found.kind == ("nearest" if target == "boat.png" else "filled")
    mask = fill_silhouette(name, "it", layout, 1.0, 0.1).mask
    assert found.iou == pytest.approx(filled_again(found, mask), abs=0.03)
    assert found.iou > (0.8 if target == "boat.png" else 0.98)
    areas = []
    for one in found.tokens:
        x, y = np.array(one.corners).T
        areas.append(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2.0)
        assert min(x) < one.x < max(x)
        assert min(y) < one.y < max(y)
    assert areas == pytest.approx([0.25] * 2 + [0.125] * 3 + [0.0625] * 2, abs=1e-5)
    assert [one.order for one in found.tokens] == list(range(1, 8))


@pytest.mark.parametrize("kind", ["filled", "seen"])
def test_pixels_count_in_the_picture_as_given(kind: str, tmp_path: Path) -> None:
    """A large one, on its side; or the file of a photograph."""
    path, turned = tmp_path / "large.png", Image.Exif()
    name = "silhouette.png" if kind == "filled" else "photograph.jpg"
    with Image.open(PICTURES / name) as shown:
        large = shown.convert("L").resize((2000, 1000 * 2 * shown.height // shown.width))
    turned[274] = 6  # shown a quarter to the right
    large.save(path, exif=turned)
    assert _play(composed("play", [f"target={path}", f"out={tmp_path}/it.json"])) == 0
    found = read_solution(tmp_path / "it.json")
    assert (found.kind, found.picture.width) == (kind, large.height)
    ink = np.asarray(large.rotate(-90, expand=True)) < 128
    assert filled_again(found, ink) > 0.9


def test_a_photograph_tells_where_tokens_were_seen(tmp_path: Path) -> None:
    out = tmp_path / "seen.json"
    assert _play(composed("play", [f"target={PICTURES}/photograph.jpg", f"out={out}"])) == 0
    found = read_solution(out)
    assert (found.kind, found.iou, len(found.tokens)) == ("seen", None, 7)
    mask = np.asarray(Image.open(PICTURES / "photograph.jpg").convert("L")) < 128
    assert filled_again(found, mask) > 0.9


def test_a_solution_is_a_drawing_too(tmp_path: Path) -> None:
    out = tmp_path / "cat.svg"
    assert _play(composed("play", ["silhouette=cat", f"out={out}"])) == 0
    again = solve(str(out))
    assert (again.kind, again.iou) == ("filled", pytest.approx(1.0, abs=0.01))


def test_the_schema_is_that_of_the_file() -> None:
    stored = json.loads(SCHEMA.read_text())
    assert stored == json.loads(msgspec.json.encode(schema()))
    given = json.loads(solve("cat").json())
    jsonschema.validate(given, stored)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(given | {"tokens": "all"}, stored)


def test_data_are_of_a_figure_or_of_a_finger(tmp_path: Path) -> None:
    for given in (["run_dir=pretrained/square"], ["puzzle=cat"], ["run_dir=pretrained/hand"]):
        out = f"out={tmp_path}/it.svg"
        with pytest.raises(ConfigError, match=r"^out=.*it\.svg is for positions of tokens in a fi"):
            _play(composed("play", [*given, out]))


def test_a_hand_takes_figures_of_the_library_alone(tmp_path: Path) -> None:
    given = ["run_dir=pretrained/hand", "target=cat", f"out={tmp_path}/plan.json"]
    with pytest.raises(ConfigError, match=r"plays task=push, .*: set puzzle=cat, or leave run_dir"):
        _play(composed("play", given))


@pytest.mark.parametrize(
    "target", ["cat", pytest.param("boat.png", marks=pytest.mark.check), "photograph.jpg"]
)
def test_a_target_is_played_whatever_it_is(
    target: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    boat(tmp_path / "boat.png")
    name = {"cat": "cat", "boat.png": f"{tmp_path}/boat.png"}.get(target, f"{PICTURES}/{target}")
    given = [f"target={name}", f"out={tmp_path}/it.png", "sim.backend=kinematic"]
    assert _play(composed("play", given)) == 0
    first, last = capsys.readouterr().out.splitlines()
    assert first.startswith(f"target={name} is taken for ")
    assert last.startswith(f"{tmp_path}/it.png: 1 ")
    assert ("; the nearest figure has IoU 0." in last) == (target == "boat.png")


if __name__ == "__main__":
    SCHEMA.write_bytes(msgspec.json.format(msgspec.json.encode(schema()), indent=1) + b"\n")
