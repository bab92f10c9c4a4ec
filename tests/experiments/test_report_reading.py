"""Study folders: what is read, what is missing, what is refused."""

import json
from pathlib import Path
from typing import Any

import pytest

from tangram_lab.experiments.report.reading import read_study
from tangram_lab.experiments.report.records import Record, read_records
from tangram_lab.experiments.report.study import Study
from tangram_sim.errors import RunError
from tests.experiments.builders import (
    learning_curve,
    plan,
    result,
    scores,
    write_plan,
    write_run,
    write_study,
)

pytestmark = pytest.mark.fast

RUN = "trainings/paper/seed_0"
BIG = "9" * 5000


def read(folder: Path) -> Study:
    write_study(folder)
    return read_study(folder)


def test_a_study_is_read_with_what_its_runs_have_left(tmp_path: Path) -> None:
    study = read(tmp_path)
    assert (study.budget, study.planned_seeds, study.test_episodes) == ("laptop", (0, 1, 2), 100)
    paper, mlp, ours = study.trainings
    assert [one.name for one in study.experiments[0].trainings] == ["paper", "mlp", "ours"]
    assert [seed.state for seed in paper.seeds] == ["finished"] * 3
    assert [seed.state for seed in mlp.seeds] == ["finished", "finished", "not started"]
    assert [seed.state for seed in ours.seeds] == ["finished", "finished", "not finished"]
    assert paper.values("mean_reward") == {0: 0.758, 1: 0.75, 2: 0.762}
    assert paper.scores("actions_2", "mean_reward") == pytest.approx({0: 0.748, 1: 0.74, 2: 0.752})
    assert paper.tokens == "square"


def test_a_line_that_was_cut_is_no_error_and_the_rest_is_kept(tmp_path: Path) -> None:
    ours = read(tmp_path).trainings[2]
    assert len(ours.seeds[2].curve) == 3
    assert len(ours.finished) == 2


def test_a_run_that_was_stopped_is_not_finished(tmp_path: Path) -> None:
    write_plan(tmp_path, plan({}, {"paper": {**PAPER}}, {}, seeds=(0,)))
    write_run(tmp_path, "paper", result(0, ended_by="SIGINT"), [])
    (training,) = read_study(tmp_path).trainings
    assert training.seeds[0].state == "stopped by SIGINT"
    assert training.finished == ()
    assert training.values("mean_reward") == {}


PAPER = {"label": "MHA", "family": "paper", "overrides": []}


def test_scores_that_nobody_measured_are_left_out(tmp_path: Path) -> None:
    write_plan(tmp_path, plan({}, {"paper": PAPER}, {}, seeds=(0, 1)))
    write_run(tmp_path, "paper", result(0, None, scored_updates=None), [])
    write_run(tmp_path, "paper", result(1, 0.5), [])
    (training,) = read_study(tmp_path).trainings
    assert training.values("mean_reward") == {1: 0.5}
    assert training.values("updates") == {0: 2000, 1: 2000}


def test_names_of_machines_and_their_folders_are_not_read(tmp_path: Path) -> None:
    seed = read(tmp_path).trainings[0].seeds[0]
    assert "host" not in seed.result
    assert "run_dir" not in seed.tests["actions_1"]


# Refused


def test_no_plan(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="plan.json is missing: name a folder that"):
        read_study(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 2}, "its format is 2, but this version reads 1"),
        ({"budget": {}}, "it lacks budget.seeds"),
        ({"budget": []}, "budget must be a mapping, not a list"),
        ({"command": 3}, "command must be a text, got 3"),
        ({"trainings": {"paper": {}}}, "it lacks trainings.paper.label"),
        ({"trainings": {"../x": PAPER}}, "'../x' is no name of"),
        ({"trainings": {}}, "its trainings lack 'paper'"),
        ({"tests": {}}, "its tests lack 'actions_1'"),
    ],
)
def test_a_wrong_plan_is_told_in_one_line(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    write_plan(tmp_path, write_study(tmp_path) | change)
    with pytest.raises(RunError, match=message) as caught:
        read_study(tmp_path)
    assert str(tmp_path / "plan.json") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_unknown_kind(tmp_path: Path) -> None:
    content = write_study(tmp_path)
    content["experiments"]["fig4"]["kind"] = "cake"
    write_plan(tmp_path, content)
    with pytest.raises(RunError, match="unknown kind 'cake'; use one of curves, complexity"):
        read_study(tmp_path)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("plan.json", "{", "it is not JSON (line 1); run its tangram-experiment command"),
        ("plan.json", "[]", "its content must be a mapping, not a list"),
        (f"{RUN}/result.json", '{\n"a": }', "it is not JSON (line 2); delete this folder"),
        (f"{RUN}/result.json", "{}", "it lacks mean_reward; delete this folder"),
        (f"{RUN}/result.json", '{"mean_reward": NaN}', "it is not JSON; delete"),
        (f"{RUN}/result.json", f'{{"mean_reward": {BIG}}}', "it is not JSON; delete"),
        (f"{RUN}/result.json", '{"mean_reward": "0.7"}', "mean_reward must be a number, got '0.7'"),
        (f"{RUN}/result.json", '{"mean_reward": true}', "mean_reward must be a number, got True"),
        (f"{RUN}/result.json", '{"mean_reward": 1e999}', "must be a finite number, got inf"),
        (f"{RUN}/curve.jsonl", "{}\n", "it lacks line 1.updates; delete this folder"),
        (f"{RUN}/curve.jsonl", '{"updates": 1\n', "it is not JSON (line 1)"),
        (f"{RUN}/tests/actions_1.json", "{}", "it lacks mean_reward; delete the file"),
        (
            f"{RUN}/tests/actions_1.json",
            '{"mean_reward": 0.7, "baselines": {"random": 3}}',
            "baselines.random must be a mapping, not a single value",
        ),
        (
            f"{RUN}/tests/actions_1.json",
            '{"mean_reward": 0.7, "baselines": {"random": {"mean_reward": "low"}}}',
            "baselines.random.mean_reward must be a number, got 'low'",
        ),
    ],
)
def test_a_corrupt_file_is_told_in_one_line(
    tmp_path: Path, file: str, text: str, message: str
) -> None:
    write_study(tmp_path)
    (tmp_path / file).write_text(text)
    with pytest.raises(RunError) as caught:
        read_study(tmp_path)
    assert str(caught.value).startswith(f"{tmp_path / file}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_bytes_that_are_no_text(tmp_path: Path) -> None:
    write_study(tmp_path)
    (tmp_path / RUN / "result.json").write_bytes(b"\xff\xfe")
    with pytest.raises(RunError, match="it is not JSON; delete"):
        read_study(tmp_path)


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    write_study(tmp_path)
    (tmp_path / RUN / "tests/actions_1.json").unlink()
    (tmp_path / RUN / "tests/actions_1.json").mkdir()
    with pytest.raises(RunError, match="cannot be read (.*); delete the file"):
        read_study(tmp_path)


@pytest.mark.parametrize("axis", ["updates", "episodes", "train_s"])
def test_a_curve_that_goes_back(tmp_path: Path, axis: str) -> None:
    write_study(tmp_path)
    curve = learning_curve(0, 0.7)
    curve[3][axis] = curve[2][axis] - 0.5
    lines = "".join(json.dumps(point) + "\n" for point in curve)
    (tmp_path / RUN / "curve.jsonl").write_text(lines)
    with pytest.raises(RunError, match="line 4 goes back"):
        read_study(tmp_path)


def test_a_test_of_another_plan_is_not_read(tmp_path: Path) -> None:
    write_study(tmp_path)
    (tmp_path / RUN / "tests/other.json").write_text("no JSON")
    assert "other" not in read_study(tmp_path).trainings[0].seeds[0].tests


@pytest.mark.parametrize("value", [True, -1, 1.5, "1", None])
def test_counts_are_whole_numbers(value: Any) -> None:
    record = Record({"seed": value}, Path("plan.json"), "mend it")
    with pytest.raises(RunError, match="plan.json: seed must be a whole number of at least 0"):
        record.integer("seed")


def test_long_values_are_cut_in_messages() -> None:
    record = Record({"seed": "x" * 100}, Path("plan.json"), "mend it")
    with pytest.raises(RunError, match="got 'x{36}[.]{3}; mend it"):
        record.integer("seed")


def test_an_empty_curve_has_no_points(tmp_path: Path) -> None:
    (tmp_path / "curve.jsonl").write_text("")
    assert read_records(tmp_path / "curve.jsonl", "mend it") == []


def test_scores_without_baselines_are_fine(tmp_path: Path) -> None:
    write_study(tmp_path)
    (tmp_path / RUN / "tests/actions_1.json").write_text(json.dumps(scores(0.5, None)))
    assert read_study(tmp_path).trainings[0].scores("actions_1", "mean_reward")[0] == 0.5
