"""tangram-report: the page, its figures and its data from a study folder, and the command."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from PIL import Image

from tangram_lab.experiments.cli import ReportConfig, _with_absolute, report
from tangram_lab.experiments.report import page as report_page
from tangram_lab.experiments.report.data import read_data
from tangram_lab.experiments.report.page import drawn_again, figure_sums, write_report
from tangram_lab.experiments.report.reading import read_runs
from tangram_sim.errors import ConfigError, RunError
from tests.experiments.builders import (
    experiment,
    learning_curve,
    plan,
    result,
    training,
    write_plan,
    write_run,
    write_study,
)

pytestmark = pytest.mark.slow

# The page on the study of the builders. Where it is to change, look at what the test made instead.
GOLDEN = Path(__file__).with_name("report.md")
FIGURES = {
    "fig4": (1440, 624),
    "fig6": (1440, 624),
    "fig6_dense": (1440, 624),
    "table2_actions": (1440, 608),
    "noise_noise": (1440, 608),
    "ablation": (1440, 432),
    "changed": (1440, 528),
    "ablation_seeds": (1440, 368),
}


@pytest.fixture(scope="module")
def patch() -> Iterator[pytest.MonkeyPatch]:
    with pytest.MonkeyPatch.context() as patched:
        yield patched


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, patch: pytest.MonkeyPatch) -> Path:
    """The folder beside a page on the study of the builders."""
    picture = ("Puzzle", "p.png", "A cat.")
    patch.setattr(report_page, "draw_paper_pictures", lambda out: [picture])
    runs, out = tmp_path_factory.mktemp("runs"), tmp_path_factory.mktemp("out") / "new"
    write_study(runs)
    assert write_report(runs, out) == [out / "tables.md", out / "data.json"]
    return out


def test_the_page_is_the_golden_one(made: Path) -> None:
    assert (made / "tables.md").read_text() == GOLDEN.read_text()


def test_the_page_comes_from_the_data_alone(made: Path) -> None:
    study, _ = read_data(made / "data.json")
    assert drawn_again(study) == (GOLDEN.read_text(), figure_sums(made))


def test_every_figure_of_the_page_is_there_as_png_and_svg(made: Path) -> None:
    files = {path.name for path in (made / "figures").iterdir()}
    assert files == {f"{name}.{kind}" for name in FIGURES for kind in ("png", "svg")}
    for name, size in FIGURES.items():
        with Image.open(made / "figures" / f"{name}.png") as image:
            image.verify()
            assert image.size == size, name
            assert "Software" not in image.info
        text = (made / "figures" / f"{name}.svg").read_text()
        assert ET.fromstring(text).tag == "{http://www.w3.org/2000/svg}svg"  # noqa: S314 # ours
        assert "<dc:date>" not in text


def test_same_runs_give_the_same_bytes(tmp_path: Path, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(report_page, "draw_paper_pictures", lambda out: [])
    study = plan({"a": experiment("ranking", ["one"])}, {"one": training("one", "x")}, {}, (0,))
    write_plan(tmp_path / "runs", study)
    write_run(tmp_path / "runs", "one", result(0), learning_curve(0, 0.7))
    for out in ("first", "second"):
        write_report(tmp_path / "runs", tmp_path / out)
    first = sorted(path for path in (tmp_path / "first").rglob("*") if path.is_file())
    assert len(first) == 6
    for path in first:
        twin = tmp_path / "second" / path.relative_to(tmp_path / "first")
        assert twin.read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    ("source", "shown"), [("Fig. 5", True), ("Table II", True), ("Sec. VIII", False)]
)
def test_the_papers_pictures_stand_beside_its_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str, shown: bool
) -> None:
    picture = ("Puzzle", "p.png", "A cat.")
    monkeypatch.setattr(report_page, "draw_paper_pictures", lambda out: [picture])
    one = experiment("game", ["one"], source)
    write_plan(tmp_path, plan({"a": one}, {"one": training("one", "x")}, {}, (0,)))
    study = read_runs(tmp_path)
    assert ("A cat." in drawn_again(study)[0]) == shown


def test_data_holds_all_numbers(made: Path) -> None:
    text = (made / "data.json").read_text()
    assert "secret-host" not in text
    assert "/home/somebody" not in text
    data = json.loads(text)
    assert data["plan"]["budget"]["name"] == "laptop"
    seed = data["runs"]["paper"][1]
    assert (seed["seed"], seed["state"]) == (1, "finished")
    assert seed["result"] == {k: v for k, v in result(1, 0.75).items() if k != "host"}
    assert seed["tests"]["actions_2"]["baselines"]["random"]["mean_reward"] == -0.96
    curve = learning_curve(1, 0.75)
    assert seed["curve"]["updates"] == [point["updates"] for point in curve]
    rounded = [float(f"{point['mean_reward']:.6g}") for point in curve]
    assert seed["curve"]["mean_reward"] == rounded
    cut = data["runs"]["ours"][2]
    assert (cut["state"], cut["result"], len(cut["curve"]["updates"])) == ("not finished", {}, 3)
    assert data["runs"]["mlp"][2]["state"] == "not started"


def test_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(report_page, "draw_paper_pictures", lambda out: [])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "")
    monkeypatch.chdir(tmp_path)
    write_plan(tmp_path / "runs", plan({}, {"ours": training("ours", "x")}, {}, (0,)))
    write_run(tmp_path / "runs", "ours", result(0), [])
    monkeypatch.setattr(sys, "argv", ["tangram-report", "runs=runs", "out=out"])
    assert report() == 0
    assert (tmp_path / "out" / "tables.md").exists()
    assert capsys.readouterr().out.splitlines() == [
        f"written: {tmp_path / 'out' / name}" for name in ("tables.md", "data.json")
    ]
    monkeypatch.setattr(sys, "argv", ["tangram-report", "runs=nowhere", "out=out"])
    assert report() == 2
    assert "nowhere/plan.json is missing: name a folder" in capsys.readouterr().err


def test_folders_are_named() -> None:
    with pytest.raises(ConfigError, match="out must name a folder, got ' ': set out="):
        ReportConfig("runs", " ")
    found = _with_absolute({"runs": "a", "out": None, "other": "b"}, "runs", "out")
    assert found == {"runs": str(Path("a").absolute()), "out": None, "other": "b"}


def test_a_report_that_cannot_be_written(tmp_path: Path) -> None:
    write_plan(tmp_path, plan({}, {"ours": training("ours", "x")}, {}, (0,)))
    write_run(tmp_path, "ours", result(0), [])
    (tmp_path / "out").write_text("a file")
    with pytest.raises(RunError, match="cannot write to .*out .*: make room, or choose another fo"):
        write_report(tmp_path, tmp_path / "out")
