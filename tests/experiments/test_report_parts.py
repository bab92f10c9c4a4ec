"""The parts of a report: looks, policies to compare with, the paper's values, commands."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tangram_lab.experiments.report import page as report_page
from tangram_lab.experiments.report.figures import looks, sweeps
from tangram_lab.experiments.report.page import Page, closing, command, write_report
from tangram_lab.experiments.report.references import References, papers
from tangram_lab.experiments.report.study import Study, read_runs
from tangram_lab.experiments.report.style import COLOURS
from tangram_lab.experiments.report.tables import picture, plain, ranking_table, table
from tests.experiments.builders import (
    EXPERIMENTS,
    TESTS,
    cells,
    experiment,
    plan,
    result,
    scores,
    training,
    trial,
    write_plan,
    write_run,
    write_study,
)

pytestmark = pytest.mark.fast


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report_page, "draw_paper_pictures", lambda out: [])


def test_every_training_has_one_look_and_neighbours_differ(tmp_path: Path) -> None:
    names = [f"t{index}" for index in range(12)]
    experiments = {
        "many": experiment("ranking", names),
        "few": experiment("curves", names[8:]),
        "more": experiment("tests", [names[0], *names[9:]]),
    }
    write_plan(tmp_path, plan(experiments, {name: training(name, "x") for name in names}, {}))
    found = looks(read_runs(tmp_path))
    assert set(found) == set(names)
    assert len({found[name].colour for name in names[8:]}) == 4
    assert found[names[0]].colour not in {found[name].colour for name in names[9:]}
    assert len({(one.colour, one.dash) for one in found.values()}) == 12
    assert {one.colour for one in found.values()} <= set(COLOURS)


def small(tmp_path: Path, **changes: Any) -> Study:
    """Two tasks: squares with tests, triangles of two sizes without."""
    names = {
        "square": training("square agent", "x"),
        "triangle": training("triangle agent", "x", "tokens=triangle"),
        "larger": training("larger agent", "x", "tokens=triangle", "tokens.scale=2"),
    }
    experiments = {"a": experiment("ranking", list(names))} | changes
    write_plan(tmp_path, plan(experiments, names, {"actions_1": trial("1 action", 1)}, (0,)))
    write_run(tmp_path, "square", result(0), [], {"actions_1": scores(0.7)})
    for name in ("triangle", "larger"):
        write_run(tmp_path, name, result(0, tokens=["large_triangle"]), [])
    return read_runs(tmp_path)


def test_policies_are_compared_within_their_own_task(tmp_path: Path) -> None:
    study = small(tmp_path)
    references, (one,) = References(study), study.experiments
    labels = ["position only (square)", "perfect (square)", "random (square)"]
    assert [reference.label for reference in references.of(one)] == labels
    assert references.lacking(one) == [
        "position only, perfect, random (triangle agent; larger agent)"
    ]
    lines = "\n".join(ranking_table(one, references, study.planned_seeds))
    assert cells(lines, "position only (square)")[0][1:4] == ["0.764", "", "23.80°"]


def test_without_baselines_the_report_says_so(tmp_path: Path) -> None:
    study = plan({"a": experiment("curves", ["one"])}, {"one": training("one", "x")}, {}, (0,))
    write_plan(tmp_path, study)
    write_run(tmp_path, "one", result(0), [])
    write_report(tmp_path, tmp_path / "out")
    page = (tmp_path / "out" / "README.md").read_text()
    assert "Left out, since no test has their scores: position only, perfect, random." in page
    assert "![" not in page  # there is no curve


def test_nothing_has_run_yet(tmp_path: Path) -> None:
    content = plan(EXPERIMENTS, {n: training(n, n) for n in ("paper", "mlp", "ours")}, TESTS)
    write_plan(tmp_path, content)
    write_report(tmp_path, tmp_path / "out")
    page = (tmp_path / "out" / "README.md").read_text()
    assert page.count("(0 of 3 seeds): seed 0 not started, seed 1 not started") == 13
    assert cells(page, "runs finished") == [["0 of 9"]]
    assert list((tmp_path / "out" / "figures").iterdir()) == []


def test_tests_that_are_missing_are_told(tmp_path: Path) -> None:
    study = small(tmp_path, t=experiment("tests", ["square", "triangle"], tests=["actions_1"]))
    page = Page(study, tmp_path, "figures", looks(study), References(study))
    text = "\n".join(page.section(study.experiments[1]))
    assert "- triangle agent: seed 0 not tested with 1 action" in text
    assert "- square agent" not in text
    assert cells(text, "triangle agent") == [
        ["1 of 1", "-"],
        ["1 of 1", "-"],
        ["0", "-"],
        ["0", "-"],
    ]


def test_papers_values_go_to_the_family_only_where_nobody_bears_the_name(tmp_path: Path) -> None:
    names = {n: training(n, "mlp") for n in ("mlp", "mlp_large")}
    both = experiment("curves", list(names), "Fig. 4 and Table I")
    alone = experiment("curves", ["mlp_large"], "Fig. 4")
    other = experiment("curves", ["mlp"], "Fig. 41")
    write_plan(tmp_path, plan({"both": both, "alone": alone, "other": other}, names, {}))
    first, second, third = read_runs(tmp_path).experiments
    found = [papers(first, one) for one in first.trainings]
    assert [one and one.mean_reward for one in found] == [0.70, None]
    assert papers(second, second.trainings[0]) is not None
    assert papers(third, third.trainings[0]) is None


def test_sweeps_over_noise_and_actions(tmp_path: Path) -> None:
    write_study(tmp_path)
    experiments = {one.name: one for one in read_runs(tmp_path).experiments}
    (noise,) = sweeps(experiments["noise"])
    (actions,) = sweeps(experiments["table2"])
    assert [x for x, _ in noise.places] == [0.0, 1.0]
    assert [x for x, _ in actions.places] == [1.0, 2.0]
    assert "%" in noise.label
    assert sweeps(replace(experiments["noise"], tests=experiments["noise"].tests[:1])) == []


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (
            "tangram-experiment experiment=[all] run_dir='my runs' jobs=2",
            "tangram-experiment experiment=[fig4] budget=laptop 'run_dir=my runs' jobs=2",
        ),
        (
            "tangram-experiment experiments.fig4.tests=[a] experiments.fig5.tests=[]",
            "tangram-experiment experiment=[fig4] budget=laptop 'experiments.fig4.tests=[a]'",
        ),
        (
            "tangram-experiment 'budget.overrides.all=[a=1,b=2]'",
            "tangram-experiment experiment=[fig4] budget=laptop 'budget.overrides.all=[a=1,b=2]'",
        ),
        ("tangram-experiment dry=true", "tangram-experiment experiment=[fig4] budget=laptop"),
        ("it's broken", "tangram-experiment experiment=[fig4] budget=laptop"),
    ],
)
def test_command_of_one_experiment(tmp_path: Path, line: str, expected: str) -> None:
    write_study(tmp_path)
    study = replace(read_runs(tmp_path), command=line)
    assert command(study, study.experiments[0]) == expected


def test_what_a_training_begins_with_is_told(tmp_path: Path) -> None:
    warm = training("warm", "x") | {"after": "cold"}
    write_plan(tmp_path, plan({}, {"warm": warm}, {}))
    assert "(`warm`, begins with the networks of `cold`)" in "\n".join(closing(read_runs(tmp_path)))


def test_markdown_is_escaped() -> None:
    assert plain("a < b & c\nd") == "a &lt; b &amp; c d"
    assert table(["a|b", "n"], [["x", "1"]])[:3] == ["| a\\|b | n |", "| --- | ---: |", "| x | 1 |"]
    assert picture("a [b]", "f.png")[0] == "![a (b)](f.png)"
