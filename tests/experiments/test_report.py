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


HEAD = ["seeds", "paper", "mean reward, median (least to most)", "seed 0", "seed 1", "seed 2"]
REWARD, ANGLE = "0.758 (0.750 to 0.762)", "24.20° (23.80° to 25.00°)"
FIG4, FIG6, TABLE1, TABLE2, RANKING = "fig4", "fig6", "table1", "table2", "ablation"


@pytest.mark.parametrize(
    ("name", "label", "row", "cut", "expected"),
    [
        (FIG4, "training", 0, slice(None), HEAD),
        (
            FIG4,
            "MHA (paper)",
            0,
            slice(None),
            ["3 of 3", "0.75", REWARD, "0.758", "0.750", "0.762"],
        ),
        (FIG4, "MLP", 0, slice(3), ["2 of 3", "0.70", "0.695 (0.690 to 0.700)"]),
        (FIG4, "MLP", 0, slice(3, None), ["0.700", "0.690", "-"]),
        (FIG4, "ours", 0, slice(3), ["2 of 3", "-", "0.996 (0.995 to 0.996)"]),
        (FIG4, "ours", 0, slice(3, None), ["0.996", "0.995", "-"]),
        (FIG4, "position only", 0, slice(None), ["", "", "0.764", "", "", ""]),
        (FIG4, "perfect", 0, slice(None), ["", "", "1.000", "", "", ""]),
        (FIG4, "random", 0, slice(None), ["", "", "-0.960", "", "", ""]),
        # How much it took.
        (FIG4, "MHA (paper)", 1, slice(1), ["0.75 after 1,500"]),
        (FIG4, "MHA (paper)", 1, slice(3, 6), [ANGLE, "0.0005", "20,640"]),
        (FIG4, "MHA (paper)", 1, slice(6, None), ["2,000", "1.0 (0.9 to 1.1)"]),
        (FIG4, "ours", 1, slice(1), ["-"]),
        # Both rewards.
        (FIG6, "random", 0, slice(None), ["", "-0.960", "", "", ""]),
        (FIG6, "random", 1, slice(None), ["", "-0.620", "", "", ""]),
        # The paper's beside ours.
        (TABLE1, "MHA (paper)", 0, slice(4), ["3 of 3", "504,000", "32,600", "72"]),
        (TABLE1, "MHA (paper)", 0, slice(4, 7), ["0.02 (0.01 to 0.02)", "28,000", "20,640"]),
        (TABLE1, "MHA (paper)", 0, slice(7, None), ["2,000", REWARD]),
        (TABLE2, "MHA (paper)", 0, slice(None), ["3 of 3", REWARD, "0.748 (0.740 to 0.752)"]),
        (TABLE2, "MHA (paper)", 1, slice(1, 2), [ANGLE]),
        (TABLE2, "MHA (paper)", 3, slice(None), ["1", "0.750", "0.740"]),
        (TABLE2, "MHA (paper), the paper's", 0, slice(None), ["", "0.758", "0.754"]),
        (TABLE2, "position only", 0, slice(None), ["", "0.764", "0.764"]),
        (TABLE2, "position only", 1, slice(None), ["", "23.80°", "23.80°"]),
        # A ranking compares with the first.
        (RANKING, "ours", 0, slice(2, 5, 2), ["reference", "reference"]),
        (RANKING, "MHA (paper)", 0, slice(1, 5), [REWARD, "-0.238", ANGLE, "+23.75°"]),
        (RANKING, "MHA (paper)", 0, slice(6, None), ["0.758", "0.750", "0.762"]),
        # How it was made.
        (None, "runs finished", 0, slice(None), ["7 of 9"]),
        (None, "seeds", 0, slice(None), ["0 / 1 / 2"]),
        (None, "commit", 0, slice(None), ["0123abc"]),
        (None, "processor", 0, slice(None), ["AMD EPYC"]),
        (None, "cores", 0, slice(None), ["2"]),
        (None, "versions", 0, slice(None), ["python 3.11.7, torch 2.13.0"]),
        (None, "time, all runs added up", 0, slice(None), ["0.12 h"]),
    ],
)
def test_the_cells_of_its_tables(
    page: str, name: str | None, label: str, row: int, cut: slice, expected: list[str]
) -> None:
    assert cells(page if name is None else part(page, name), label)[row][cut] == expected


@pytest.mark.parametrize(
    ("name", "label", "count"),
    [
        *((FIG4, policy, 1) for policy in ("position only", "perfect", "random")),
        (FIG6, "random", 2),
        (TABLE1, "MHA (paper)", 1),
        (TABLE2, "MHA (paper), the paper's", 1),
        (TABLE2, "position only", 2),
        (None, "runs finished", 1),
    ],
)
def test_rows_stand_once_in_each_table(page: str, name: str | None, label: str, count: int) -> None:
    assert len(cells(page if name is None else part(page, name), label)) == count


def test_texts_around_the_tables(page: str) -> None:
    text = part(page, FIG4)
    assert "## A curves title" in text
    assert "Source: Fig. 4. What curves are." in text
    assert "- MLP (2 of 3 seeds): seed 2 not started" in text
    assert "- ours (2 of 3 seeds): seed 2 not finished" in text
    assert "- MHA" not in text
    assert "| [A curves title](#fig4) | Fig. 4 | 7 of 9 |" in page
    assert "mean dense reward, median (least to most)" in part(page, FIG6)
    assert "![" not in part(page, TABLE1)
    assert "Left out" not in part(page, TABLE1)
    assert "Budget `laptop`: Narrower MHA." in page
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
    text = (made / "data.json").read_text()
    assert "secret-host" not in text
    assert "/home/somebody" not in text
    data = json.loads(text)
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
