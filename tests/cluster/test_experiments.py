"""A whole study through the commands: trained, tested, stopped, continued, reported."""

import json
import signal
import subprocess
import time
from pathlib import Path

import pytest

from tangram_agent.checkpoints import list_checkpoints, load_checkpoint
from tests.cluster.processes import (
    LIMIT_S,
    all_ended,
    pids_of,
    refused,
    run,
    run_here,
    started,
    wait_for_file,
)

pytestmark = pytest.mark.cluster

SMALL = ("experiment=[table2]", "budget=smoke", "experiments.table2.tests=[actions_2]")
ONE, RUN = ("experiments.table2.trainings=[tangram]",), "trainings/tangram/seed_0"
LONG = "budget.overrides.tangram=['max_updates=1000000']"


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of Table II with the smoke budget and one test."""
    folder = tmp_path_factory.mktemp("experiments") / "study"
    told = run("tangram-experiment", *SMALL, f"run_dir={folder}", cwd=folder.parent)
    first = "a fingerprint of this code first: 20 updates of each of 2 trainings\n"
    assert told.startswith(f"{first}0 of 4 jobs were done before\n")
    assert "\n[4/4] " in told
    return folder


def scores(study: Path, training: str) -> tuple[dict[str, float], dict[str, float]]:
    """Those of a training and of its test."""
    run_dir = study / "trainings" / training / "seed_0"
    files = (run_dir / "result.json", run_dir / "tests" / "actions_2.json")
    result, test = (json.loads(path.read_text()) for path in files)
    return result, test


def wait_for_updates(run_dir: Path, beyond: int, process: subprocess.Popen[bytes]) -> None:
    """Wait until the learning curve of a run tells of more updates than these."""
    curve, end = run_dir / "curve.jsonl", time.monotonic() + LIMIT_S
    wait_for_file(curve, process)
    while all(json.loads(line)["updates"] <= beyond for line in curve.read_text().split("\n")[:-1]):
        assert process.poll() is None, f"the process ended before {curve} told of {beyond} updates"
        assert time.monotonic() < end, f"no more than {beyond} updates after {LIMIT_S} s"
        time.sleep(0.05)


def test_every_training_is_done_and_tested(study: Path) -> None:
    for training in ("paper", "tangram"):
        result, test = scores(study, training)
        assert (result["updates"], result["agent"], result["seed"]) == (20, training, 0)
        assert (test["sim"]["actions_per_token"], test["episodes"], test["updates"]) == (2, 16, 20)
        assert None not in (result["mean_reward"], result["mean_reward_dense"])


def test_what_is_done_is_skipped(study: Path) -> None:
    def times() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in study.rglob("*.json")}

    before = times()
    told = run_here("tangram-experiment", *SMALL, f"run_dir={study}", cwd=study.parent)
    assert told == "4 of 4 jobs were done before\n"
    assert {path for path, when in times().items() if before[path] != when} == {study / "plan.json"}


def test_other_settings_are_refused(study: Path) -> None:
    line = refused("tangram-experiment", *SMALL, LONG, f"run_dir={study}", cwd=study.parent)
    assert "tangram/seed_0 was trained with other settings" in line
    assert "max_updates=20, now 1000000" in line


def test_a_report_is_drawn(study: Path, tmp_path: Path) -> None:
    run_here("tangram-report", f"runs={study}", f"out={tmp_path / 'report'}", cwd=tmp_path)
    text = (tmp_path / "report" / "tables.md").read_text()
    result, test = scores(study, "tangram")
    assert f"| MHA (tangram) | 1 of 1 | {test['mean_reward']:.3f} |" in text
    assert result["host"] not in text
    for name in ("fig1_puzzle", "fig3_camera"):
        assert (tmp_path / "report" / "figures" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert "<svg" in (tmp_path / "report" / "figures" / f"{name}.svg").read_text()


def test_runs_of_an_earlier_report_are_not_made_again(study: Path, tmp_path: Path) -> None:
    first, again, anew = tmp_path / "first", tmp_path / "again", tmp_path / "anew"
    run_here("tangram-report", f"runs={study}", f"out={first}", cwd=tmp_path)
    arguments = (*SMALL, f"run_dir={anew}", f"keep={first}")
    listed = run_here("tangram-experiment", *arguments, "dry=true", cwd=tmp_path)
    assert listed.endswith(f"\n0 of 4 jobs to do in {anew}\n")
    assert not anew.exists()
    told = run_here("tangram-experiment", *arguments, cwd=tmp_path)
    kept = "2 runs are kept of the earlier report\n4 of 4 jobs were done before\n"
    assert told.endswith(f"\n{kept}")
    run_here("tangram-report", f"runs={anew}", f"out={again}", cwd=tmp_path)
    one, other = (json.loads((out / "data.json").read_text()) for out in (first, again))
    assert one["runs"] == other["runs"]
    assert one["plan"]["fingerprints"] == other["plan"]["fingerprints"]
    line = refused("tangram-experiment", *SMALL, "keep=nowhere", f"run_dir={again}", cwd=tmp_path)
    assert "nowhere/data.json: cannot be read" in line


def test_no_training_outlives_its_study_and_the_same_command_goes_on_until_a_signal(
    tmp_path: Path,
) -> None:
    study = tmp_path / "study"
    arguments = (*SMALL, *ONE, LONG, f"run_dir={study}")
    run_dir = study / RUN
    with started("tangram-experiment", *arguments, cwd=tmp_path) as process:
        wait_for_updates(run_dir, 0, process)
        run_id = json.loads((run_dir / "connection.json").read_text())["run_id"]
        children = [pid for pid in pids_of(study) if pid != process.pid]
        assert len(children) >= 3
        process.kill()
        assert all_ended(children)
    reached = load_checkpoint(list_checkpoints(run_dir / "checkpoints")[-1], []).updates

    listed = run_here("tangram-experiment", *arguments, "dry=true", cwd=tmp_path)
    assert listed.splitlines()[:2] == ["tangram, seed 0", "tangram, seed 0, test actions_2"]
    (run_dir / "curve.jsonl").rename(tmp_path / "curve.jsonl")
    with started("tangram-experiment", *arguments, cwd=tmp_path) as process:
        wait_for_updates(run_dir, reached, process)
        children = pids_of(study)
        process.send_signal(signal.SIGINT)
        assert process.wait(LIMIT_S) == 130
        assert all_ended(children)
    done = json.loads((run_dir / "result.json").read_text())
    assert done["ended_by"].startswith("SIG")
    assert done["updates"] > reached
    assert done["run_id"] == run_id


def test_wrong_settings_are_told_before_anything_starts(tmp_path: Path) -> None:
    arguments = (*SMALL, f"run_dir={tmp_path / 'study'}")
    wrong = "families.paper=['agent=paper','net.heads=3']"
    line = refused("tangram-experiment", *arguments, wrong, cwd=tmp_path)
    assert "training paper: net.width must be a multiple of net.heads, got 32 and 3" in line
    line = refused("tangram-experiment", *arguments, "families.paper=['agnt=x']", cwd=tmp_path)
    assert "training paper: unknown setting 'agnt' (did you mean 'agent'?)" in line
    assert not (tmp_path / "study").exists()


def test_a_training_that_fails_is_told_and_the_others_go_on(tmp_path: Path) -> None:
    arguments = (
        *SMALL,
        f"run_dir={tmp_path / 'study'}",
        "families.paper=['agent=paper','agent.actor_lr=1000.0']",
        "experiments.table2.tests=[]",
    )
    with pytest.raises(AssertionError) as failure:
        run("tangram-experiment", *arguments, cwd=tmp_path)
    told = str(failure.value)
    assert "times in a row, so the run ends" in told
    assert "/2] tangram, seed 0: mean reward" in told
    assert "paper, seed 0: failed, see" in told
