"""The run folder: who may use it, and files that are whole at any moment."""

import json
import os
import stat
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

from master.record.journal import segment_path
from master.record.rundir import RunFolder
from tangram_core.errors import ConfigError, RunError
from tangram_core.store.checkpoints import save_checkpoint
from tangram_core.store.files import write_whole

pytestmark = pytest.mark.fast


LEFT: dict[str, Callable[[RunFolder], object]] = {
    "a result": lambda folder: folder.write_result({}),
    "a checkpoint": lambda folder: save_checkpoint(
        folder.checkpoints, 1, {"weights": {"a": np.zeros(1)}}, {}, keep=1
    ),
    "curves": lambda folder: write_whole(folder.tensorboard / "events", b""),
}


@pytest.mark.parametrize("left", LEFT)
def test_a_folder_with_a_run_is_refused_unless_resumed(tmp_path: Path, left: str) -> None:
    folder = RunFolder(tmp_path)
    LEFT[left](folder)
    with pytest.raises(ConfigError, match=r"holds a run already: choose another .* resume=auto"):
        folder.prepare("none")
    folder.prepare("auto")


def test_a_run_that_lost_its_checkpoints_is_not_begun_anew(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    folder.check_never_kept()
    folder.write_result({})
    with pytest.raises(RunError, match=r"lost its checkpoints: put them back .* with another run_"):
        folder.check_never_kept()
    write_whole(segment_path(folder.journal, 1), b"")  # killed before it had any
    folder.check_never_kept()
    segment_path(folder.journal, 1).rename(segment_path(folder.journal, 2))
    with pytest.raises(RunError, match="has lost its checkpoints"):
        folder.check_never_kept()


def test_a_new_folder_is_made_and_one_of_a_launcher_is_used(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "deep" / "run")
    folder.prepare("none")
    folder.write_config({"seed": 1})
    folder.logs.mkdir()
    folder.prepare("none")


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"cannot be made .*: choose another run_dir"):
        RunFolder(tmp_path / "file" / "run").prepare("none")


def test_only_one_master_works_in_a_folder(tmp_path: Path) -> None:
    with RunFolder(tmp_path).lock(), pytest.raises(ConfigError, match="in use by another process"):
        RunFolder(tmp_path).lock()
    RunFolder(tmp_path).lock().close()


def test_nobody_else_can_lock_a_folder(tmp_path: Path) -> None:
    (tmp_path / ".lock").touch(0o644)  # of an older version
    with RunFolder(tmp_path).lock():
        assert stat.S_IMODE((tmp_path / ".lock").stat().st_mode) == 0o600


def test_what_is_written_is_read_back_and_only_the_user_may_read_the_connection(
    tmp_path: Path,
) -> None:
    folder = RunFolder(tmp_path)
    kinds = {"task": {"kind": "place"}, "agent": {"kind": "pair"}}
    config = {"tokens": {"shapes": ["square"]}, "service": {"envs": 4}, "seed": 0, **kinds}
    folder.write_config(config)
    assert list(yaml.safe_load(folder.config.read_text()).items()) == list(config.items())
    folder.write_result({"mean_reward": None})
    assert json.loads(folder.result.read_text()) == {"mean_reward": None}
    folder.connection.touch(0o644)
    before = os.umask(0)
    try:
        folder.write_connection({"endpoint": "tcp://127.0.0.1:5555"})
    finally:
        os.umask(before)
    assert stat.S_IMODE(folder.connection.stat().st_mode) == 0o600
    settings = {name: config[name] for name in ("task", "tokens", "agent", "service")}
    content = {"endpoint": "tcp://127.0.0.1:5555", "settings": settings}
    assert json.loads(folder.connection.read_text()) == content
