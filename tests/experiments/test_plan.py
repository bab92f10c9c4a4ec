"""What a study consists of, and what it refuses."""

import json
from pathlib import Path
from typing import Any

import pytest

from tangram_lab.experiments.plan import joined_plan, plan_content
from tangram_sim.errors import ConfigError
from tests.experiments.studies import content, experiment, study

pytestmark = pytest.mark.fast


@pytest.mark.parametrize(
    ("training", "expected"),
    [
        ("square", ["agent=tangram", "a=1", "b=2"]),
        ("paper", ["agent=paper", "a=1", "b=3", "c=1"]),
    ],
)
def test_the_last_word_on_a_setting_counts(
    tmp_path: Path, training: str, expected: list[str]
) -> None:
    config = study(tmp_path)
    assert config.command(training) == expected


def test_trainings_are_wanted_once_and_after_those_that_they_begin_with(tmp_path: Path) -> None:
    assert study(tmp_path).wanted() == ["paper", "square", "warm"]
    only = study(tmp_path, experiments={"two": experiment(["warm"], [])})
    assert only.wanted() == ["square", "warm"]


def test_a_training_has_the_tests_of_all_its_experiments(tmp_path: Path) -> None:
    config = study(tmp_path)
    assert config.tests_of("square") == ["twice", "noisy"]
    assert config.tests_of("paper") == ["twice"]
    only = study(tmp_path, experiments={"two": experiment(["warm"], ["twice"])})
    assert only.tests_of("square") == []


WARM = {"label": "x", "family": "ours", "after": "warm"}
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"jobs": 0}, "jobs must be between 1 and 1024, got 0"),
    ({"experiments": {"x": experiment(["squre"], [])}}, "x: trainings 'squre' is not in the cat"),
    ({"experiments": {"x": experiment(["square"], ["x"])}}, "use twice, noisy"),
    (
        {"experiments": {"x": experiment(["square"], []) | {"kind": "pie"}}},
        "kind must be one of curves, complexity, tests, rewards, ranking, game, got 'pie'",
    ),
    (
        {"experiments": {"x": experiment(["square"], []) | {"labels": {"paper": "x"}}}},
        "labels must be one of square, got 'paper'",
    ),
    ({"tests": {"twice": {"label": "x", "actions": 0}}}, "tests.actions must be between 1 and 100"),
    (
        {"tests": {"noisy": {"label": "x", "corner_noise": 0.5}}},
        "tests.corner_noise must be between 0 and 0.2, got 0.5",
    ),
    ({"families": {"ours": []}}, "training paper: family 'theirs' is not in the catalogue"),
    ({"trainings": {"square": WARM}, "experiments": {}}, "training square: after 'warm' is not in"),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_what_does_not_exist_is_refused(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        study(tmp_path, **changes)


@pytest.mark.parametrize("seeds", [[], [1, 1]])
def test_seeds_are_different(tmp_path: Path, seeds: list[int]) -> None:
    budget = content(tmp_path)["budget"] | {"seeds": seeds}
    with pytest.raises(ConfigError, match="budget.seeds must be different numbers, got"):
        study(tmp_path, budget=budget)


def test_seeds_are_not_negative(tmp_path: Path) -> None:
    budget = content(tmp_path)["budget"] | {"seeds": [0, -1]}
    with pytest.raises(ConfigError, match="budget.seeds must be at least 0, got -1"):
        study(tmp_path, budget=budget)


def test_a_circle_of_warm_starts_is_refused(tmp_path: Path) -> None:
    trainings = {
        "square": WARM,
        "warm": {"label": "x", "family": "ours", "after": "square"},
    }
    circle = study(tmp_path, trainings=trainings, experiments={"x": experiment(["warm"], [])})
    with pytest.raises(ConfigError, match="begins with itself: warm <- square"):
        circle.wanted()


# plan.json


def test_the_plan_says_everything_that_a_report_needs(tmp_path: Path) -> None:
    plan = plan_content(study(tmp_path), {"command": "tangram-experiment x", "commit": "abc"})
    assert (plan["format"], plan["command"], plan["commit"]) == (1, "tangram-experiment x", "abc")
    assert plan["budget"] == {
        "name": "tiny",
        "note": "Nothing is learned.",
        "seeds": [0, 1],
        "test_episodes": 5,
    }
    assert list(plan["experiments"]) == ["one", "two"]
    assert plan["trainings"]["warm"] == {
        "label": "warm",
        "family": "ours",
        "overrides": ["agent=tangram", "a=1", "b=2"],
        "after": "square",
    }
    told = {name: value for name, value in plan["tests"]["noisy"].items() if value is not None}
    assert told == {"label": "1 % noise", "corner_noise": 0.01}


def test_a_plan_keeps_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    first = study(tmp_path, experiments={"one": experiment(["paper"], ["twice"])})
    path.write_text(json.dumps(plan_content(first, {})))
    second = study(tmp_path, experiments={"two": experiment(["square"], ["noisy"])})
    joined = joined_plan(path, plan_content(second, {"commit": "new"}))
    assert joined["commit"] == "new"
    assert list(joined["experiments"]) == ["one", "two"]
    assert list(joined["trainings"]) == ["paper", "square"]
    assert list(joined["tests"]) == ["twice", "noisy"]


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("name", "huge", "was made with budget.name=tiny, now it is huge: choose another run_dir"),
        ("test_episodes", 6, "was made with budget.test_episodes=5, now it is 6"),
    ],
)
def test_another_budget_needs_another_folder(
    tmp_path: Path, name: str, value: Any, message: str
) -> None:
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(plan_content(study(tmp_path), {})))
    budget = content(tmp_path)["budget"] | {name: value}
    with pytest.raises(ConfigError, match=message):
        joined_plan(path, plan_content(study(tmp_path, budget=budget), {}))


@pytest.mark.parametrize(
    ("seeds", "expected"), [([0, 1, 2], [0, 1, 2]), ([0], [0, 1]), ([5, 3], [0, 1, 3, 5])]
)
def test_seeds_may_be_added_and_none_is_forgotten(
    tmp_path: Path, seeds: list[int], expected: list[int]
) -> None:
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(plan_content(study(tmp_path), {})))
    budget = content(tmp_path)["budget"] | {"seeds": seeds}
    joined = joined_plan(path, plan_content(study(tmp_path, budget=budget), {}))
    assert joined["budget"]["seeds"] == expected


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"budget": 1}'])
def test_a_plan_that_cannot_be_read_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "plan.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"cannot read .*plan.json: remove it"):
        joined_plan(path, plan_content(study(tmp_path), {}))
