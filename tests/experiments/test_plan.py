"""Which trainings and tests a study consists of, what it refuses, and the processes it needs."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from tangram_agent.setup import from_mapping
from tangram_lab.experiments.cli import _asked
from tangram_lab.experiments.jobs import Job, make_jobs
from tangram_lab.experiments.plan import StudyConfig, joined_plan, plan_content
from tangram_sim.errors import ConfigError

pytestmark = pytest.mark.fast


def content(run_dir: Path, **changes: Any) -> dict[str, Any]:
    """The settings of a study of two experiments that share a training."""
    settings = {
        "run_dir": str(run_dir),
        "budget": {
            "name": "tiny",
            "note": "Nothing is learned.",
            "seeds": [0, 1],
            "test_episodes": 5,
            "overrides": {"all": ["a=1", "b=1"], "ours": ["b=2"]},
        },
        "families": {"ours": ["agent=tangram"], "theirs": ["agent=paper"]},
        "trainings": {
            "square": {"label": "square", "family": "ours"},
            "paper": {"label": "paper", "family": "theirs", "overrides": ["b=3", "c=1"]},
            "warm": {"label": "warm", "family": "ours", "after": "square"},
        },
        "tests": {
            "twice": {"label": "2 actions", "overrides": ["sim.actions_per_token=2"]},
            "noisy": {"label": "1 % noise", "overrides": ["sim.corner_noise=0.01"]},
        },
        "experiments": {
            "one": experiment(["paper", "square"], ["twice"]),
            "two": experiment(["square", "warm"], ["twice", "noisy"]),
        },
    }
    return settings | changes


def experiment(trainings: list[str], tests: list[str]) -> dict[str, Any]:
    """A table of these trainings and tests."""
    texts = {"title": "A title", "source": "Table I", "note": "A note.", "kind": "tests"}
    return texts | {"trainings": trainings, "tests": tests}


def study(run_dir: Path, **changes: Any) -> StudyConfig:
    """The study as tangram-experiment would make it."""
    return from_mapping(StudyConfig, content(run_dir, **changes))


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
    ({"families": {"ours": []}}, "training paper: family 'theirs' is not in the catalogue"),
    ({"trainings": {"square": WARM}, "experiments": {}}, "training square: after 'warm' is not in"),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_what_does_not_exist_is_refused(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        study(tmp_path, **changes)


@pytest.mark.parametrize(
    ("seeds", "message"),
    [
        ([], "must be different numbers, got"),
        ([1, 1], "must be different numbers, got"),
        ([0, -1], "must be at least 0, got -1"),
    ],
)
def test_seeds_are_different_and_not_negative(
    tmp_path: Path, seeds: list[int], message: str
) -> None:
    budget = content(tmp_path)["budget"] | {"seeds": seeds}
    with pytest.raises(ConfigError, match=f"budget.seeds {message}"):
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
    assert (plan["format"], plan["command"], plan["commit"]) == (2, "tangram-experiment x", "abc")
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
    told = {"label": "1 % noise", "overrides": ("sim.corner_noise=0.01",)}
    assert plan["tests"]["noisy"] == told


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


def test_a_plan_of_another_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(plan_content(study(tmp_path), {}) | {"format": 1}))
    with pytest.raises(ConfigError, match="is of format 1, and this version writes 2: choose"):
        joined_plan(path, plan_content(study(tmp_path), {}))


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"budget": 1}'])
def test_a_plan_that_cannot_be_read_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "plan.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"cannot read .*plan.json: remove it"):
        joined_plan(path, plan_content(study(tmp_path), {}))


# Processes


def resolved(config: StudyConfig, **changes: Any) -> dict[str, dict[str, Any]]:
    """A config for each training, as far as jobs look at it."""
    agent = {"gamma": 0.0, "hindsight": [{"strategy": "final"}]}
    return {name: {"agent": agent, "max_updates": 3} | changes for name in config.wanted()}


def asked(config: StudyConfig) -> dict[str, dict[str, Any]]:
    """What tests ask for, as tangram-experiment composes it."""
    return {name: _asked(name, config.test_command(name)) for name in config.tests}


def jobs_of(folder: Path, **changes: Any) -> dict[str, Job]:
    config = study(folder, **changes)
    return {job.name: job for job in make_jobs(config, resolved(config), asked(config))}


def test_all_trainings_of_a_seed_come_before_the_next_seed(tmp_path: Path) -> None:
    twice, both = ("", ", test twice"), ("", ", test twice", ", test noisy")
    assert list(jobs_of(tmp_path)) == [
        f"{name}, seed {seed}{test}"
        for seed in (0, 1)
        for name, tests in (("paper", twice), ("square", both), ("warm", both))
        for test in tests
    ]


def test_a_training_is_a_command_that_can_go_on(tmp_path: Path) -> None:
    job = jobs_of(tmp_path)["paper, seed 1"]
    run_dir = tmp_path / "trainings" / "paper" / "seed_1"
    assert job.command == (
        *("train", f"run_dir='{run_dir}'", "seed=1", "resume=auto"),
        *("agent=paper", "a=1", "b=3", "c=1"),
    )
    assert (job.run_dir, job.leaves, job.needs) == (run_dir, run_dir / "result.json", None)
    assert job.settings["max_updates"] == 3
    assert job.log == run_dir / "training.log"


def test_trainings_are_told_where_ones_own_presets_lie(tmp_path: Path) -> None:
    config = study(tmp_path)
    jobs = make_jobs(config, resolved(config), asked(config), "/mine")
    trainings = [job for job in jobs if job.trains]
    assert {job.command[1] for job in trainings} == {"--config-dir=/mine"}
    assert all("--config-dir=/mine" not in job.command for job in jobs_of(tmp_path).values())


def test_a_warm_start_waits_for_its_source(tmp_path: Path) -> None:
    jobs = jobs_of(tmp_path)
    job, source = jobs["warm, seed 1"], tmp_path / "trainings" / "square" / "seed_1"
    assert job.command[-1] == f"warm_start='{source}'"
    assert job.needs is jobs["square, seed 1"]
    assert not job.ready
    end(source / "result.json", "max_updates=3")
    assert job.ready


@pytest.mark.parametrize(
    ("test", "setting"), [("twice", "sim.actions_per_token=2"), ("noisy", "sim.corner_noise=0.01")]
)
def test_a_test_follows_its_training(tmp_path: Path, test: str, setting: str) -> None:
    jobs = jobs_of(tmp_path)
    job = jobs[f"square, seed 0, test {test}"]
    run_dir = tmp_path / "trainings" / "square" / "seed_0"
    out = run_dir / "tests" / f"{test}.json"
    assert job.command == (
        *("eval", f"run_dir='{run_dir}'", f"out='{out}'", "episodes=5"),
        setting,
    )
    assert job.needs is jobs["square, seed 0"]
    assert (job.leaves, job.trains) == (out, False)


def end(path: Path, ended_by: str = "max_updates=3", updates: int = 3, scored: Any = 3) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"ended_by": ended_by, "updates": updates, "scored_updates": scored}
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("ended_by", "scored", "done"),
    [
        ("max_updates=3", 3, True),
        ("max_episodes=8", 3, True),
        ("max_hours=1.0", 3, True),
        ("SIGTERM", 3, False),
        ("max_updates=3", 2, False),
        ("max_updates=3", None, False),
        (3, 3, False),
    ],
)
def test_a_training_is_done_when_its_final_weights_are_scored(
    tmp_path: Path, ended_by: str, scored: int | None, done: bool
) -> None:
    job = jobs_of(tmp_path)["paper, seed 0"]
    end(job.leaves, ended_by, scored=scored)
    assert job.done is done


@pytest.mark.parametrize("text", [None, "", "[]", '{"ended_by": 3}', '{"ended_by"', "\xff"])
def test_what_cannot_be_read_is_not_done(tmp_path: Path, text: str | None) -> None:
    for job in list(jobs_of(tmp_path).values())[:2]:
        job.prepare()
        if text is not None:
            job.leaves.write_text(text, encoding="latin-1")
        assert not job.done


@pytest.mark.parametrize(
    ("changes", "done"),
    [
        ({}, True),
        ({"mean_reward": 0.5}, True),
        ({"sim": {"actions_per_token": 3}}, False),
        ({"sim": None}, False),
        ({"episodes": 6}, False),
        ({"updates": 2}, False),
    ],
)
def test_a_test_is_done_when_it_is_that_of_the_final_weights(
    tmp_path: Path, changes: dict[str, Any], done: bool
) -> None:
    job = jobs_of(tmp_path)["square, seed 0, test twice"]
    end(job.run_dir / "result.json")
    job.prepare()
    assert not job.done
    told = {"sim": {"actions_per_token": 2, "arena": 2.0}, "episodes": 5, "updates": 3}
    job.leaves.write_text(json.dumps(told | changes))
    assert job.done is done


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, None),
        ({"max_updates": 4}, "max_updates=3, now 4"),
        ({"agent": {"gamma": 0.5}}, "agent.gamma=0.0, now 0.5"),
        ({"agent": {"hindsight": []}}, r"agent.hindsight=.*, now \[\]"),
        ({"agent": {"newer": 1}, "service": {"envs": 1}}, None),
    ],
)
def test_other_settings_in_the_same_folder_are_refused(
    tmp_path: Path, changes: dict[str, Any], message: str | None
) -> None:
    config = study(tmp_path)
    job = make_jobs(config, resolved(config), asked(config))[0]
    job.check()
    job.prepare()
    job.check()
    (job.run_dir / "config.yaml").write_text(yaml.safe_dump(dict(job.settings)))
    changed = make_jobs(config, resolved(config, **changes), asked(config))[0]
    if message is None:
        changed.check()
        return
    with pytest.raises(ConfigError, match=f"was trained with other settings .{message}.: remove"):
        changed.check()


@pytest.mark.parametrize(
    ("changes", "done"), [({}, True), ({"source": "train"}, False), ({"turns": 1}, False)]
)
def test_a_test_of_puzzles_is_known_by_their_source(
    tmp_path: Path, changes: dict[str, Any], done: bool
) -> None:
    """Under `puzzles` its file has the scores of each."""
    tests = {"figures": {"label": "figures", "overrides": ["puzzles=test", "turns=8"]}}
    one = {"one": experiment(["square"], ["figures"])}
    job = jobs_of(tmp_path, tests=tests, experiments=one)["square, seed 0, test figures"]
    assert job.command[-2:] == ("puzzles=test", "turns=8")
    end(job.run_dir / "result.json")
    job.prepare()
    told = {"source": "test", "turns": 8, "updates": 3, "puzzles": [{"name": "cat"}]}
    job.leaves.write_text(json.dumps(told | changes))
    assert job.done is done


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("actions=2", "unknown setting 'actions'"),
        ("sim.actions_per_tokn=2", ".* .did you mean 'sim.actions_per_token'"),
        (
            "agent.reapply=0 puzzles=test sim.targets=mixed",
            "sim.targets=mixed changes nothing with",
        ),
    ],
)
def test_a_wrong_test_is_told_before_all_trainings(
    tmp_path: Path, override: str, message: str
) -> None:
    config = study(
        tmp_path, tests={"odd": {"label": "x", "overrides": override.split()}}, experiments={}
    )
    with pytest.raises(ConfigError, match=f"test odd: {message}"):
        asked(config)
