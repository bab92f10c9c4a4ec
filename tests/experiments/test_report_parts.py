"""The parts of a report: looks, the paper's values, sweeps, commands, Markdown, numbers."""

import bisect
import math
import statistics
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import trim_mean

from tangram_lab.experiments.report.figures import (
    PALETTE,
    agent_and_network,
    changed_worlds,
    curve_parts,
    draw_curves,
    draw_worlds,
    looks,
    sweeps,
)
from tangram_lab.experiments.report.numbers import (
    ANGLE,
    GRID,
    MINUTES,
    REWARD,
    band,
    points,
    reached,
    rises_early,
    spread,
    thinned,
)
from tangram_lab.experiments.report.page import command
from tangram_lab.experiments.report.profiles import draw_profile
from tangram_lab.experiments.report.reading import read_runs
from tangram_lab.experiments.report.references import falls_short, papers
from tangram_lab.experiments.report.statistics import (
    difference,
    interquartile_mean,
    profile,
)
from tangram_lab.experiments.report.study import Seed, Training
from tangram_lab.experiments.report.style import LINES
from tangram_lab.experiments.report.tables import (
    assembly_table,
    paired,
    picture,
    plain,
    puzzle_order_table,
    ranking_table,
    score_table,
    table,
    with_seeds,
    worlds_table,
)
from tangram_sim.arrays import Floats
from tangram_sim.errors import RunError
from tests.experiments.builders import (
    cells,
    experiment,
    learning_curve,
    of_several,
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
    assert len({found[name].dash for name in names[8:]}) == 4
    assert found[names[0]].dash not in {found[name].dash for name in names[9:]}
    assert {one.colour for one in found.values()} == {PALETTE["tangram mha"]}


def test_a_colour_is_an_agent_with_its_network() -> None:
    plain = {"label": "", "after": None, "name": "x"}
    kinds = [
        agent_and_network(Training(family=family, overrides=tuple(words.split()), **plain))
        for family, words in (
            ("paper", "agent=paper net=mha_small tokens=square"),
            ("paper", ""),
            ("paper", "agent=paper net=mlp"),
            ("mlp_large", "agent=mlp net=mlp_large"),
            ("matched", "agent=tangram net=mha"),
            ("start", ""),
            ("game", "agent.name=tangram net.kind=mlp"),
        )
    ]
    expected = ["paper mha"] * 2 + ["paper mlp"] * 2 + ["tangram mha"] * 2 + ["tangram mlp"]
    assert kinds == expected
    assert len(set(PALETTE.values()) & {PALETTE[kind] for kind in expected}) == 4


@pytest.mark.parametrize(
    ("trainings", "lengths"), [(1, [1]), (5, [5]), (6, [3, 3]), (11, [4, 3, 4])]
)
def test_no_panel_has_more_than_six_lines(
    tmp_path: Path, trainings: int, lengths: list[int]
) -> None:
    names = [f"t{index}" for index in range(trainings)]
    content = plan(
        {"a": experiment("curves", names)}, {n: training(n, "x") for n in names}, {}, (0,)
    )
    write_plan(tmp_path, content)
    for name in names:
        write_run(tmp_path, name, result(0), learning_curve(0, 0.7))
    study = read_runs(tmp_path)
    parts = curve_parts(study, study.experiments[0])
    assert [len(part) for part in parts] == lengths
    assert [one.name for part in parts for one in part] == names
    drawn = [draw_curves(study, study.experiments[0], REWARD, part) for part in parts]
    for panel in (panel for figure in drawn if figure is not None for panel in figure.axes):
        assert len(panel.lines) <= LINES
        assert panel.get_xscale() == "linear"  # half is reached after 8 %


def test_an_axis_is_logarithmic_where_curves_rise_early() -> None:
    """Half of the rise is between the two points."""
    for at, early in ((5, True), (20, False)):
        rising = curve((0, -1.0), (at - 1, -0.5), (at, 0.5), (100, 1.0))
        assert rises_early([rising, curve((0, 0.0), (50, 0.0))], "updates", "mean_reward") is early
    found = band([curve((0, -1.0), (4, 0.0), (400, 1.0))], "updates", "mean_reward", True)
    assert found is not None
    np.testing.assert_allclose(found.x, np.geomspace(4, 400, GRID))
    assert not rises_early([curve()], "updates", "mean_reward")


def test_papers_values_go_to_the_family_only_where_nobody_bears_the_name(tmp_path: Path) -> None:
    names = {n: training(n, "mlp") for n in ("mlp", "mlp_large")}
    both = experiment("curves", list(names), "Fig. 4 and Table I")
    alone = experiment("curves", ["mlp_large"], "Fig. 4")
    other = experiment("curves", ["mlp"], "Fig. 41")
    write_plan(tmp_path, plan({"both": both, "alone": alone, "other": other}, names, {}))
    found = [[papers(o, t) for t in o.trainings] for o in read_runs(tmp_path).experiments]
    told = {"mean_reward": 0.70, "after": 19_000}
    assert found == [[told, {}], [told], [{}]]


def test_worlds_stand_beside_the_formula_and_the_oracle(tmp_path: Path) -> None:
    """One thing is changed in each panel; where nothing is to be known the formula knows all."""
    names = {"plain": "", "noisy": "sim.action_noise=0.1", "far": "sim.gain=[2,2,2]"}
    tests = {name: {"label": name, "overrides": text.split()} for name, text in names.items()}
    tests["both"] = {"label": "", "overrides": ["sim.gain=[2,2,2]", "sim.damping=0.1"]}
    one = experiment("worlds", ["agent"], tests=[*tests])
    write_plan(tmp_path, plan({"a": one}, {"agent": training("ours", "x")}, tests, (0, 1)))
    for seed, final in enumerate((0.9, 0.8)):
        known = {"exact": {"mean_reward": 0.5}, "oracle": {"mean_reward": 1.0}}
        found = {"plain": scores(final), "far": scores(final - 0.1, known)}
        write_run(tmp_path, "agent", result(seed), [], found | {"noisy": scores(0.3)})
    study = read_runs(tmp_path)
    (read,) = study.experiments
    found = {n: {at: t.name for at, t in o.items()} for n, o in changed_worlds(read).items()}
    assert found == {
        "sim.action_noise": {0.0: "plain", 0.1: "noisy"},
        "sim.gain": {1.0: "plain", 2.0: "far"},
    }
    rows = [row[2:] for row in cells("\n".join(worlds_table(read)), "ours")]
    # Nobody was fitted, so that column is left out.
    assert rows[0] == ["0.8500 (0.8000 to 0.9000)", "1.0000", "-", "0.7640"]
    assert rows[2] == ["0.7500 (0.7000 to 0.8000)", "0.5000", "1.0000", "-"]
    drawn = draw_worlds(study, read)
    assert drawn is not None
    lines = [{one.get_label(): [*one.get_ydata()] for one in axes.lines} for axes in drawn.axes]
    assert [panel["formula"] for panel in lines] == [[1.0, 1.0], [1.0, 0.5]]
    assert [panel["oracle"] for panel in lines] == [[1.0, 1.0], [1.0, 1.0]]
    np.testing.assert_allclose(lines[1]["ours"], [0.85, 0.75])


def test_who_learned_nothing_stands_beside_the_agents_once_for_each_task(tmp_path: Path) -> None:
    """Not what an agent's own weights do otherwise. Another world is another task, by its name."""
    names, own = ("alike", "also", "unlike"), of_several([0.9, 0.8])
    for name in names:
        known = {"largest first": of_several([0.5, 0.7] if name == "unlike" else [0.2, 0.4])}
        known |= {"lookahead=none": own, "order=size": own, "random": of_several([0.0, 0.2])}
        write_run(
            tmp_path, name, result(0, tokens=["square"] * 7), [], {"far": scores(0.7, known, **own)}
        )
    one = experiment("game", [*names], tests=["far"])
    trainings = {name: training(name, "x") for name in names}
    content = plan({"a": one}, trainings, {"far": trial("far")}, (0,))
    content["trainings"]["unlike"]["settings"] = {"sim": {"pixels": 64}}
    write_plan(tmp_path, content)
    (read,) = read_runs(tmp_path).experiments
    lines = assembly_table(read)
    rows = [[cell.strip() for cell in line.split("|")[1:5]] for line in lines[2:] if line]
    assert rows[3:] == [
        ["largest first", "far, 7 tokens", "", "0.3000"],
        ["random", "far, 7 tokens", "", "0.1000"],
        ["largest first", "far, unlike", "", "0.6000"],
        ["random", "far, unlike", "", "0.1000"],
    ]
    assert "IoU 0.95" not in lines[0]  # what nobody measured has no column


def test_sweeps_over_noise_and_actions(tmp_path: Path) -> None:
    write_study(tmp_path)
    experiments = {one.name: one for one in read_runs(tmp_path).experiments}
    (noise,), (actions,) = sweeps(experiments["noise"]), sweeps(experiments["table2"])
    assert (list(noise.places), list(actions.places)) == ([0.0, 1.0], [1.0, 2.0])
    assert "%" in noise.label
    assert sweeps(replace(experiments["noise"], tests=experiments["noise"].tests[:1])) == []


@pytest.mark.parametrize(
    ("words", "kept"),
    [
        ("experiment=[all] run_dir='my runs' jobs=2 seed=1", " seed=1"),
        (
            "experiments.fig4.tests=[a] experiments.fig5.tests=[]",
            " 'experiments.fig4.tests=[a]'",
        ),
        ("'budget.overrides.all=[a=1,b=2]'", " 'budget.overrides.all=[a=1,b=2]'"),
        ("dry=true", ""),
        ("it's broken", ""),
    ],
)
def test_command_of_one_experiment(tmp_path: Path, words: str, kept: str) -> None:
    write_study(tmp_path)
    study = replace(read_runs(tmp_path), command=f"tangram-experiment {words}")
    expected = f"tangram-experiment experiment=[fig4] budget=laptop{kept}"
    assert command(study, study.experiments[0]) == expected


def test_markdown_is_escaped() -> None:
    assert plain("a < b & c\nd") == "a &lt; b &amp; c d"
    assert table(["a|b", "n"], [["x"]])[:3] == ["| a\\|b | n |", "| --- | ---: |", "| x |  |"]
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
    assert (found.deviation, found.seeds) == (None, 1)
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
    ("level", "expected"),
    [(0.1, (0, 100)), (0.735, (200, 300)), (0.75, (300, 400)), (0.8, None)],
)
def test_between_which_evaluations_a_curve_first_reaches_a_level(
    level: float, expected: tuple[float, float] | None
) -> None:
    pairs = [(100, 0.2), (200, 0.6), (300, 0.735), (400, 0.75), (500, 0.74)]
    rows = tuple({"episodes": x, "mean_reward": y} for x, y in pairs)
    assert reached(Seed(0, "finished", result(0, 0.75), rows, {}), level) == expected


@given(st.integers(0, 300), st.integers(2, 80))
def test_thinned_curves_keep_their_ends_and_their_order(length: int, count: int) -> None:
    rows = [{"updates": index} for index in range(length)]
    kept = [row["updates"] for row in thinned(rows, count)]
    assert len(kept) == min(length, count)
    assert kept == sorted(set(kept))
    assert kept[:1] + kept[-1:] == [row["updates"] for row in rows[:1] + rows[-1:]]


def test_learning_curves_are_thinned_to_sixty_points() -> None:
    assert len(thinned(learning_curve(0, 0.7, count=500))) == 60


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (spread([0.3, 0.1, 0.2, 0.6]), (0.1, 0.25, 0.6)),
        (spread([]), None),
        (REWARD.show_spread({}), "-"),
        (REWARD.show_spread({0: 0.7514}), "0.751"),
        (REWARD.show_spread({0: 0.75, 1: 0.7501}), "0.750"),
        (REWARD.show_spread({0: 0.76, 1: 0.74, 2: 0.758}), "0.758 (0.740 to 0.760)"),
        (REWARD.show_spread({0: -0.0001}), "0.000"),
        (ANGLE.show(0.0371), "0.04°"),
        (ANGLE.show(-0.001), "0.00°"),
        (MINUTES.show(90.0), "1.5"),
        (paired([]), "-"),
        (paired([0.1]), "-"),
        (paired([0.0, 0.0, 0.0]), "+0.0000 (+0.0000 to +0.0000)"),
        (paired([-0.2, -0.1, 0.0, 0.1]), "-0.0500 (-0.1765 to +0.0765)"),
        (with_seeds([]), "-"),
        (with_seeds([np.array([0.1, 0.1])]), "+0.1000 (+0.1000 to +0.1000)"),
        (with_seeds([np.zeros(2), np.zeros(3)]), "-"),  # tested on different episodes
        (
            with_seeds([np.array([-0.2, -0.1, 0.0]), np.array([0.2, 0.1, 0.0])]),
            "+0.0000 (+0.0000 to +0.0000), seeds -0.1000 to +0.1000",
        ),
    ],
)
def test_numbers_as_people_read_them(found: object, expected: object) -> None:
    assert found == expected


@pytest.mark.parametrize(
    ("override", "short"),
    [
        ("sim.damping=0.04", True),
        ("sim.damping=0.0", False),
        ("sim.substeps=1", True),
        ("sim.substeps=4", False),
        ("sim.gain=[0.8,1,1]", True),
        ("sim.gain=[1,1,1]", False),
        ("sim.delay=true", True),
        ("sim=bullet_defaults", True),
        ("sim.arena=3", False),
    ],
)
def test_in_which_worlds_the_exact_hand_is_no_oracle(override: str, short: bool) -> None:
    assert falls_short(override) == short


@pytest.mark.parametrize("override", ["sim.substeps=abc", "sim.foo=[1,"])
def test_an_override_that_cannot_be_read_is_told(override: str) -> None:
    with pytest.raises(RunError, match="is no setting: mend the plan"):
        falls_short(override)


# Statistics


@pytest.mark.parametrize(("seeds", "interval"), [(2, False), (8, True)])
def test_a_difference_is_of_the_same_episodes_and_its_interval_needs_seeds(
    tmp_path: Path, seeds: int, interval: bool
) -> None:
    one = experiment("ranking", ["ours", "less"], tests=["random"])
    names = {"ours": training("ours", "x"), "less": training("less", "x")}
    tests = {"random": {"label": "random", "overrides": []}}
    write_plan(tmp_path, plan({"a": one}, names, tests, tuple(range(seeds))))
    for name, base in (("ours", 0.9), ("less", 0.8)):
        for seed in range(seeds):
            coverage = [base, base - 0.2 - 0.01 * (seed % 2), base - 0.1]
            test = scores(2 * float(np.mean(coverage)) - 1, coverage_each=coverage, episodes=3)
            write_run(tmp_path, name, result(seed), [], {"random": test})
    study = read_runs(tmp_path)
    (row,) = cells("\n".join(ranking_table(study, study.experiments[0])), "less")
    assert row[2 + interval].startswith("-0.2000")  # a reward is twice a coverage, less 1
    assert ("to" in row[2 + interval]) == interval


def test_orders_are_compared_in_puzzles_that_tell_no_episodes(tmp_path: Path) -> None:
    """Where nobody played in another order, there is nothing to compare."""
    one = experiment("game", ["seven"], tests=["hidden", "random", "beam"])
    names = {"seven": training("seven", "game", "tokens=tangram7")}
    tests = {name: {"label": name, "overrides": []} for name in ("hidden", "random", "beam")}
    write_plan(tmp_path, plan({"a": one}, names, tests, (0, 1)))
    for seed, own in enumerate((0.99, 0.97)):
        listed = {"coverage": own - 0.01, "share_solved_iou": 0.5}
        hidden = {"coverage": own, "share_solved_iou": 1.0, "mean_reward": 0.9}
        told = of_several([own, own], mean_reward=0.9)
        scored = {"hidden": hidden | {"baselines": {"order=listed": listed}}, "beam": hidden}
        write_run(tmp_path, "seven", result(seed), [], scored | {"random": told})
    study = read_runs(tmp_path)
    lines = puzzle_order_table(study.experiments[0])
    assert cells("\n".join(lines), "seven") == [
        ["hidden", "learned", "0.9800 (0.9700 to 0.9900)", "100.0 %"],
        ["hidden", "order=listed", "0.9700 (0.9600 to 0.9800)", "50.0 %"],
    ]


def test_a_ranking_has_what_learned_nothing_in_a_changed_world(tmp_path: Path) -> None:
    """There the formula is no oracle, and chance is left out."""
    one = experiment("ranking", ["ours", "damped"], tests=["random"])
    names = {
        "ours": training("ours", "x"),
        "damped": training("in a damped world", "x", "sim.damping=0.04"),
    }
    tests = {"random": {"label": "random", "overrides": []}}
    write_plan(tmp_path, plan({"a": one}, names, tests, (0,)))
    known = {"position only": 0.71, "exact": 0.82, "fitted": 0.99, "oracle": 1.0, "random": -0.9}
    for name in names:
        baselines = {policy: {"mean_reward": score} for policy, score in known.items()}
        write_run(tmp_path, name, result(0), [], {"random": scores(0.9) | {"baselines": baselines}})
    study = read_runs(tmp_path)
    lines = ranking_table(study, study.experiments[0])
    found = [[cell.strip() for cell in line.split("|")[1:4:2]] for line in lines[4:] if line]
    assert found == [
        ["position only (ours)", "0.710"],
        ["exact oracle (ours)", "0.820"],
        ["random (ours)", "-0.900"],
        ["position only (in a damped world)", "0.710"],
        ["formula (in a damped world)", "0.820"],
        ["formula with a fitted motion (in a damped world)", "0.990"],
        ["oracle told of the world (in a damped world)", "1.000"],
    ]


def test_the_interval_of_a_difference_has_the_spread_of_seeds_and_of_episodes() -> None:
    """Against the deviation of the difference over many draws of seeds and episodes."""
    generator = np.random.default_rng(0)

    def drawn(mean: float, episodes: Floats) -> Floats:
        return mean + 0.02 * generator.normal(size=(10, 1)) + episodes

    found = difference(drawn(0.8, np.zeros((1, 50))), drawn(0.7, np.zeros((1, 50))))
    expected = 2 * 1.96 * 0.02 * math.sqrt(2 / 10)
    assert 0.5 * expected < found.high - found.low < 1.5 * expected
    hard = 0.1 * generator.normal(size=(1, 50))  # the same episodes are hard for both
    again = difference(drawn(0.8, hard), drawn(0.7, hard))
    assert again.high - again.low < 1.5 * expected
    assert again.low < 0.1 < again.high


def test_an_interquartile_mean_leaves_out_the_quarters() -> None:
    values = np.array([[0.0], [0.5], [0.6], [0.7], [0.8], [0.9], [1.0], [-1.0]])
    found = interquartile_mean(values)
    assert found.estimate == pytest.approx(trim_mean(values, 0.25, axis=None))
    assert found.estimate == pytest.approx(0.65)
    assert found.low < found.estimate < found.high


def test_what_is_drawn_comes_twice_alike_and_disturbs_no_other_draws() -> None:
    values, told = np.random.default_rng(0).normal(size=(10, 1)), list[Any]()
    for seed in (1, 2):
        np.random.seed(seed)  # noqa: NPY002
        before = str(np.random.get_state(legacy=False))  # noqa: NPY002
        told.append(interquartile_mean(values))
        assert str(np.random.get_state(legacy=False)) == before  # noqa: NPY002
    assert told[0] == told[1]


def test_a_profile_is_the_share_of_runs_above_each_level() -> None:
    shares, interval = profile(np.array([[0.1, 0.9], [0.3, 0.9]]), np.array([0.0, 0.2, 0.95]))
    assert shares.tolist() == [1.0, 0.75, 0.0]
    assert (interval[0] <= shares).all()
    assert (interval[1] >= shares).all()


@pytest.mark.parametrize(("seeds", "shown"), [(4, False), (8, True)])
def test_a_quartile_needs_eight_seeds(tmp_path: Path, seeds: int, shown: bool) -> None:
    one = experiment("curves", ["ours"], tests=["random"])
    tests = {"random": {"label": "random", "overrides": []}}
    content = plan({"a": one}, {"ours": training("ours", "x")}, tests, tuple(range(seeds)))
    write_plan(tmp_path, content)
    for seed in range(seeds):
        test = {"random": scores(0.5 + seed / 20)}
        write_run(tmp_path, "ours", result(seed), learning_curve(seed, 0.9), test)
    study = read_runs(tmp_path)
    lines = score_table(study, study.experiments[0], REWARD)
    assert ("interquartile mean" in lines[0]) is shown
    row = cells("\n".join(lines), "ours")[0]
    assert row[1] == ("0.675 (0.500 to 0.850)" if shown else "0.575 (0.500 to 0.650)")
    if shown:
        assert row[2].startswith("0.6750 (")


@pytest.mark.parametrize(
    ("seeds", "shapes", "lines"),
    [
        (7, ("square", "parallelogram"), []),
        (8, ("square", "parallelogram"), ["all 2 tasks alike"]),  # one agent's tasks
        (8, ("square", "square"), ["one", "two"]),  # agents at one task
    ],
)
def test_a_profile_is_drawn_of_the_seeds_that_all_trainings_have(
    tmp_path: Path,
    seeds: int,
    shapes: tuple[str, str],
    lines: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("tangram_lab.experiments.report.statistics.REPETITIONS", 100)
    names = {name: training(name, "x") for name in ("one", "two")}
    tests = {"random": {"label": "random", "overrides": []}}
    one = experiment("ranking", [*names], tests=["random"])
    write_plan(tmp_path, plan({"a": one}, names, tests, tuple(range(9))))
    for name, count, shape in (("one", seeds, shapes[0]), ("two", 9, shapes[1])):
        for seed in range(count):
            content = result(seed, tokens=[shape])
            write_run(tmp_path, name, content, [], {"random": scores(0.99)})
    figure = draw_profile(read_runs(tmp_path).experiments[0])
    drawn = [] if figure is None else figure.axes[0].lines
    assert [line.get_label() for line in drawn] == lines
    for line in drawn:
        x, y = np.asarray(line.get_xdata()), np.asarray(line.get_ydata())
        assert set(y[x < 0.0099]) == {0.0}
        assert set(y[x > 0.0101]) == {1.0}
