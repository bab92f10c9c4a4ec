"""What README and docs show is in the data, and the data are of this code: tangram-report check."""

import json
import subprocess
from pathlib import Path

import pytest

from conf.cli import composed
from tangram_agent.checkpoints import ACTING, load_checkpoint, newest_checkpoint
from tangram_agent.setup import make_setup
from tangram_lab.experiments.fingerprints import (
    BATCH_EPISODES,
    BATCH_SIZE,
    CAPACITY,
    ENVS,
    LEARNING_STARTS,
    PACE,
    SEED,
    TEST_EPISODES,
    UPDATES,
    make_fingerprint,
    sums,
)
from tests.cluster.processes import BIN, run

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(600)]


def test_every_score_of_the_pages_is_in_the_data_and_the_code_still_trains_alike(
    tmp_path: Path,
) -> None:
    command = (BIN / "tangram-report", "check")
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=500, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("every score of README and docs is in the data")


def test_a_fingerprint_is_what_processes_in_lockstep_come_to(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    short = (
        f"agent.batch_size={BATCH_SIZE}",
        f"agent.learning_starts={LEARNING_STARTS}",
        f"agent.replay_capacity={CAPACITY}",
        f"agent.updates_per_transition={PACE}",
        f"seed={SEED}",
        f"max_updates={UPDATES}",
        "service.mode=lockstep",
        f"service.envs={ENVS}",
        f"service.batch_episodes={BATCH_EPISODES}",
        f"service.eval_episodes={TEST_EPISODES}",
    )
    run("tangram-train", f"run_dir={folder}", *short, cwd=tmp_path)
    ours = make_fingerprint(make_setup(composed("train", ["run_dir=x"])))
    result = json.loads((folder / "result.json").read_text())
    learned = load_checkpoint(newest_checkpoint(folder / "checkpoints"), [ACTING]).arrays[ACTING]
    theirs = {name: result[name] for name in ours if name in result}
    theirs |= {"weights": sums(learned, learned)["weights"], "moved": ours["moved"]}
    assert ours == pytest.approx(theirs, rel=1e-12)
