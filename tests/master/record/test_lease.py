"""A run folder on a file system whose locks hold on one machine alone."""

import errno
import fcntl
import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from master.record import lease as lease_module
from master.record.lease import BOOT, Lease
from master.record.rundir import LEASE, RunFolder
from tangram_core.errors import ConfigError, FailedError, UnavailableError
from tangram_core.run.process import still_alive

pytestmark = pytest.mark.fast


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lease_module, "RENEW_S", 0.0)
    monkeypatch.setattr(lease_module, "LOOK_S", 0.01)
    monkeypatch.setattr(lease_module, "STALE_S", 0.2)


def of_another(folder: Path, age_s: float = 0.0, host: str = "far", machine: str = "9") -> Path:
    path = folder / LEASE
    content = {"host": host, "machine": machine, "id": "theirs"}
    path.write_text(json.dumps(content) if host else "")
    os.utime(path, (time.time() - age_s,) * 2)
    return path


def full(*_: object) -> int:
    raise OSError(errno.ENOSPC, "No space left on device")


@contextmanager
def living(path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    over = threading.Event()

    def live() -> None:
        while not over.wait(0.05):
            os.utime(path)

    thread = threading.Thread(target=live)
    thread.start()
    try:
        with monkeypatch.context() as patient:  # the thread may have to wait for a processor
            patient.setattr(lease_module, "STALE_S", 60.0)
            yield
    finally:
        over.set()
        thread.join()


@pytest.mark.parametrize("age_s", [0.0, 1000.0, -1000.0], ids=["now", "clock set on", "set back"])
def test_a_process_of_another_machine_that_lives_keeps_its_folder(
    age_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Perhaps for no more than the moment in which its job ends, after it was queued again."""
    path, host = of_another(tmp_path, age_s, socket.gethostname()), socket.gethostname()
    with (
        living(path, monkeypatch),
        pytest.raises(UnavailableError, match=f"by a process on {host}: choose"),
    ):
        RunFolder(tmp_path).lock()
    with RunFolder(tmp_path).lock() as claim:  # which the one that was refused did not keep
        assert json.loads(path.read_text())["id"] != "theirs"
        claim.run.path.joinpath(".lock").unlink()
        of_another(tmp_path)
        with living(path, monkeypatch), pytest.raises(FailedError, match="lost: a process on far"):
            claim.check()


@pytest.mark.parametrize(
    ("age_s", "host", "machine", "told"),
    [
        (0.0, "far", "9", 1),
        (1000.0, "far", "9", 1),
        (-1000.0, "far", "9", 1),
        (0.0, "far", BOOT.read_text().strip(), 0),
        (0.0, "", "", 0),
    ],
    ids=["silent", "long gone", "from the future", "of this machine", "after a power cut"],
)
def test_one_that_is_gone_leaves_its_folder(
    age_s: float,
    host: str,
    machine: str,
    told: int,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    path = of_another(tmp_path, age_s, host, machine)
    with RunFolder(tmp_path).lock() as claim:
        assert json.loads(path.read_text())["id"] != "theirs"
        assert claim.check() is False
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]
    assert len(caplog.messages) == told


def test_who_lost_the_folder_acknowledges_nothing_more(tmp_path: Path) -> None:
    with RunFolder(tmp_path).lock() as claim:
        path = of_another(tmp_path)
        for content in (path.read_text(), ""):
            path.write_text(content)
            with pytest.raises(FailedError, match="lost: a process on far has taken it over"):
                claim.check()
    assert path.exists()  # it is none of ours


def test_one_that_was_tidied_up_or_damaged_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / LEASE
    monkeypatch.setattr(lease_module, "STALE_S", 60.0)
    with RunFolder(tmp_path).lock() as claim:
        mine = path.read_text()
        for harm in (path.unlink, lambda: path.write_text("")):
            harm()
            assert claim.check() is False
            assert path.read_text() == mine


def test_a_machine_that_was_suspended_looks_before_it_acknowledges(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The monotonic clock stands still in that time."""
    monkeypatch.setattr(lease_module, "RENEW_S", 60.0)
    with RunFolder(tmp_path).lock() as claim:
        of_another(tmp_path)
        assert claim.check() is False
        slept = time.clock_gettime(time.CLOCK_BOOTTIME) + 61.0
        monkeypatch.setattr(
            time, "clock_gettime", lambda clock: {time.CLOCK_BOOTTIME: slept}[clock]
        )
        with pytest.raises(FailedError, match="a process on far has taken it over"):
            claim.check()


def test_one_that_is_gone_after_a_long_silence_may_have_been_of_another(tmp_path: Path) -> None:
    """It took the folder over from a suspended process, and ended: 68 batches were lost."""
    with RunFolder(tmp_path).lock() as claim:
        (tmp_path / LEASE).unlink()
        time.sleep(2 * lease_module.STALE_S)
        with pytest.raises(FailedError, match="a process on another machine has taken it over"):
            claim.check()


@pytest.mark.parametrize("third", [False, True])
def test_of_those_that_take_an_old_one_away_one_has_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, third: bool
) -> None:
    """The other made its own after this one had looked; a third while this one has that aside."""
    path, real, theirs = of_another(tmp_path, 1000.0), Lease._await_silence, list[str]()

    def late(self: Lease) -> os.stat_result:
        judged = real(self)
        if not theirs:
            theirs.append("theirs, new")
            path.unlink()
            path.write_text(json.dumps({"host": "far", "id": theirs[0]}))
        else:  # put back, unless there is a third; its process ends now
            assert json.loads(path.read_text())["id"] == ("third" if third else theirs[0])
        return judged

    def link(source: Path, target: Path) -> None:
        if third and theirs and not path.exists() and theirs[0] in source.read_text():
            path.write_text(json.dumps({"host": "far", "id": "third"}))
        real_link(source, target)

    monkeypatch.setattr(Lease, "_await_silence", late)
    real_link = os.link
    monkeypatch.setattr(os, "link", link)
    mine = Lease(path)
    assert json.loads(path.read_text())["id"] == mine._id
    assert [one.name for one in tmp_path.iterdir()] == [LEASE]


def test_a_full_disk_is_no_reason_to_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(Path, "write_text", full)
    lease = Lease(tmp_path / LEASE)
    began_s = time.clock_gettime(time.CLOCK_BOOTTIME)
    for turn in range(1, 9):  # for a long time
        now_s = began_s + turn * lease_module.STALE_S / 2
        monkeypatch.setattr(time, "clock_gettime", {time.CLOCK_BOOTTIME: now_s}.__getitem__)
        lease.renew()
    lease.close()
    assert "(No space left on device): other machines are not seen" in caplog.messages[0]


def test_a_file_system_without_locks_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", fail)
    told = r"/\.lock cannot be locked by flock \(No locks available\): choose a run_dir on a file"
    with pytest.raises(ConfigError, match=told):
        RunFolder(tmp_path).lock()


def test_one_that_a_full_disk_kept_from_its_successor_on_this_machine_ends_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    of_another(tmp_path, machine=BOOT.read_text().strip())  # killed: the lock shows that it ended
    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", full)
        claim = RunFolder(tmp_path).lock()
    with claim:
        assert claim.check() is False
        assert json.loads((tmp_path / LEASE).read_text())["id"] != "theirs"


def test_it_is_renewed_while_a_checkpoint_is_written_and_no_longer_than_it_is_held(
    tmp_path: Path,
) -> None:
    lease = Lease(tmp_path / LEASE)
    os.utime(tmp_path / LEASE, (0.0, 0.0))
    still_alive()
    assert (tmp_path / LEASE).stat().st_mtime > 0.0
    of_another(tmp_path)
    with pytest.raises(FailedError, match="a process on far has taken it over"):
        still_alive()  # nothing more may be written
    lease.close()
    assert (tmp_path / LEASE).exists()
    os.utime(tmp_path / LEASE, (0.0, 0.0))
    still_alive()
    assert (tmp_path / LEASE).stat().st_mtime == 0.0
