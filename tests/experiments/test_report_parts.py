"""The parts of a report: looks, policies to compare with, the paper's values, numbers, tables."""

import bisect
import statistics
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tangram_lab.experiments.report import page as report_page
from tangram_lab.experiments.report.figures import looks, sweeps
from tangram_lab.experiments.report.numbers import (
    ANGLE,
    GRID,
    MINUTES,
    REWARD,
    band,
    first_at_least,
    points,
    spread,
    thinned,
)
from tangram_lab.experiments.report.page import Page, closing, command, write_report
from tangram_lab.experiments.report.references import References, papers
from tangram_lab.experiments.report.study import Experiment, Seed, Study, read_runs
from tangram_lab.experiments.report.style import COLOURS
from tangram_lab.experiments.report.tables import (
    assembly_table,
    differences,
    order_table,
    paired,
    picture,
    plain,
    ranking_table,
    table,
)
from tests.experiments.builders import (
    EXPERIMENTS,
    TESTS,
    cells,
    experiment,
    learning_curve,
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


# Curves of several seeds on one grid, medians, and numbers as people read them


def curve(*pairs: tuple[float, float | None]) -> list[dict[str, Any]]:
    return [{"updates": x, "mean_reward": y} for x, y in pairs]


def read_at(pairs: list[tuple[float, float]], x: float) -> float:
    """An oracle: linear between the two neighbours of x."""
    right = min(max(bisect.bisect_left([p[0] for p in pairs], x), 1), len(pairs) - 1)
    (x0, y0), (x1, y1) = pairs[right - 1 : right + 1]
    return y0 + (y1 - y0) * (x - x0) / (x1 - x0)


@given(st.lists(st.integers(0, 2**32 - 1), min_size=2, max_size=4))
def test_band_is_the_mean_and_deviation_of_curves_read_at_every_point(seeds: list[int]) -> None:
    curves = []
    for seed in seeds:
        generator = np.random.default_rng(seed)
        x = np.sort(generator.uniform(0, 100, 9)) + np.arange(9)
        curves.append(list(zip(x.tolist(), generator.normal(size=9).tolist(), strict=True)))
    low, high = max(c[0][0] for c in curves), min(c[-1][0] for c in curves)
    found = band([curve(*pairs) for pairs in curves], "updates", "mean_reward")
    if low >= high:
        assert found is None
        return
    assert found is not None
    assert found.deviation is not None
    assert (found.x[0], found.x[-1], len(found.x)) == (low, high, GRID)
    for index in (0, 1, 57, GRID - 2, GRID - 1):
        values = [read_at(pairs, float(found.x[index])) for pairs in curves]
        assert found.mean[index] == pytest.approx(statistics.mean(values))
        assert found.deviation[index] == pytest.approx(statistics.stdev(values), abs=1e-9)


def test_band_of_one_seed_has_no_deviation() -> None:
    found = band([curve((0, 0.0), (10, 1.0))], "updates", "mean_reward")
    assert found is not None
    assert found.deviation is None
    assert found.seeds == 1
    np.testing.assert_allclose(found.mean, np.linspace(0, 1, GRID))


@pytest.mark.parametrize(
    "curves",
    [
        [],
        [[]],
        [curve((3, None))],
        [curve((3, 0.1))],
        [curve((0, 0), (1, 1)), curve((2, 0), (3, 1))],
    ],
)
def test_no_band_without_a_common_range(curves: Any) -> None:
    assert band(curves, "updates", "mean_reward") is None


def test_points_without_a_value_are_left_out() -> None:
    x, y = points(curve((1, 0.1), (2, None), (3, 0.3)), "updates", "mean_reward")
    assert (x.tolist(), y.tolist()) == ([1, 3], [0.1, 0.3])


@pytest.mark.parametrize(
    ("level", "expected"), [(0.1, 100), (0.735, 300), (0.75, 400), (0.8, None)]
)
def test_where_a_curve_first_reaches_a_level(level: float, expected: float | None) -> None:
    pairs = [(100, 0.2), (200, 0.6), (300, 0.735), (400, 0.75), (500, 0.74)]
    rows = tuple({"episodes": x, "mean_reward": y} for x, y in pairs)
    seed = Seed(0, "finished", result(0, 0.75), rows, {})
    assert first_at_least(seed, level) == expected


@given(st.integers(0, 300), st.integers(2, 80))
def test_thinned_curves_keep_their_ends_and_their_order(length: int, count: int) -> None:
    rows = [{"updates": index} for index in range(length)]
    kept = [row["updates"] for row in thinned(rows, count)]
    assert len(kept) == min(length, count)
    assert kept == sorted(set(kept))
    assert kept[:1] + kept[-1:] == [row["updates"] for row in rows[:1] + rows[-1:]]


def test_learning_curves_are_thinned_to_sixty_points() -> None:
    assert len(thinned(learning_curve(0, 0.7, count=500))) == 60


def test_spread() -> None:
    found = spread([0.3, 0.1, 0.2, 0.6])
    assert found is not None
    assert (found.median, found.least, found.most) == (0.25, 0.1, 0.6)
    assert spread([]) is None


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({}, "-"),
        ({0: 0.7514}, "0.751"),
        ({0: 0.75, 1: 0.7501}, "0.750"),
        ({0: 0.76, 1: 0.74, 2: 0.758}, "0.758 (0.740 to 0.760)"),
        ({0: -0.0001}, "0.000"),
    ],
)
def test_spreads_as_text(values: dict[int, float], text: str) -> None:
    assert REWARD.show_spread(values) == text


def test_units_of_numbers() -> None:
    assert ANGLE.show(0.0371) == "0.04°"
    assert ANGLE.show(-0.001) == "0.00°"
    assert MINUTES.show(90.0) == "1.5"
    assert REWARD.show_difference({0: 0.5, 1: 0.6}, {0: 0.7}) == "-0.150"
    assert ANGLE.show_difference({0: 3.0}, {0: 1.0}) == "+2.00°"
    assert ANGLE.show_difference({}, {0: 1.0}) == "-"


# The tables of several tokens, from numbers of which every cell is known


SEVEN = ["square"] * 7


def of_several(coverage: list[float], **more: Any) -> dict[str, Any]:
    """Scores of a test with several tokens."""
    return {
        "coverage": float(np.mean(coverage)),
        "coverage_each": coverage,
        "share_solved": float(np.mean(np.array(coverage) >= 0.95)),
        "iou": 0.9,
        "wrong": 0.25,
        "doubly_used": 0.0,
        "blocked": 0.5,
        "seconds_per_puzzle": 0.125,
        "position_error_median": 0.0012,
    } | more


def game(folder: Path, listed: list[list[float] | None]) -> Experiment:
    """One training of two seeds, tested once; `listed` is each seed's coverage in that order."""
    write_plan(
        folder,
        plan(
            {"game": experiment("game", ["seven"], tests=["random"])},
            {"seven": training("seven tokens", "game")},
            {"random": trial("random targets")},
            seeds=(0, 1),
        ),
    )
    for seed, (own, other) in enumerate(zip(([1.0, 0.98], [0.96, 0.9]), listed, strict=True)):
        baselines: dict[str, Any] = {
            "exact": of_several([1.0, 1.0], mean_reward=1.0),
            "random": of_several([0.1, 0.3], mean_reward=-0.9),
        }
        if other is not None:
            baselines["order=listed"] = of_several(other, mean_reward=0.5)
        test = scores(0.9, baselines, **of_several(own))
        write_run(folder, "seven", result(seed, tokens=SEVEN), [], {"random": test})
    return read_runs(folder).experiments[0]


def cells_of(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_scores_are_medians_and_what_learned_nothing_stands_below(tmp_path: Path) -> None:
    head, _, own, exact, chance, _ = assembly_table(game(tmp_path, [None, None]))
    row = dict(zip(cells_of(head), cells_of(own), strict=True))
    assert row["training"] == "seven tokens"
    assert row["test"] == "random targets"
    assert row["seeds"] == "2"
    assert row["coverage"] == "0.9600 (0.9300 to 0.9900)"
    assert row["solved"] == "75.0 % (50.0 % to 100.0 %)"
    assert row["IoU"] == "0.900"
    assert row["position error"] == "0.0012"
    assert row["refused placements"] == "0.50"
    assert row["ms per target"] == "125"
    assert cells_of(exact)[:4] == ["exact", "random targets, 7 tokens", "", "1.0000"]
    assert cells_of(chance)[:4] == ["random", "random targets, 7 tokens", "", "0.2000"]


def test_orders_are_compared_episode_by_episode(tmp_path: Path) -> None:
    found = game(tmp_path, [[0.9, 0.9], [0.9, 0.9]])
    (one,), (test,) = found.trainings, found.tests
    np.testing.assert_allclose(differences(one, test, "order=listed"), [0.08, 0.04])
    lines = order_table(found)
    row = dict(zip(cells_of(lines[2]), cells_of(lines[4]), strict=True))
    assert row["learned"] == "0.9600 (0.9300 to 0.9900)"
    # A mean of 0.06 with a deviation of 0.0283 over two pairs.
    assert row["less order=listed"] == "+0.0600 (+0.0208 to +0.0992)"
    assert row["less order=size"] == "-"


def test_without_another_order_there_is_no_table(tmp_path: Path) -> None:
    assert order_table(game(tmp_path, [None, None])) == []


def test_a_seed_without_the_other_order_is_left_out(tmp_path: Path) -> None:
    found = game(tmp_path, [[0.9, 0.9], None])
    got = differences(found.trainings[0], found.tests[0], "order=listed")
    np.testing.assert_allclose(got, [0.1, 0.08])


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ([], "-"),
        ([0.1], "-"),
        ([0.0, 0.0, 0.0], "+0.0000 (+0.0000 to +0.0000)"),
        ([-0.2, -0.1, 0.0, 0.1], "-0.0500 (-0.1765 to +0.0765)"),
    ],
)
def test_the_interval_of_paired_differences(values: list[float], text: str) -> None:
    assert paired(values) == text
