"""Files that are whole at any moment."""

import os
import stat
from pathlib import Path

import pytest

from tangram_core.errors import ConfigError, RunError
from tangram_core.store.files import check_writable, make_folders, write_whole

pytestmark = pytest.mark.fast


def test_a_failed_write_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "some" / "folder" / "result.json"  # folders are made
    write_whole(target, b"old")

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(RunError, match=r"cannot write .*result\.json \(No space left"):
            write_whole(target, b"new")
    assert target.read_bytes() == b"old"
    assert list(target.parent.iterdir()) == [target]
    write_whole(target, b"new")
    assert target.read_bytes() == b"new"


def test_a_folder_above_that_was_deleted_is_not_made_again_where_this_is_not_asked_for(
    tmp_path: Path,
) -> None:
    with pytest.raises(FileNotFoundError):
        make_folders(tmp_path / "run" / "journal", above=False)
    with pytest.raises(RunError, match=r"cannot write .*result\.json \(No such file"):
        write_whole(tmp_path / "run" / "result.json", b"", above=False)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match=r"cannot write .*scores\.json"):
        write_whole(tmp_path / "file" / "scores.json", b"")


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("", "it is a folder"),
        ("file/scores.json", "Not a directory"),
        ("file/deeper/scores.json", "Not a directory"),
        (f"{'x' * 250}.json", "File name too long"),
        (f"{'x' * 300}/scores.json", "File name too long"),
    ],
)
def test_what_cannot_be_written_is_told_before_anything_is_done(
    tmp_path: Path, name: str, why: str
) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=rf"^out=.* cannot be written \({why}\): name a file in"):
        check_writable("out", tmp_path / name)
    check_writable("out", tmp_path / "some" / "folder" / "scores.json")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("mode", [0o600, 0o644])
def test_permissions_hold_from_the_first_byte_on(tmp_path: Path, mode: int) -> None:
    target = tmp_path / "connection.json"
    before = os.umask(0)
    try:
        write_whole(target, b"", mode)
    finally:
        os.umask(before)
    assert stat.S_IMODE(target.stat().st_mode) == mode
