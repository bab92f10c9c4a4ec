"""Opening a run: what a master that was killed left behind, and what workers are told."""

import logging
import shutil
import socket
import stat
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from master.checkpointer import Restored, save_run
from master.config import MasterConfig
from master.hub.security import Given, make_pair, read_keys, write_keys
from master.loop import Loop
from master.record.journal import segments
from master.record.rundir import Record, RunFolder
from master.run import UNBOUNDED, open_run
from master.signals import StopSignals
from tangram_core.errors import ConfigError, RunError, is_passing
from tangram_core.run.process import Every, Watchdog
from tangram_core.run.service import ServiceConfig
from tangram_core.wire.messages import OPEN
from tests.master.builders import ShownProgress, arrival, journal, small_setup, trainer
from tests.ports import free_ports

pytestmark = pytest.mark.cluster

MADE = small_setup()
BATCH = 4
STEP: dict[str, Any] = {"mode": "lockstep", "envs": BATCH // 2}


Told = Callable[[], list[str]]


@pytest.fixture
def told(caplog: pytest.LogCaptureFixture) -> Told:
    """The lines that were logged."""
    caplog.set_level(logging.INFO)
    return lambda: caplog.messages


EVERYWHERE = "0.0.0.0"  # noqa: S104


@contextmanager
def opened_run(
    folder: Path, resume: str = "auto", **service: Any
) -> Iterator[tuple[Loop, dict[str, str]]]:
    """The loop of a run with its sockets open, and what workers are told of it."""
    RunFolder(folder).prepare(resume)
    made = ServiceConfig(**{"http_port": -1} | service)
    config = MasterConfig(str(folder), resume=resume, max_updates=0, service=made)
    with ExitStack() as opened:
        watchdog, signals = Watchdog(0.0), StopSignals()
        claim = opened.enter_context(RunFolder(folder).lock())
        yield open_run(config, MADE, claim, ShownProgress(), signals, watchdog, opened)


def test_a_run_that_was_killed_before_its_first_checkpoint_goes_on(
    tmp_path: Path, told: Told
) -> None:
    kept = journal(tmp_path / "journal", MADE)
    for number in (1, 2, 2, 3):  # one was written twice
        kept.append(replace(arrival(MADE, number), owner="revoked"))
    with opened_run(tmp_path) as (made, _):
        assert made.clock.record.run_id == "run"
        assert made.guard.trainer.episodes == 3 * BATCH
        assert made.hub.state() == {"player/0": {"incarnation": 1, "sequence": 3}}
        kept = made.checkpointer._journal
        assert (kept.segment, kept.number) == (1, 4)
    assert "12 episodes restored from the journal" in told()
    assert "goes on after 0 updates" in told()


def test_a_torn_record_is_told_in_one_life_only(tmp_path: Path, told: Told) -> None:
    """It is cut off."""
    journal(tmp_path / "journal", MADE).append(arrival(MADE, 1))
    [segment] = segments(tmp_path / "journal").values()
    with segment.open("ab") as file:
        file.write(b"torn")
    for life in range(2):
        with opened_run(tmp_path):
            pass
        assert sum("is cut short at byte" in line for line in told()) == 1, life


def test_a_long_journal_is_no_standstill(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The watchdog hears of every batch, in lockstep also of every update."""
    kept = journal(tmp_path / "journal", MADE)
    for number in (1, 2, 3):
        kept.append(arrival(MADE, number))
    beats: list[None] = []
    monkeypatch.setattr(Watchdog, "progress", lambda _: beats.append(None))
    for service, updates in ({}, 0), (STEP, 4):  # those that the batches after the first wait for
        beats.clear()
        with opened_run(tmp_path, **service) as (made, _):
            assert (made.guard.trainer.episodes, made.guard.trainer.updates) == (12, updates)
            assert len(beats) == 3 + updates


@pytest.mark.parametrize("corrupt", [False, True])
def test_of_the_journal_what_the_whole_checkpoint_does_not_cover_is_read(
    tmp_path: Path, told: Told, corrupt: bool
) -> None:
    """The one before a corrupt checkpoint has a longer journal."""
    kept, learner = journal(tmp_path / "journal", MADE), trainer(MADE)
    for number in (1, 2):
        kept.append(arrival(MADE, number))
        learner.insert(arrival(MADE, number).episodes)
        table = {"player/0": {"incarnation": 1, "sequence": number}}
        rest = Restored(Record("run"), table, kept.rotate())
        path = save_run(tmp_path / "checkpoints", learner, rest, keep=2)
    kept.append(arrival(MADE, 3))
    segments(tmp_path / "journal")[1].write_bytes(b"nobody reads this")
    if corrupt:
        (path / "replay.safetensors").unlink()
    with opened_run(tmp_path) as (made, _):
        assert made.guard.trainer.episodes == 3 * BATCH
        assert made.hub.state() == {"player/0": {"incarnation": 1, "sequence": 3}}
    back = 8 if corrupt else 4
    assert told()[-2:] == [f"{back} episodes restored from the journal", "goes on after 0 updates"]


def test_a_journal_of_another_run_and_a_new_run_in_its_folder_are_refused(tmp_path: Path) -> None:
    journal(tmp_path / "journal", MADE).append(arrival(MADE, 1))
    with pytest.raises(ConfigError, match="holds a run"), opened_run(tmp_path, resume="none"):
        pass
    rest = Restored(Record("another"), {})
    save_run(tmp_path / "checkpoints", trainer(MADE), rest, keep=2)
    with pytest.raises(RunError, match="is of another run"), opened_run(tmp_path):
        pass


@pytest.mark.parametrize("bind", [EVERYWHERE, "127.0.0.1"])
def test_over_tcp_the_connection_carries_keys(tmp_path: Path, told: Told, bind: str) -> None:
    found = []
    for _ in range(2):
        with opened_run(tmp_path, bind=bind) as (_, connection):
            pairs = connection["keys"].values()
            found.append([connection["server_key"], *(k for pair in pairs for k in pair.values())])
    assert found[0] == found[1]
    assert sorted(map(len, found[0])) == 5 * [40]
    assert told() == 2 * [UNBOUNDED, "a new run begins"]


@pytest.mark.parametrize(
    ("settings", "host"),
    [
        ({"bind": EVERYWHERE}, socket.gethostname()),
        ({"bind": EVERYWHERE, "host": "learner.lan"}, "learner.lan"),
        ({"bind": "127.0.0.1"}, "127.0.0.1"),
        ({"bind": "127.0.0.1", "host": "::1"}, "[::1]"),
    ],
)
def test_the_connection_names_a_host_that_others_reach(
    tmp_path: Path,
    settings: dict[str, str],
    host: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr("master.run.dns_error", "no such host".__add__)
    with opened_run(tmp_path, http_bind=settings["bind"], http_port=0, **settings) as (
        made,
        connection,
    ):
        ports = [int(made.hub.endpoint.rpartition(":")[2])]
        ports.append(int(made.hub.weights_endpoint.rpartition(":")[2]))
    assert connection["endpoint"] == f"tcp://{host}:{ports[0]}"
    why = f"no such host{connection['endpoint']}"
    said = f"service.host cannot be resolved here ({why}); workers must be able to"
    assert (said in caplog.messages) == ("host" in settings)
    assert connection["weights_endpoint"] == f"tcp://{host}:{ports[1]}"
    http_host = host if settings["bind"] == EVERYWHERE else "127.0.0.1"
    assert connection["http"].startswith(f"http://{http_host}:")


def test_the_ports_can_be_fixed_and_a_taken_one_is_named(tmp_path: Path) -> None:
    port = free_ports(3) + 1  # the one before is asked for, too
    with opened_run(tmp_path / "a", bind="127.0.0.1", port=port) as (made, _):
        found = (made.hub.endpoint, made.hub.weights_endpoint)
        assert [int(endpoint.rpartition(":")[2]) for endpoint in found] == [port, port + 1]
        for taken, asked in ((port, port), (port, port - 1)):
            remedy = rf"port {taken} of .* is in use: set service\.port to a number"
            with (
                pytest.raises(ConfigError, match=remedy) as caught,
                opened_run(tmp_path / str(asked), bind="127.0.0.1", port=asked),
            ):
                pass
            assert is_passing(caught.value)


def test_a_run_that_is_open_to_all_says_so(tmp_path: Path, told: Told) -> None:
    with opened_run(tmp_path, bind="127.0.0.1", auth="off") as (made, connection):
        assert made.reporter.flush(0).numbers["open_to_all"] == 1.0
    assert set(connection) == {"endpoint", "weights_endpoint", "run_id", "machine"}
    assert any(line.startswith(OPEN) for line in told())
    assert not (tmp_path / "keys.json").exists()


def test_on_one_machine_sockets_of_the_user_alone_are_the_same_in_each_life(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sockets, found = tmp_path / "t", []
    sockets.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(sockets))
    for name in ("run", "run", "another"):
        with opened_run(tmp_path / name) as (made, connection):
            assert made.reporter.flush(0).numbers["open_to_all"] == 0.0
            found.append(connection["endpoint"])
            path = Path(connection["endpoint"].removeprefix("ipc://"))
            assert path.is_socket()
            assert path.parent.stat().st_mode & 0o777 == 0o700
        assert list(path.parent.iterdir()) == []
    assert found[0] == found[1] != found[2]
    assert not (tmp_path / "run" / "keys.json").exists()


def test_keys_that_were_given_meanwhile_come_back_with_a_folder_that_was_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("master.hub.security.LOOK_S", 0.0)
    folder = RunFolder(tmp_path / "run")
    with opened_run(folder.path, bind="127.0.0.1") as (made, _):
        given = {"alice": Given("player", make_pair().public)}
        keys = replace(read_keys(folder.keys), given=given)
        write_keys(folder.keys, keys)
        made.hub.poll(0.0)
        shutil.rmtree(folder.path)
        folder.path.mkdir()
        made.checkpointer._look = Every(0.0)
        made.checkpointer.tick()
        assert read_keys(folder.keys) == keys
        assert stat.S_IMODE(folder.keys.stat().st_mode) == 0o600
