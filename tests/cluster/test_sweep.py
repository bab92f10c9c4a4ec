"""Sweeps: what they read, and what is heard of a job that fails."""

import json
from pathlib import Path

import pytest

from tests.cluster.processes import BIN, ended, run

pytestmark = pytest.mark.cluster


def test_a_job_that_is_refused_is_heard_of(tmp_path: Path) -> None:
    overrides = ("--multirun", "seed=3,4", "run_dir=sweep", "agent.batch_size=0")
    done = ended(BIN / "tangram-train", *overrides, cwd=tmp_path)
    assert done.returncode == 2
    assert "tangram-train: agent.batch_size must be at least 1, got 0\n" in done.stderr


def test_a_sweep_reads_the_run_that_it_is_told(tmp_path: Path) -> None:
    """run_dir of tangram-eval is a run that is there, in every job the same."""
    sweep = ("--multirun", "episodes=4,5", "run_dir=pretrained/square")
    out = "out=scores_${episodes}.json"
    run("tangram-eval", *sweep, out, cwd=tmp_path)
    found = [json.loads((tmp_path / f"scores_{n}.json").read_text())["episodes"] for n in (4, 5)]
    assert found == [4, 5]
