"""Study folders: what is read, what is missing, what is refused; and runs that nobody planned."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from tangram_lab.experiments.report.page import write_report
from tangram_lab.experiments.report.reading import read_runs
from tangram_lab.experiments.report.study import Budget, Trial
from tangram_sim.errors import RunError
from tests.experiments.builders import (
    cells,
    experiment,
    learning_curve,
    plan,
    result,
    scores,
    training,
    write_plan,
    write_run,
    write_study,
)

pytestmark = pytest.mark.fast

RUN = "trainings/paper/seed_0"
BIG = "9" * 5000
POINT = '{"updates": 1, "episodes": 1, "train_s": 1}'
PAPER = {"label": "MHA", "family": "paper", "overrides": []}


def test_a_study_is_read_with_what_its_runs_have_left(tmp_path: Path) -> None:
    write_study(tmp_path)
    study = read_runs(tmp_path)
    assert study.budget == Budget("laptop", "Narrower MHA.", 100, 2)
    paper, mlp, ours, triangle, *_ = study.trainings
    assert [one.name for one in study.experiments[0].trainings] == ["paper", "mlp", "ours"]
    done, cut = "finished", "not finished"
    assert [[seed.state for seed in one.seeds] for one in (paper, mlp, ours, triangle)] == [
        [done] * 3,
        [done, done, "not started"],
        [done, done, cut],
        [done, "stopped by SIGINT", "not started"],
    ]
    assert len(ours.seeds[2].curve) == 3  # a last line that was cut is no error
    assert paper.values("mean_reward") == {0: 0.758, 1: 0.75, 2: 0.762}
    found = paper.values("mean_reward", "actions_2")
    assert found == pytest.approx({0: 0.748, 1: 0.74, 2: 0.752})
    assert (paper.tokens, triangle.tokens) == ("square", "large triangle")
    # Names of machines and of their folders.
    assert "host" not in paper.seeds[0].result
    assert "run_dir" not in paper.seeds[0].tests["actions_1"]


def test_scores_that_nobody_measured_are_left_out(tmp_path: Path) -> None:
    write_plan(tmp_path, plan({}, {"paper": PAPER}, {}, seeds=(0, 1)))
    write_run(tmp_path, "paper", result(0, None, scored_updates=None), [])
    write_run(tmp_path, "paper", result(1, 0.5), [])
    (training,) = read_runs(tmp_path).trainings
    assert training.values("mean_reward") == {1: 0.5}
    assert training.values("updates") == {0: 2000, 1: 2000}


def test_baselines_and_points_may_be_missing_and_other_files_are_not_read(tmp_path: Path) -> None:
    write_study(tmp_path)
    (tmp_path / RUN / "tests/actions_1.json").write_text(json.dumps(scores(0.5, None)))
    (tmp_path / RUN / "tests/other.json").write_text("no JSON")
    (tmp_path / RUN / "curve.jsonl").write_text("")
    seed = read_runs(tmp_path).trainings[0].seeds[0]
    assert seed.tests["actions_1"]["mean_reward"] == 0.5
    assert "other" not in seed.tests
    assert seed.curve == ()


# Refused


def refused(folder: Path, file: str, message: str) -> None:
    """The study is refused in one line that names the file."""
    with pytest.raises(RunError) as caught:
        read_runs(folder)
    assert str(caught.value).startswith(f"{folder / file}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_plan(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="plan.json is missing: name a folder that"):
        read_runs(tmp_path)


def budget(**changes: Any) -> dict[str, Any]:
    content: dict[str, Any] = plan({}, {}, {})["budget"]
    return {"budget": content | changes}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 2}, "its format is 2, but this version reads 4"),
        ({"budget": {}}, "missing required field `name` - at `$.budget`; run its tangram-experi"),
        ({"budget": []}, "Expected `object`, got `array` - at `$.budget`"),
        *(
            (
                {"trainings": {"paper": PAPER | {"seeds": [value]}}},
                "- at `$.trainings[...].seeds[0]`; run its tangram-experiment",
            )
            for value in (True, -1, 1.5, "1", None)
        ),
        (budget(test_episodes=-1), "Expected `int` >= 0 - at `$.budget.test_episodes`"),
        ({"command": 3}, "Expected `str`, got `int` - at `$.command`"),
        ({"trainings": {"paper": {}}}, "missing required field `label` - at `$.trainings[...]`"),
        ({"trainings": {"../x": PAPER | {"seeds": [0]}}}, "'../x' is no name of"),
        ({"tests": {"a b": {"label": ""}}}, "'a b' is no name"),
        ({"trainings": {"paper": PAPER}}, "seeds must be different numbers, got []"),
        ({"trainings": {"paper": PAPER | {"seeds": [1, 1]}}}, "seeds must be different numbers"),
        ({"trainings": {}}, "its trainings lack 'paper'"),
        ({"tests": {}}, "its tests lack 'actions_1'"),
    ],
)
def test_a_wrong_plan_is_told_in_one_line(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    write_plan(tmp_path, write_study(tmp_path) | change)
    refused(tmp_path, "plan.json", message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "cake"}, "kind must be one of curves, complexity, tests"),
        ({"labels": {"paper": 3}}, "Expected `str`, got `int` - at `$.experiments[...].labels"),
        ({"labels": {"later": "x"}}, "labels must be one of paper, mlp, ours, got 'later'; run"),
    ],
)
def test_a_wrong_experiment_is_told_in_one_line(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    content = write_study(tmp_path)
    content["experiments"] = {"fig4": content["experiments"]["fig4"] | change}
    write_plan(tmp_path, content)
    refused(tmp_path, "plan.json", message)


NOT_JSON = "it is not JSON ("


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("plan.json", "{", NOT_JSON),
        ("plan.json", "[]", "Expected `object`, got `array`; run its tangram-experiment command"),
        (f"{RUN}/result.json", '{\n"a": }', NOT_JSON),
        (f"{RUN}/result.json", "{}", "missing required field `mean_reward`; delete this folder"),
        (f"{RUN}/result.json", '{"mean_reward": NaN}', NOT_JSON),
        (f"{RUN}/result.json", f'{{"mean_reward": {BIG}}}', "Integer value out of range"),
        (f"{RUN}/result.json", '{"mean_reward": "0.7"}', "got `str` - at `$.mean_reward`; delete"),
        (f"{RUN}/result.json", '{"mean_reward": true}', "got `bool` - at `$.mean_reward`; delete"),
        (f"{RUN}/result.json", '{"mean_reward": 1e999}', "Number out of range"),
        (f"{RUN}/result.json", b"\xff\xfe", NOT_JSON),
        (f"{RUN}/result.json", '{"a":' * 100_000, NOT_JSON),
        (f"{RUN}/curve.jsonl", "{}\n", "line 1: Object missing required field"),
        (f"{RUN}/curve.jsonl", POINT + "\n", "line 1: Object missing required field `mean_rewa"),
        (f"{RUN}/curve.jsonl", '{"updates": 1\n', f"line 1: {NOT_JSON}"),
        (f"{RUN}/tests/actions_1.json", "{}", "missing required field `mean_reward`; delete the f"),
        (
            f"{RUN}/tests/actions_1.json",
            '{"mean_reward": 0.7, "baselines": {"random": 3}}',
            "Expected `object`, got `int` - at `$.baselines[...]`; delete the file",
        ),
        (
            f"{RUN}/tests/actions_1.json",
            '{"mean_reward": 0.7, "baselines": {"random": {"mean_reward": "low"}}}',
            "got `str` - at `$.baselines[...].mean_reward`",
        ),
    ],
)
def test_a_corrupt_file_is_told_in_one_line(
    tmp_path: Path, file: str, text: str | bytes, message: str
) -> None:
    write_study(tmp_path)
    (tmp_path / file).write_bytes(text.encode() if isinstance(text, str) else text)
    refused(tmp_path, file, message)


@pytest.mark.parametrize(
    "name", ["updates", "train_s", "wall_s", "parameters", "cores", "commit", "versions", "tokens"]
)
def test_a_result_holds_everything_that_the_page_tells(tmp_path: Path, name: str) -> None:
    write_study(tmp_path)
    (tmp_path / RUN / "result.json").write_text(json.dumps(result(0) | {name: [3]}))
    refused(tmp_path, f"{RUN}/result.json", f"`$.{name}")


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    write_study(tmp_path)
    (tmp_path / RUN / "tests/actions_1.json").unlink()
    (tmp_path / RUN / "tests/actions_1.json").mkdir()
    with pytest.raises(RunError, match="cannot be read (.*); delete the file"):
        read_runs(tmp_path)


def test_a_test_that_asks_for_no_number() -> None:
    trial = Trial("noise", ("sim.corner_noise=x",), "noise")
    with pytest.raises(RunError, match="test noise: sim.corner_noise must be a number, got 'x'"):
        _ = trial.corner_noise


@pytest.mark.parametrize("axis", ["updates", "episodes", "train_s"])
def test_a_curve_that_goes_back(tmp_path: Path, axis: str) -> None:
    write_study(tmp_path)
    curve = learning_curve(0, 0.7)
    curve[3][axis] = curve[2][axis] - 0.5
    lines = "".join(json.dumps(point) + "\n" for point in curve)
    (tmp_path / RUN / "curve.jsonl").write_text(lines)
    refused(tmp_path, f"{RUN}/curve.jsonl", "line 4 goes back")


# Runs that nobody planned, such as those of a sweep


def config(agent: str, seed: int, **more: Any) -> dict[str, Any]:
    return {"seed": seed, "run_dir": f"/x/{seed}", "agent": {"name": agent, "noise": 0.1}, **more}


def write_sweep(folder: Path) -> None:
    """Two agents, three seeds each, numbered as by --multirun."""
    for number in range(6):
        agent, seed = ("paper", "tangram")[number // 3], number % 3
        run, score = folder / str(number), 0.5 + number / 10
        run.mkdir()
        (run / "result.json").write_text(json.dumps(result(seed, score)))
        lines = [json.dumps(point) for point in learning_curve(seed, score)]
        (run / "curve.jsonl").write_text("\n".join(lines) + "\n")
        (run / "config.yaml").write_text(yaml.safe_dump(config(agent, seed)))


def test_runs_that_differ_in_their_seed_alone_are_one_row(tmp_path: Path) -> None:
    write_sweep(tmp_path)
    study = read_runs(tmp_path)
    assert [one.label for one in study.trainings] == ["paper", "tangram"]
    assert study.trainings[1].values("mean_reward") == pytest.approx({0: 0.8, 1: 0.9, 2: 1.0})
    assert study.trainings[0].overrides == ("agent.name=paper",)
    page, _ = write_report(tmp_path, tmp_path / "report")
    text = page.read_text()
    assert [row[0] for row in cells(text, "paper") + cells(text, "tangram")] == ["3 of 3"] * 2
    assert cells(text, "episodes of a test that names no number, puzzles apart") == [["100"]]
    assert "tangram-experiment" not in text
    assert "Fig. 1" not in text


def test_labels_name_what_differs_within_an_agent(tmp_path: Path) -> None:
    write_sweep(tmp_path)
    more = config("paper", 0, sim={"substeps": 4}) | {"agent": {"name": "paper", "noise": 0.2}}
    (tmp_path / "10").mkdir()
    (tmp_path / "10" / "config.yaml").write_text(yaml.safe_dump(more))
    labels = [one.label for one in read_runs(tmp_path).trainings]
    assert labels == ["paper, agent.noise=0.1", "tangram", "paper, agent.noise=0.2, sim.substeps=4"]


def test_the_same_run_twice_is_refused(tmp_path: Path) -> None:
    write_sweep(tmp_path)
    (tmp_path / "5" / "config.yaml").write_text(yaml.safe_dump(config("tangram", 1)))
    with pytest.raises(RunError, match="4 and .*5 have the same settings and seed 1"):
        read_runs(tmp_path)


def test_a_config_without_a_seed_is_refused(tmp_path: Path) -> None:
    (tmp_path / "0").mkdir()
    (tmp_path / "0" / "config.yaml").write_text("seed: x")
    with pytest.raises(RunError, match="seed must be a number, got 'x'"):
        read_runs(tmp_path)


def test_an_experiment_compares_the_seeds_that_all_its_trainings_have(tmp_path: Path) -> None:
    names = {name: training(name, "x") for name in ("many", "few")}
    alone = experiment("ranking", ["many"])
    content = plan({"both": experiment("ranking", [*names]), "alone": alone}, names, {}, (0, 1, 2))
    content["trainings"]["few"]["seeds"] = [0, 2]
    write_plan(tmp_path, content)
    study = read_runs(tmp_path)
    assert [
        [[seed.number for seed in one.seeds] for one in found.trainings]
        for found in study.experiments
    ] == [[[0, 2], [0, 2]], [[0, 1, 2]]]
    assert [len(one.seeds) for one in study.trainings] == [3, 2]


@pytest.mark.parametrize(
    "change",
    [
        {"coverage_each": [0.5] * 99},
        {"baselines": {"random": {"coverage_each": [0.5]}}},
        {"coverage_each": [0.5] * 100, "episodes": None},
    ],
)
def test_single_episodes_are_as_many_as_a_test_has(tmp_path: Path, change: dict[str, Any]) -> None:
    tests = {"random": {"label": "random", "overrides": []}}
    write_plan(tmp_path, plan({}, {"ours": training("ours", "x")}, tests, (0,)))
    write_run(tmp_path, "ours", result(0), [], {"random": scores(0.9) | change})
    file = "trainings/ours/seed_0/tests/random.json"
    refused(tmp_path, file, "coverage_each is not of its episodes; delete the file")
