"""A user's own master.py, worker.py and conf.py, in the current folder and on PYTHONPATH."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tangram_cli.commands import COMMANDS, COMMON_NAMES

pytestmark = pytest.mark.cluster

ROOT = Path(__file__).parents[2]
LIMIT_S = 100


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A command of ours where modules of the same names come first on sys.path, twice."""
    for name in COMMON_NAMES:
        (folder / f"{name}.py").write_text("raise RuntimeError('the own file of a user')\n")
    return subprocess.run(
        [sys.executable, "-m", "tangram_cli", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])},
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_finds_our_packages(tmp_path: Path, command: str) -> None:
    told = run(tmp_path, command, "--help")
    assert (told.returncode, told.stderr) == (0, "")
    assert f"tangram-{command}" in told.stdout


def test_a_training_starts_its_processes_from_our_packages(tmp_path: Path) -> None:
    quick = ("sim=kinematic", "workers=1", "max_updates=3", "service.eval_seconds=1")
    told = run(tmp_path, "train", "run_dir=run", *quick)
    assert told.returncode == 0, told.stdout + told.stderr
    assert json.loads((tmp_path / "run" / "result.json").read_text())["updates"] == 3


def test_an_unknown_command_is_told_the_known_ones(tmp_path: Path) -> None:
    told = run(tmp_path, "trian")
    assert told.returncode == 1
    assert told.stderr == f"tangram_cli: name a command: {', '.join(COMMANDS)}\n"
