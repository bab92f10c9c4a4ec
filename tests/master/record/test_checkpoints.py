"""Checkpoint folders: written whole or not at all, and every changed byte is found."""

import errno
import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tangram_core.errors import RunError
from tangram_core.run.process import Watchdog
from tangram_core.store import checkpoints
from tangram_core.store.checkpoints import (
    CorruptError,
    list_checkpoints,
    load_checkpoint,
    newest_checkpoint,
    save_checkpoint,
    set_aside,
)
from tests.agent.builders import BFLOAT, watched_disk

pytestmark = pytest.mark.fast

ARRAYS = {
    "weights": {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "scalar": np.float64(3)},
    "replay": {
        "flags": np.array([0, 1], np.uint8),
        "count": np.array([7], np.int64),
        "none": np.zeros((0, 2), np.float32),
        "turned": np.arange(6, dtype=np.float32).reshape(2, 3).T,
    },
}
COUNTERS = {
    "episodes": 12,
    "generator": {"state": 2**127 + 1},
    "by_number": {10: "ten", 9: "nine"},
    "nothing": None,
    "loss": 0.1 + 0.2,
}
READ_BACK = COUNTERS | {"by_number": {"10": "ten", "9": "nine"}}
FILES = ("manifest.json", "weights.safetensors", "replay.safetensors")


def save(folder: Path, updates: int = 5, keep: int = 2) -> Path:
    return save_checkpoint(folder, updates, ARRAYS, COUNTERS, keep)


def names(folder: Path) -> list[str]:
    return [path.name for path in list_checkpoints(folder)]


def test_what_is_read_is_what_was_written(tmp_path: Path) -> None:
    path = save(tmp_path / "checkpoints")
    found = load_checkpoint(path)
    assert (found.path, found.updates, found.counters) == (path, 5, READ_BACK)
    assert set(found.arrays) == set(ARRAYS)
    for stem, tensors in ARRAYS.items():
        assert set(found.arrays[stem]) == set(tensors)
        for name, value in tensors.items():
            got = found.arrays[stem][name]
            assert got.dtype == np.asarray(value).dtype
            np.testing.assert_array_equal(got, value)


def test_only_the_named_files_are_read(tmp_path: Path) -> None:
    path = save(tmp_path)
    (path / "replay.safetensors").unlink()
    assert set(load_checkpoint(path, ["weights"]).arrays) == {"weights"}


def test_names_are_ordered_as_numbers(tmp_path: Path) -> None:
    for updates in (999_999_999, 100_000_000_0, 7, 7, 7):
        save(tmp_path, updates, keep=9)
    expected = ["00000007", "00000007-1", "00000007-2", "999999999", "1000000000"]
    assert names(tmp_path) == expected
    assert newest_checkpoint(tmp_path).name == "1000000000"


@pytest.mark.parametrize("keep", [1, 2])
def test_the_newest_of_one_number_is_the_last_written(tmp_path: Path, keep: int) -> None:
    """A run that waits for workers writes many without an update between."""
    written = [save(tmp_path, keep=keep).name for _ in range(5)]
    assert written == ["00000005", *(f"00000005-{i}" for i in range(1, 5))]
    assert names(tmp_path) == written[-keep:]


def test_a_crash_before_the_rename_leaves_the_old_one_valid(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = save(tmp_path, updates=5)

    def crash(self: Path, target: Path) -> Path:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", crash)
        with pytest.raises(KeyboardInterrupt):
            save(tmp_path, updates=6)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".writing-00000006", "00000005"]
    assert newest_checkpoint(tmp_path) == old
    assert load_checkpoint(old).updates == 5
    save(tmp_path, updates=6)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["00000005", "00000006"]


def test_an_old_one_that_cannot_be_deleted_is_told_and_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    save(tmp_path, updates=5)

    def fail(path: Path) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", fail)
        save(tmp_path, updates=6, keep=1)
    told = "00000005 cannot be deleted (Operation not permitted): delete it yourself"
    assert caplog.messages == [f"{tmp_path}/{told}"]
    save(tmp_path, updates=7, keep=1)
    assert names(tmp_path) == ["00000007"]


@pytest.mark.parametrize("name", ["manifest.json", "weights.safetensors"])
def test_a_disk_that_fails_is_no_reason_to_take_an_older_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    real, path = Path.open, save(tmp_path)

    def fail(self: Path, *given: Any, **named: Any) -> Any:
        if self.name == name:
            raise OSError(errno.EIO, "Input/output error")
        return real(self, *given, **named)

    monkeypatch.setattr(Path, "open", fail)
    with pytest.raises(RunError, match="cannot read checkpoint .*Input/output") as caught:
        load_checkpoint(path)
    assert not isinstance(caught.value, CorruptError)


def test_a_slow_disk_is_no_reason_to_end_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoints, "_PART", 16)
    beats = list[str]()
    monkeypatch.setattr(Watchdog, "progress", lambda _: beats.append("alive"))
    with Watchdog(0.0):
        path = save(tmp_path)
        written = len(beats)
        assert load_checkpoint(path).updates == 5
    size = sum((path / name).stat().st_size for name in FILES)
    assert written >= size // 16
    assert len(beats) - written >= size // 16 - (path / FILES[0]).stat().st_size // 16
    load_checkpoint(path)  # without a watchdog nobody is told
    assert len(beats) < 2 * written


def test_a_half_written_folder_is_no_checkpoint(tmp_path: Path) -> None:
    (tmp_path / ".writing-00000009").mkdir()
    (tmp_path / "00000009.corrupt").mkdir()
    (tmp_path / "00000009").write_text("a file")
    assert names(tmp_path) == []


def turned(place: int) -> Callable[[bytes], bytes]:
    def turn(data: bytes) -> bytes:
        at = min(place, len(data) - 1) % len(data)
        return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]

    return turn


HARMS: dict[str, Callable[[bytes], bytes | None]] = {
    **{f"byte {place}": turned(place) for place in (0, 300, -1)},
    "cut": lambda data: data[: len(data) // 2],
    "missing": lambda _: None,
}


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("harm", HARMS)
def test_every_harm_to_a_file_is_found(tmp_path: Path, file: str, harm: str) -> None:
    path = save(tmp_path)
    rest = HARMS[harm]((path / file).read_bytes())
    (path / file).unlink()
    if rest is not None:
        (path / file).write_bytes(rest)
    with pytest.raises(CorruptError) as caught:
        load_checkpoint(path)
    why = caught.value.why
    assert file in why
    assert (why == f"{file} is missing") == (harm == "missing")
    assert str(caught.value) == (
        f"checkpoint {path} is corrupt ({why}): delete it to use the one before"
    )


@pytest.mark.parametrize(
    ("change", "kind", "reason"),
    [
        ({"format_version": 2}, RunError, "has format 2, this version reads 4: use the version"),
        ({"format_version": None}, CorruptError, "manifest.json has no format_version"),
        ({"updates": 6}, CorruptError, "checksum of manifest.json differs"),
        ({"counters": {}}, CorruptError, "checksum of manifest.json differs"),
        ({"files": {}}, CorruptError, "checksum of manifest.json differs"),
    ],
)
def test_a_changed_manifest_is_refused_and_another_format_is_not_taken_for_corrupt(
    tmp_path: Path, change: dict[str, object], kind: type[RunError], reason: str
) -> None:
    path = save(tmp_path)
    manifest = json.loads((path / "manifest.json").read_text())
    (path / "manifest.json").write_text(json.dumps(manifest | change))
    with pytest.raises(RunError, match=reason) as caught:
        load_checkpoint(path)
    assert type(caught.value) is kind


def seal(path: Path, body: dict[str, object]) -> None:
    """Write a manifest whose checksum holds."""
    told = hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()
    (path / "manifest.json").write_text(json.dumps({"format_version": 4, "sha256": told, **body}))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"counters": []}, "Expected `object`, got `array` - at `$.counters`"),
        ({"counters": None}, "Expected `object`, got `null` - at `$.counters`"),
        ({"files": 3}, "Expected `object`, got `int` - at `$.files`"),
        ({"files": {"weights": 3}}, "Expected `str`, got `int` - at `$.files[...]`"),
        ({"updates": "x"}, "Expected `int`, got `str` - at `$.updates`"),
        ({"updates": -1}, "Expected `int` >= 0 - at `$.updates`"),
    ],
)
def test_a_forged_manifest_is_corrupt_though_its_checksum_holds(
    tmp_path: Path, change: dict[str, object], reason: str
) -> None:
    path = save(tmp_path)
    seal(path, {"updates": 5, "files": {}, "counters": {}} | change)
    with pytest.raises(CorruptError) as caught:
        load_checkpoint(path)
    assert caught.value.why == f"manifest.json: {reason}"


def test_a_forged_file_is_corrupt_though_its_checksums_hold(tmp_path: Path) -> None:
    path = save(tmp_path)
    (path / "replay.safetensors").write_bytes(BFLOAT)
    files = {"replay": hashlib.sha256(BFLOAT).hexdigest()}
    seal(path, {"updates": 5, "files": files, "counters": {}})
    with pytest.raises(CorruptError, match=r"replay\.safetensors: not safetensors: 'BF16'"):
        load_checkpoint(path)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"updates":' * 100_000, "[1]", ""])
def test_what_is_no_manifest_is_corrupt(tmp_path: Path, text: str) -> None:
    path = save(tmp_path)
    (path / "manifest.json").write_text(text)
    with pytest.raises(CorruptError, match=r"manifest.json (is not JSON|has no format_version)"):
        load_checkpoint(path)


def test_a_stem_that_was_never_there(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"has no optimiser\.safetensors"):
        load_checkpoint(save(tmp_path), ["optimiser"])


def test_a_folder_without_a_checkpoint_and_one_that_cannot_be_written_are_told(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "checkpoints"
    for _ in range(2):
        with pytest.raises(RunError, match=f"no checkpoint in {folder}: train the run first"):
            newest_checkpoint(folder)
        folder.mkdir(exist_ok=True)
    folder.rmdir()
    folder.write_text("a file is in the way")
    for in_the_way in (folder, tmp_path / "deleted" / "checkpoints"):
        with pytest.raises(RunError, match=r"cannot write a checkpoint to .*: make room there"):
            save(in_the_way)
        folder.unlink(missing_ok=True)
    assert list(tmp_path.iterdir()) == []  # what was deleted is not made again by accident


def test_a_corrupt_one_is_set_aside_for_good_and_no_longer_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for updates in (5, 5, 6, 7):
        set_aside(save(tmp_path, updates))
    assert names(tmp_path) == []
    kept = ["00000006.corrupt", "00000007.corrupt"]  # and no more, so that the disk is not filled
    assert sorted(path.name for path in tmp_path.iterdir()) == kept
    path, events = save(tmp_path), watched_disk(monkeypatch)
    set_aside(path)
    assert events == ["renamed", tmp_path.stat().st_ino]
