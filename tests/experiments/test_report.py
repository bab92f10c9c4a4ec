"""tangram-report: pages, tables, figures and data from a study folder."""

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from PIL import Image

from tangram_lab.experiments.report import page as report_page
from tangram_lab.experiments.report.cli import report, with_absolute_paths
from tangram_lab.experiments.report.config import ReportConfig
from tangram_lab.experiments.report.page import write_report
from tangram_sim.errors import ConfigError, RunError
from tests.experiments.builders import (
    cells,
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

FIGURES = {
    "fig4": (1440, 624),
    "fig6": (1440, 624),
    "fig6_dense": (1440, 624),
    "table2_actions": (1440, 608),
    "noise_noise": (1440, 608),
    "ablation": (1440, 336),
    "ablation_seeds": (1440, 344),
}


@pytest.fixture(scope="module")
def patch() -> Iterator[pytest.MonkeyPatch]:
    with pytest.MonkeyPatch.context() as patched:
        yield patched


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, patch: pytest.MonkeyPatch) -> Path:
    """A report on the study of the builders."""
    patch.setattr(report_page, "draw_paper_pictures", lambda out: [("Puzzle", "p.png", "A cat.")])
    runs, out = tmp_path_factory.mktemp("runs"), tmp_path_factory.mktemp("out") / "new" / "report"
    write_study(runs)
    write_report(runs, out)
    return out


@pytest.fixture(scope="module")
def page(made: Path) -> str:
    return (made / "README.md").read_text()


def part(page: str, name: str) -> str:
    """The section of one experiment."""
    return page.partition(f'<a id="{name}"></a>')[2].partition("<a id=")[0]


# Pages


def test_scores_of_an_experiment(page: str) -> None:
    text = part(page, "fig4")
    assert "## A curves title" in text
    assert "Source: Fig. 4. What curves are." in text
    assert cells(text, "training")[0] == [
        "seeds",
        "paper",
        "mean reward, median (least to most)",
        "seed 0",
        "seed 1",
        "seed 2",
    ]
    paper, mlp, ours = (cells(text, label)[0] for label in ("MHA (paper)", "MLP", "ours"))
    assert paper == ["3 of 3", "0.75", "0.758 (0.750 to 0.762)", "0.758", "0.750", "0.762"]
    assert mlp == ["2 of 3", "0.70", "0.695 (0.690 to 0.700)", "0.700", "0.690", "-"]
    assert ours == ["2 of 3", "-", "0.996 (0.995 to 0.996)", "0.996", "0.995", "-"]
    assert cells(text, "position only") == [["", "", "0.764", "", "", ""]]
    assert cells(text, "perfect") == [["", "", "1.000", "", "", ""]]
    assert cells(text, "random") == [["", "", "-0.960", "", "", ""]]


def test_effort_of_an_experiment(page: str) -> None:
    text = part(page, "fig4")
    paper, ours = cells(text, "MHA (paper)")[1], cells(text, "ours")[1]
    assert paper[0] == "0.75 after 1,500"
    assert paper[3] == "24.20° (23.80° to 25.00°)"
    assert paper[4:] == ["0.0005", "20,640", "2,000", "1.0 (0.9 to 1.1)"]
    assert ours[0] == "-"


def test_missing_seeds_are_told(page: str) -> None:
    text = part(page, "fig4")
    assert "- MLP (2 of 3 seeds): seed 2 not started" in text
    assert "- ours (2 of 3 seeds): seed 2 not finished" in text
    assert "- MHA" not in text
    assert "| [A curves title](#fig4) | Fig. 4 | 7 of 9 |" in page


def test_both_rewards(page: str) -> None:
    text = part(page, "fig6")
    assert "mean dense reward, median (least to most)" in text
    assert cells(text, "random") == [["", "-0.960", "", "", ""], ["", "-0.620", "", "", ""]]


def test_complexity_beside_the_papers(page: str) -> None:
    text = part(page, "table1")
    assert cells(text, "MHA (paper)") == [
        [
            "3 of 3",
            "504,000",
            "32,600",
            "72",
            "0.02 (0.01 to 0.02)",
            "28,000",
            "20,640",
            "2,000",
            "0.758 (0.750 to 0.762)",
        ]
    ]
    assert "![" not in text
    assert "Left out" not in text


def test_tests_beside_the_papers(page: str) -> None:
    text = part(page, "table2")
    rewards, angles = cells(text, "MHA (paper)")[:2]
    assert rewards == ["3 of 3", "0.758 (0.750 to 0.762)", "0.748 (0.740 to 0.752)"]
    assert angles[1] == "24.20° (23.80° to 25.00°)"
    assert cells(text, "MHA (paper), the paper's") == [["", "0.758", "0.754"]]
    assert cells(text, "position only") == [["", "0.764", "0.764"], ["", "23.80°", "23.80°"]]
    assert ["1", "0.750", "0.740"] in cells(text, "MHA (paper)")


def test_ranking_compares_with_the_first(page: str) -> None:
    text = part(page, "ablation")
    ours, paper = cells(text, "ours")[0], cells(text, "MHA (paper)")[0]
    assert ours[2] == ours[4] == "reference"
    assert paper[1:3] == ["0.758 (0.750 to 0.762)", "-0.238"]
    assert paper[3:5] == ["24.20° (23.80° to 25.00°)", "+23.75°"]
    assert paper[6:] == ["0.758", "0.750", "0.762"]


def test_closing(page: str) -> None:
    assert "Budget `laptop`: Narrower MHA." in page
    assert cells(page, "runs finished") == [["7 of 9"]]
    assert cells(page, "seeds") == [["0 / 1 / 2"]]
    assert cells(page, "commit") == [["0123abc"]]
    assert cells(page, "processor") == [["AMD EPYC"]]
    assert cells(page, "cores") == [["2"]]
    assert cells(page, "versions") == [["python 3.11.7, torch 2.13.0"]]
    assert cells(page, "time, all runs added up") == [["0.12 h"]]
    assert "- **MLP** (`mlp`): `agent=mlp`" in page
    assert "- **ours** (`ours`): (defaults)" in page
    assert "secret-host" not in page


def test_every_figure_and_only_those_are_embedded(made: Path, page: str) -> None:
    files = {path.name for path in (made / "figures").iterdir()}
    assert files == {f"{name}.{kind}" for name in FIGURES for kind in ("png", "svg")}
    for name in FIGURES:
        assert f"](figures/{name}.png)" in page
        assert f"[SVG](figures/{name}.svg)" in page


def test_pictures_of_the_paper_come_first(page: str) -> None:
    text = page.partition('<a id="fig4">')[0]
    assert "## Puzzle\n\n![Puzzle](figures/p.png)\n\n*A cat.*" in text


# Figures


@pytest.mark.parametrize("name", FIGURES)
def test_figures_are_png_and_svg(made: Path, name: str) -> None:
    with Image.open(made / "figures" / f"{name}.png") as image:
        image.verify()
        assert image.size == FIGURES[name]
        assert "Software" not in image.info
    root = ET.parse(made / "figures" / f"{name}.svg").getroot()  # noqa: S314 # our own file
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    assert b"<dc:date>" not in (made / "figures" / f"{name}.svg").read_bytes()


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


# Data


def test_data_holds_all_numbers(made: Path) -> None:
    data = json.loads((made / "data.json").read_text())
    assert data["plan"]["budget"]["name"] == "laptop"
    assert set(data["runs"]) == {"paper", "mlp", "ours"}
    seed = data["runs"]["paper"][1]
    assert (seed["seed"], seed["state"]) == (1, "finished")
    assert seed["result"] == {k: v for k, v in result(1, 0.75).items() if k != "host"}
    assert seed["tests"]["actions_2"]["baselines"]["random"]["mean_reward"] == -0.96
    curve = learning_curve(1, 0.75)
    assert seed["curve"]["updates"] == [point["updates"] for point in curve]
    assert seed["curve"]["mean_reward"] == pytest.approx(
        [point["mean_reward"] for point in curve], rel=1e-5
    )
    cut = data["runs"]["ours"][2]
    assert (cut["state"], cut["result"], len(cut["curve"]["updates"])) == ("not finished", {}, 3)
    assert data["runs"]["mlp"][2]["state"] == "not started"


def test_data_is_free_of_private_names(made: Path) -> None:
    text = (made / "data.json").read_text()
    assert "secret-host" not in text
    assert "/home/somebody" not in text


# The command


def test_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(report_page, "draw_paper_pictures", lambda out: [])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "")
    monkeypatch.chdir(tmp_path)
    write_plan(tmp_path / "runs", plan({}, {}, {}))
    monkeypatch.setattr(sys, "argv", ["tangram-report", "runs=runs", "out=out"])
    assert report() == 0
    assert (tmp_path / "out" / "README.md").exists()
    assert capsys.readouterr().out.splitlines() == [
        f"written: {tmp_path / 'out' / name}" for name in ("README.md", "data.json")
    ]
    monkeypatch.setattr(sys, "argv", ["tangram-report", "runs=nowhere", "out=out"])
    assert report() == 2
    assert "nowhere/plan.json is missing: name a folder" in capsys.readouterr().err


def test_folders_are_named() -> None:
    with pytest.raises(ConfigError, match="out must name a folder, got ' ': set out="):
        ReportConfig("runs", " ")
    assert with_absolute_paths({"runs": "a", "out": None}) == {
        "runs": str(Path("a").absolute()),
        "out": None,
    }


def test_a_report_that_cannot_be_written(tmp_path: Path) -> None:
    write_plan(tmp_path, plan({}, {}, {}))
    (tmp_path / "out").write_text("a file")
    with pytest.raises(RunError, match="cannot make .*figures .*: choose another folder with out="):
        write_report(tmp_path, tmp_path / "out")


def test_the_page_itself_may_be_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report_page, "draw_paper_pictures", lambda out: [])
    write_study(tmp_path)
    page, data = write_report(tmp_path, tmp_path / "docs" / "results.md")
    assert page == tmp_path / "docs" / "results.md"
    assert data == tmp_path / "docs" / "results" / "data.json"
    links = re.findall(r"\]\((results/[^)]+)\)", page.read_text())
    assert len(links) > 5
    assert all((page.parent / link).is_file() for link in links)
