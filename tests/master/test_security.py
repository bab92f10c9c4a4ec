"""Keys of a run: made once, kept for the user alone, checked when read."""

import json
import os
import re
import stat
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import pytest

from master.security import Keys, listening_place, make_keys, needs_keys, run_keys
from tangram_agent.config import ServiceConfig
from tangram_sim.errors import ConfigError, RunError

pytestmark = pytest.mark.fast


def test_a_run_keeps_its_keys_and_only_the_user_reads_them(tmp_path: Path) -> None:
    path = tmp_path / "keys.json"
    made = run_keys(path)
    assert run_keys(path) == made
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert run_keys(tmp_path / "other.json") != made
    assert len(set(asdict(made).values())) == 4


@pytest.mark.parametrize(
    "change",
    [
        {"more": 1},
        {"server_secret": "x" * 40},
        {"worker_secret": "short"},
        {"worker_public": make_keys().worker_public},
        {"server_public": 7},
        "",
        "[" * 100_000,
        "[]",
        "{}",
    ],
)
def test_a_file_that_holds_something_else_is_refused(tmp_path: Path, change: object) -> None:
    path = tmp_path / "keys.json"
    whole = isinstance(change, str)
    path.write_text(str(change) if whole else json.dumps(asdict(make_keys()) | dict(change)))
    with pytest.raises(RunError, match=r"keys\.json does not hold the run's keys .*: delete it"):
        run_keys(path)


@pytest.mark.parametrize("bind", ["127.0.0.1", "localhost", "::1", "0.0.0.0", "node7"])  # noqa: S104
def test_every_address_takes_keys_unless_it_is_opened_by_name(bind: str) -> None:
    assert needs_keys(ServiceConfig(bind=bind))
    assert not needs_keys(ServiceConfig(bind=bind, auth="off"))
    assert not needs_keys(ServiceConfig())


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda path: path.mkdir(mode=0o750), "it is drwxr-x--- of user {uid}: remove it, or set"),
        (lambda path: path.write_text(""), "it is -rw"),
        (lambda path: path.symlink_to("/"), "it is lrwxrwxrwx of user"),
        (lambda path: (path.mkdir(mode=0o700), os.chown(path, 7, 7)), "drwx------ of user 7: rem"),
        (lambda path: path.parent.rmdir(), "cannot be made (No such file or directory): set TMPD"),
    ],
)
def test_a_folder_of_sockets_that_others_may_change_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Callable[[Path], object], reason: str
) -> None:
    if "user 7" in reason and os.geteuid():
        pytest.skip("only root can give a folder away")
    folder = tmp_path / "t" / f"tangram-{os.geteuid()}"
    folder.parent.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder.parent))
    make(folder)
    with pytest.raises(RunError, match=re.escape(reason.format(uid=os.geteuid()))):
        listening_place("local", tmp_path)


def test_a_folder_too_deep_for_sockets_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    deep = tmp_path / ("x" * 80)
    deep.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(deep))
    with pytest.raises(ConfigError, match=r"have 107 bytes at most: set TMPDIR to a shorter one"):
        listening_place("local", tmp_path)


def test_secrets_are_not_shown() -> None:
    keys = Keys("a", "SECRET", "b", "SECRET")
    assert "SECRET" not in repr(keys)
