"""Which processes a study needs, and when one is done."""

import json
from pathlib import Path
from typing import Any

import pytest

from experiments.jobs import Job, finished, make_jobs, settings_file
from tangram_sim.errors import ConfigError
from tests.experiments.studies import study

pytestmark = pytest.mark.fast


def jobs_of(folder: Path, **changes: Any) -> dict[str, Job]:
    return {job.name: job for job in make_jobs(study(folder, **changes))}


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
        *("tangram-train", f"run_dir='{run_dir}'", "seed=1", "resume=auto"),
        *("agent=paper", "a=1", "b=3", "c=1"),
    )
    assert (job.run_dir, job.leaves, job.needs) == (run_dir, run_dir / "result.json", ())
    assert job.log == run_dir / "training.log"


def test_a_warm_start_waits_for_its_source(tmp_path: Path) -> None:
    job = jobs_of(tmp_path)["warm, seed 1"]
    source = tmp_path / "trainings" / "square" / "seed_1"
    assert job.command[-1] == f"warm_start='{source}'"
    assert job.needs == (source / "result.json",)
    assert not job.ready
    end(source / "result.json", "max_updates=3")
    assert job.ready


@pytest.mark.parametrize(
    ("test", "setting"), [("twice", "actions=2"), ("noisy", "corner_noise=0.01")]
)
def test_a_test_follows_its_training(tmp_path: Path, test: str, setting: str) -> None:
    job = jobs_of(tmp_path)[f"square, seed 0, test {test}"]
    run_dir = tmp_path / "trainings" / "square" / "seed_0"
    out = run_dir / "tests" / f"{test}.json"
    assert job.command == (
        *("tangram-eval", f"run_dir='{run_dir}'", f"out='{out}'", "episodes=5"),
        setting,
    )
    assert (job.needs, job.leaves) == ((run_dir / "result.json",), out)


def end(path: Path, ended_by: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"ended_by": ended_by}))


@pytest.mark.parametrize(
    ("ended_by", "done"),
    [
        ("max_updates=3", True),
        ("max_episodes=8", True),
        ("max_hours=1.0", True),
        ("SIGTERM", False),
    ],
)
def test_a_training_is_done_when_its_budget_ended_it(
    tmp_path: Path, ended_by: str, done: bool
) -> None:
    end(tmp_path / "result.json", ended_by)
    assert finished(tmp_path / "result.json") is done


@pytest.mark.parametrize("text", [None, "", "[]", '{"ended_by": 3}', '{"ended_by"', "\xff"])
def test_what_cannot_be_read_is_not_done(tmp_path: Path, text: str | None) -> None:
    path = tmp_path / "result.json"
    if text is not None:
        path.write_text(text, encoding="latin-1")
    assert not finished(path)


def test_a_test_is_done_when_its_scores_are_there(tmp_path: Path) -> None:
    path = tmp_path / "twice.json"
    assert not finished(path)
    path.write_text('{"mean_reward": 0.5}')
    assert finished(path)


def test_other_settings_in_the_same_folder_are_refused(tmp_path: Path) -> None:
    job = jobs_of(tmp_path)["paper, seed 0"]
    job.check()
    job.prepare()
    job.check()
    (job.run_dir / "config.yaml").touch()
    job.check()
    settings_file(job.run_dir).write_text(json.dumps({"overrides": [*job.command[4:-1], "c=2"]}))
    with pytest.raises(ConfigError, match=r"trained with other settings \(c=1, c=2\): remove it"):
        job.check()


def test_a_training_that_never_began_may_change(tmp_path: Path) -> None:
    job = jobs_of(tmp_path)["paper, seed 0"]
    job.prepare()
    settings_file(job.run_dir).write_text('{"overrides": ["typo=1"]}')
    job.check()
