"""Which processes a study needs, and when one is done."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from tangram_lab.experiments.jobs import Job, make_jobs
from tangram_lab.experiments.plan import StudyConfig
from tangram_sim.errors import ConfigError
from tests.experiments.studies import experiment, study

pytestmark = pytest.mark.fast


def resolved(config: StudyConfig, **changes: Any) -> dict[str, dict[str, Any]]:
    """A config for each training, as far as jobs look at it."""
    agent = {"gamma": 0.0, "hindsight": [{"strategy": "final"}]}
    return {name: {"agent": agent, "max_updates": 3} | changes for name in config.wanted()}


def jobs_of(folder: Path, **changes: Any) -> dict[str, Job]:
    config = study(folder, **changes)
    return {job.name: job for job in make_jobs(config, resolved(config))}


def test_all_trainings_of_a_seed_come_before_the_next_seed(tmp_path: Path) -> None:
    assert list(jobs_of(tmp_path)) == [
        "paper, seed 0",
        "paper, seed 0, test twice",
        "square, seed 0",
        "square, seed 0, test twice",
        "square, seed 0, test noisy",
        "warm, seed 0",
        "warm, seed 0, test twice",
        "warm, seed 0, test noisy",
        "paper, seed 1",
        "paper, seed 1, test twice",
        "square, seed 1",
        "square, seed 1, test twice",
        "square, seed 1, test noisy",
        "warm, seed 1",
        "warm, seed 1, test twice",
        "warm, seed 1, test noisy",
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


def test_a_warm_start_waits_for_its_source(tmp_path: Path) -> None:
    jobs = jobs_of(tmp_path)
    job, source = jobs["warm, seed 1"], tmp_path / "trainings" / "square" / "seed_1"
    assert job.command[-1] == f"warm_start='{source}'"
    assert job.needs is jobs["square, seed 1"]
    assert not job.ready
    end(source / "result.json", "max_updates=3")
    assert job.ready


@pytest.mark.parametrize(
    ("test", "setting"), [("twice", "actions=2"), ("noisy", "corner_noise=0.01")]
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
        ({"actions": 3}, False),
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
    job.leaves.write_text(json.dumps({"actions": 2, "episodes": 5, "updates": 3} | changes))
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
    job = make_jobs(config, resolved(config))[0]
    job.check()
    job.prepare()
    job.check()
    (job.run_dir / "config.yaml").write_text(yaml.safe_dump(dict(job.settings)))
    changed = make_jobs(config, resolved(config, **changes))[0]
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
    tests = {"figures": {"label": "figures", "puzzles": "test", "turns": 8}}
    one = {"one": experiment(["square"], ["figures"])}
    job = jobs_of(tmp_path, tests=tests, experiments=one)["square, seed 0, test figures"]
    assert job.command[-2:] == ("puzzles=test", "turns=8")
    end(job.run_dir / "result.json")
    job.prepare()
    told = {"source": "test", "turns": 8, "updates": 3, "puzzles": [{"name": "cat"}]}
    job.leaves.write_text(json.dumps(told | changes))
    assert job.done is done
