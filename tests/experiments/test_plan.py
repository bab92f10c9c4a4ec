"""Which trainings and tests a study consists of, what it refuses, and the processes it needs."""

import json
import re
from collections import defaultdict
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml

from tangram_agent.setup import from_mapping
from tangram_lab.experiments import runner
from tangram_lab.experiments.cli import _asked
from tangram_lab.experiments.jobs import Job, make_jobs
from tangram_lab.experiments.plan import StudyConfig, joined_plan, plan_content
from tangram_sim.errors import ConfigError

pytestmark = pytest.mark.fast

ANY: dict[str, dict[str, Any]] = defaultdict(dict)  # the configs of trainings


def content(run_dir: Path, **changes: Any) -> dict[str, Any]:
    """The settings of a study of two experiments that share a training."""
    settings = {
        "run_dir": str(run_dir),
        "budget": {
            "name": "tiny",
            "note": "Nothing is learned.",
            "seeds": [0, 1],
            "main_seeds": [0, 1, 2],
            "test_episodes": 5,
            "test_seed": 2,
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


def test_each_training_is_told_the_last_word_and_comes_once_with_all_its_tests(
    tmp_path: Path,
) -> None:
    config = study(tmp_path)
    assert config.command("square") == ["agent=tangram", "a=1", "b=2"]
    assert config.command("paper") == ["agent=paper", "a=1", "b=3", "c=1"]
    assert config.wanted() == ["paper", "square", "warm"]
    assert config.tests_of("square") == ["twice", "noisy"]
    assert config.tests_of("paper") == ["twice"]
    only = study(tmp_path, experiments={"two": experiment(["warm"], ["twice"])})
    assert only.wanted() == ["square", "warm"]  # what it begins with, before it
    assert only.tests_of("square") == []


WARM = {"label": "x", "family": "ours", "after": "warm"}
BUDGET: dict[str, Any] = {
    "name": "",
    "note": "",
    "seeds": [0],
    "main_seeds": [0],
    "test_episodes": 1,
    "test_seed": 0,
    "overrides": {},
}
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"jobs": 0}, "jobs must be between 1 and 1024, got 0"),
    ({"experiments": {"x": experiment(["squre"], [])}}, "x: trainings 'squre' is not in the cat"),
    ({"experiments": {"x": experiment(["square"], ["x"])}}, "use twice, noisy"),
    (
        {"experiments": {"x": experiment(["square"], []) | {"kind": "pie"}}},
        "kind must be one of curves, complexity, tests, rewards, ranking, game, worlds, got 'pie'",
    ),
    (
        {"experiments": {"x": experiment(["square"], []) | {"labels": {"paper": "x"}}}},
        "labels must be one of square, got 'paper'",
    ),
    ({"families": {"ours": []}}, "training paper: family 'theirs' is not in the catalogue"),
    ({"trainings": {"square": WARM}, "experiments": {}}, "training square: after 'warm' is not in"),
    *(
        ({"budget": BUDGET | change}, text)
        for change, text in (
            ({"seeds": []}, "budget.seeds must be different numbers, got"),
            ({"seeds": [1, 1]}, "budget.seeds must be different numbers, got"),
            ({"seeds": [0, -1]}, "budget.seeds must be between 0 and 9.22337e\\+18, got -1"),
            ({"main_seeds": []}, "budget.main_seeds must be different numbers, got"),
            ({"test_episodes": 0}, "budget.test_episodes must be at least 1, got 0"),
            ({"test_seed": -1}, "budget.test_seed must be at least 0, got -1"),
        )
    ),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_what_does_not_exist_is_refused(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        study(tmp_path, **changes)


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
    resolved = defaultdict(dict, warm={"sim": {"arena": 2.0}, "run_dir": "x", "workers": 1})
    source = {"command": "tangram-experiment x", "commit": "abc"}
    plan = plan_content(study(tmp_path), source, resolved)
    assert (plan["format"], plan["command"], plan["commit"]) == (4, "tangram-experiment x", "abc")
    texts = {"name": "tiny", "note": "Nothing is learned."}
    assert plan["budget"] == {**texts, "test_episodes": 5, "test_seed": 2}
    assert list(plan["experiments"]) == ["one", "two"]
    assert plan["trainings"]["warm"] == {
        "settings": {"sim": {"arena": 2.0}, "workers": 1},
        "label": "warm",
        "family": "ours",
        "overrides": ["agent=tangram", "a=1", "b=2"],
        "after": "square",
        "seeds": [0, 1],
    }
    told = {"label": "1 % noise", "overrides": ("sim.corner_noise=0.01",)}
    assert plan["tests"]["noisy"] == told


def joined(folder: Path, earlier: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """The plan of a study with changes, in a folder whose plan is an earlier one."""
    path = folder / "plan.json"
    path.write_text(json.dumps(earlier))
    return joined_plan(path, plan_content(study(folder, **changes), {"commit": "new"}, ANY))


def test_a_plan_keeps_what_was_there(tmp_path: Path) -> None:
    first = study(tmp_path, experiments={"one": experiment(["paper"], ["twice"])})
    second = {"two": experiment(["square"], ["noisy"])}
    found = joined(tmp_path, plan_content(first, {}, ANY), experiments=second)
    assert found["commit"] == "new"
    assert list(found["experiments"]) == ["one", "two"]
    assert list(found["trainings"]) == ["paper", "square"]
    assert list(found["tests"]) == ["twice", "noisy"]


@pytest.mark.parametrize(
    ("earlier", "budget", "message"),
    [
        ({}, {"name": "huge"}, "was made with budget.name=tiny, now it is huge: choose another"),
        ({}, {"test_episodes": 6}, "was made with budget.test_episodes=5, now it is 6"),
        ({}, {"test_seed": 0}, "was made with budget.test_seed=2, now it is 0"),
        ({"format": 2}, {}, "is of format 2, and this version writes 4: choose another run_dir"),
    ],
)
def test_another_budget_or_version_needs_another_folder(
    tmp_path: Path, earlier: dict[str, Any], budget: dict[str, Any], message: str
) -> None:
    before = plan_content(study(tmp_path), {}, ANY) | earlier
    with pytest.raises(ConfigError, match=message):
        joined(tmp_path, before, budget=content(tmp_path)["budget"] | budget)


@pytest.mark.parametrize(
    "damage",
    [
        {"trainings": {"tangram": []}},
        {"trainings": {"tangram": {}}},
        {"trainings": {"tangram": {"seeds": None}}},
        {"trainings": {"tangram": {"seeds": ["a"]}}},
        {"trainings": {"tangram": {"seeds": [float("inf")]}}},
        {"fingerprints": {"tangram": 5}},
        {"fingerprints": {"tangram": {"weights": "abc"}}},
        {"tests": None},
        {"budget": 3},
    ],
)
def test_a_damaged_plan_is_told(tmp_path: Path, damage: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="cannot read .*plan.json: remove it, or choose"):
        joined(tmp_path, plan_content(study(tmp_path), {}, ANY) | damage)


@pytest.mark.parametrize(
    ("seeds", "expected"), [([0, 1, 2], [0, 1, 2]), ([0], [0, 1]), ([5, 3], [0, 1, 3, 5])]
)
def test_seeds_may_be_added_and_none_is_forgotten(
    tmp_path: Path, seeds: list[int], expected: list[int]
) -> None:
    budget = content(tmp_path)["budget"] | {"seeds": seeds}
    found = joined(tmp_path, plan_content(study(tmp_path), {}, ANY), budget=budget)
    assert {tuple(one["seeds"]) for one in found["trainings"].values()} == {tuple(expected)}


def test_what_readme_shows_has_the_main_seeds_and_what_it_begins_with_too(tmp_path: Path) -> None:
    main = experiment(["warm"], ["noisy"]) | {"main": True}
    config = study(tmp_path, experiments={"one": experiment(["square"], ["twice"]), "two": main})
    assert (config.seeds("square"), config.seeds("warm")) == ([0, 1, 2], [0, 1, 2])
    assert (config.tests_of("square", 0), config.tests_of("square", 2)) == (["twice"], [])
    assert config.tests_of("warm", 2) == ["noisy"]


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"budget": 1}', "[" * 100_000])
def test_a_plan_that_cannot_be_read_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "plan.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"cannot read .*plan.json: remove it"):
        joined_plan(path, plan_content(study(tmp_path), {}, ANY))


# Processes


def resolved(config: StudyConfig, **changes: Any) -> dict[str, dict[str, Any]]:
    """A config for each training, as far as jobs look at it."""
    agent = {"gamma": 0.0, "hindsight": [{"strategy": "final"}]}
    return {name: {"agent": agent, "max_updates": 3} | changes for name in config.wanted()}


@cache
def _composed(name: str, overrides: tuple[str, ...]) -> dict[str, Any]:
    return _asked(name, list(overrides))


def asked(config: StudyConfig) -> dict[str, dict[str, Any]]:
    """What tests ask for, as tangram-experiment composes it."""
    return {name: _composed(name, tuple(config.test_command(name))) for name in config.tests}


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


def test_each_job_is_a_command(tmp_path: Path) -> None:
    jobs, trainings = jobs_of(tmp_path), tmp_path / "trainings"
    run_dir = trainings / "warm" / "seed_1"
    job, source = jobs["warm, seed 1"], trainings / "square" / "seed_1"
    head = ("train", f"run_dir='{run_dir}'", "seed=1", "resume=auto")
    assert job.command == (*head, "agent=tangram", "a=1", "b=2", f"warm_start='{source}'")
    assert (job.run_dir, job.leaves) == (run_dir, run_dir / "result.json")
    assert (job.log, job.settings["max_updates"]) == (run_dir / "training.log", 3)
    assert jobs["paper, seed 1"].command[4:] == ("agent=paper", "a=1", "b=3", "c=1")
    # It waits for what it begins with.
    assert jobs["paper, seed 1"].needs is None
    assert job.needs is jobs["square, seed 1"]
    assert not job.ready
    end(source / "result.json")
    assert job.ready
    for test, setting in (("twice", "sim.actions_per_token=2"), ("noisy", "sim.corner_noise=0.01")):
        trial, out = jobs[f"warm, seed 1, test {test}"], run_dir / "tests" / f"{test}.json"
        head = ("eval", f"run_dir='{run_dir}'", f"out='{out}'", "episodes=5", "seed=2")
        assert trial.command == (*head, setting)
        assert (trial.needs, trial.leaves, trial.trains) == (job, out, False)
        assert trial.log == run_dir / "tests.log"


def test_trainings_are_told_where_ones_own_presets_lie(tmp_path: Path) -> None:
    config = study(tmp_path)
    jobs = make_jobs(config, resolved(config), asked(config), "/mine")
    assert {job.command[1] for job in jobs if job.trains} == {"--config-dir=/mine"}
    assert all("--config-dir=/mine" not in job.command for job in jobs_of(tmp_path).values())


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


RANDOM = {
    "sim": {"actions_per_token": 2, "arena": 2.0},
    "episodes": 5,
    "test_seed": 2,
    "updates": 3,
}
# Under `puzzles` a test's file has the scores of each.
FIGURES = {
    "puzzle": ["test"],
    "turns": 8,
    "test_seed": 2,
    "updates": 3,
    "puzzles": [{"name": "cat"}],
}


@pytest.mark.parametrize(
    ("told", "changes", "done"),
    [
        (RANDOM, {}, True),
        (RANDOM, {"mean_reward": 0.5}, True),
        (RANDOM, {"sim": {"actions_per_token": 3}}, False),
        (RANDOM, {"sim": None}, False),
        (RANDOM, {"episodes": 6}, False),
        (RANDOM, {"test_seed": 0}, False),
        (RANDOM, {"updates": 2}, False),
        (FIGURES, {}, True),
        (FIGURES, {"puzzle": ["train"]}, False),
        (FIGURES, {"turns": 1}, False),
    ],
)
def test_a_test_is_done_when_it_is_that_of_the_final_weights(
    tmp_path: Path, told: dict[str, Any], changes: dict[str, Any], done: bool
) -> None:
    overrides = ["puzzle=test", "turns=8"] if told is FIGURES else ["sim.actions_per_token=2"]
    tests = {"it": {"label": "it", "overrides": overrides}}
    one = {"one": experiment(["square"], ["it"])}
    job = jobs_of(tmp_path, tests=tests, experiments=one)["square, seed 0, test it"]
    assert job.command[-len(overrides) :] == tuple(overrides)
    end(job.run_dir / "result.json")
    job.prepare()
    assert not job.done
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
    ("override", "message"),
    [
        ("actions=2", "unknown setting 'actions'"),
        ("sim.actions_per_tokn=2", ".* .did you mean 'sim.actions_per_token'"),
        (
            "agent.reapply=0 puzzle=test sim.targets=mixed",
            "sim.targets=mixed changes nothing with",
        ),
    ],
)
def test_a_wrong_test_is_told_before_all_trainings(
    tmp_path: Path, override: str, message: str
) -> None:
    odd = {"odd": {"label": "x", "overrides": override.split()}}
    config = study(tmp_path, tests=odd, experiments={})
    with pytest.raises(ConfigError, match=f"test odd: {message}"):
        asked(config)


@pytest.mark.parametrize(
    ("before", "told"),
    [
        ({}, None),
        ({"a": {"weights": 100.00005, "reward": 0.5}}, None),
        ({"b": {"weights": 7.0, "reward": 0.5}}, None),  # another one's
        (
            {"a": {"weights": 101.0, "reward": 0.5}},
            "/trainings/a is of code that trained otherwise: after 20 updates weights is 100.0, "
            "and was 101.0: remove ",
        ),
        ({"a": {"weights": 100.0}}, "reward is 0.5, and was None"),
    ],
)
def test_seeds_of_a_training_are_of_code_that_trains_alike(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, before: dict[str, Any], told: str | None
) -> None:
    """Where some of them are there."""
    now = {"weights": 100.0, "reward": 0.5}
    monkeypatch.setattr(runner, "make_fingerprints", lambda found: dict.fromkeys(found, now))
    assert runner._fingerprints(before, {"a": {}}, tmp_path) == {"a": now}
    (tmp_path / "trainings" / "a" / "seed_0").mkdir(parents=True)
    if told is None:
        assert runner._fingerprints(before, {"a": {}}, tmp_path) == {"a": now}
    else:
        with pytest.raises(ConfigError, match=re.escape(told)):
            runner._fingerprints(before, {"a": {}}, tmp_path)
