"""Sweeps whose jobs are processes elsewhere: what they leave, what is heard of those that fail."""

import json
from pathlib import Path

import pytest

from tests.cluster.processes import BIN, ended, run

pytestmark = pytest.mark.cluster
pytest.importorskip("submitit", reason="needs the extra: pip install -e '.[slurm]'")

SWEEP = ("--multirun", "hydra/launcher=submitit_local", "hydra.launcher.timeout_min=5")
TINY = ("sim=kinematic", "max_updates=2", "service.eval_episodes=4", "agent.learning_starts=32")


@pytest.mark.check
def test_each_job_of_a_sweep_leaves_a_run_of_its_own(tmp_path: Path) -> None:
    seeds = ("seed=3,4", "run_dir=sweep", "agent.batch_size=8")
    run("tangram-train", *SWEEP, *seeds, *TINY, cwd=tmp_path)
    results = [json.loads((tmp_path / f"sweep/{n}/result.json").read_text()) for n in (0, 1)]
    assert [(one["seed"], one["updates"]) for one in results] == [(3, 2), (4, 2)]


def test_a_job_that_is_refused_is_heard_of_at_home(tmp_path: Path) -> None:
    overrides = ("seed=3,4", "run_dir=sweep", "agent.batch_size=0")
    done = ended(BIN / "tangram-train", *SWEEP, *overrides, cwd=tmp_path)
    job, said = done.stderr.splitlines()  # hydra says which job it was
    assert (done.returncode, "seed=3" in job) == (2, True)
    assert said == "tangram-train: agent.batch_size must be at least 1, got 0"


def test_a_sweep_reads_the_run_that_it_is_told(tmp_path: Path) -> None:
    """run_dir of tangram-eval is a run that is there, in every job the same."""
    sweep = ("--multirun", "episodes=4,5", "run_dir=pretrained/square")
    out = "out=scores_${episodes}.json"
    run("tangram-eval", *sweep, out, cwd=tmp_path)
    found = [json.loads((tmp_path / f"scores_{n}.json").read_text())["episodes"] for n in (4, 5)]
    assert found == [4, 5]
