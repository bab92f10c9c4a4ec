"""A run's parts: what a master that was killed left behind, and what it comes to."""

import socket
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from master.checkpointer import Restored, save_run
from master.config import MasterConfig
from master.journal import segments
from master.parts import PLAIN, UNBOUNDED, Parts, make_parts
from master.rundir import Record, RunFolder
from tangram_agent.config import ServiceConfig
from tangram_sim.errors import ConfigError, RunError
from tests.master.builders import arrival, close_journals, journal, small_setup, trainer

pytestmark = pytest.mark.cluster

MADE = small_setup()
BATCH = 4
STEP: dict[str, Any] = {
    "mode": "lockstep",
    "lockstep_workers": 1,
    "envs": BATCH,
    "batch_episodes": BATCH,
}


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    yield
    close_journals()


EVERYWHERE = "0.0.0.0"  # noqa: S104


def parts(folder: Path, told: list[str], resume: str = "auto", **service: Any) -> Parts:
    run_folder = RunFolder(folder)
    run_folder.prepare(resume)
    config = MasterConfig(str(folder), resume=resume, service=ServiceConfig(**service))
    return make_parts(config, MADE, run_folder, told.append)


def test_a_run_that_was_killed_before_its_first_checkpoint_goes_on(tmp_path: Path) -> None:
    kept = journal(tmp_path / "journal", MADE)
    for number in (1, 2, 2, 3):  # one was written twice
        kept.append(arrival(MADE, number))
    told: list[str] = []
    with closing(parts(tmp_path, told)) as made:
        assert made.record.run_id == "run"
        assert made.trainer.episodes == 3 * BATCH
        assert made.hub.state() == {"player/0": {"incarnation": 1, "sequence": 3}}
        assert made.journal.segment == 2
    assert "12 episodes come back from the journal" in told
    assert "goes on after 0 updates" in told


def test_a_long_journal_is_no_standstill(tmp_path: Path) -> None:
    """The watchdog hears of every batch, in lockstep also of every update."""
    folder = RunFolder(tmp_path)
    kept = journal(folder.journal, MADE)
    for number in (1, 2, 3):
        kept.append(arrival(MADE, number))
    folder.prepare("auto")
    for service, updates in ({}, 0), (STEP, 4):  # those that the batches after the first wait for
        config = MasterConfig(str(tmp_path), resume="auto", service=ServiceConfig(**service))
        beats = count()
        with closing(
            make_parts(config, MADE, folder, lambda _: None, partial(next, beats))
        ) as made:
            assert (made.trainer.episodes, made.trainer.updates) == (12, updates)
        assert next(beats) == 3 + updates


def test_without_a_port_nothing_is_served(tmp_path: Path) -> None:
    with closing(parts(tmp_path, [], http_port=-1)) as made:
        assert made.health is None
        assert "http" not in made.connection()


def test_what_the_checkpoint_covers_is_not_read(tmp_path: Path) -> None:
    kept, learner = journal(tmp_path / "journal", MADE), trainer(MADE)
    for number in (1, 2):
        kept.append(arrival(MADE, number))
        learner.insert(arrival(MADE, number).episodes)
    table = {"player/0": {"incarnation": 1, "sequence": 2}}
    rest = Restored(Record("run"), table, kept.rotate())
    save_run(tmp_path / "checkpoints", learner, rest, keep=2)
    kept.append(arrival(MADE, 3))
    segments(tmp_path / "journal")[1].write_bytes(b"nobody reads this")
    told: list[str] = []
    with closing(parts(tmp_path, told)) as made:
        assert made.trainer.episodes == 3 * BATCH
        assert made.hub.state() == {"player/0": {"incarnation": 1, "sequence": 3}}
    assert told[-2:] == ["4 episodes come back from the journal", "goes on after 0 updates"]


def test_the_one_before_a_corrupt_checkpoint_has_a_longer_journal(tmp_path: Path) -> None:
    kept, learner = journal(tmp_path / "journal", MADE), trainer(MADE)
    for number in (1, 2, 3):
        kept.append(arrival(MADE, number))
        learner.insert(arrival(MADE, number).episodes)
        table = {"player/0": {"incarnation": 1, "sequence": number}}
        rest = Restored(Record("run"), table, kept.rotate())
        path = save_run(tmp_path / "checkpoints", learner, rest, keep=2)
    (path / "replay.safetensors").unlink()
    told: list[str] = []
    with closing(parts(tmp_path, told)) as made:
        assert made.trainer.episodes == 3 * BATCH
        assert made.hub.state() == {"player/0": {"incarnation": 1, "sequence": 3}}
    assert "4 episodes come back from the journal" in told


def test_a_journal_of_another_run_is_refused_and_the_port_is_free_again(tmp_path: Path) -> None:
    kept, learner = journal(tmp_path / "journal", MADE), trainer(MADE)
    kept.append(arrival(MADE, 1))
    save_run(tmp_path / "checkpoints", learner, Restored(Record("another"), {}), keep=2)
    with pytest.raises(RunError, match="is of another run, task or version"):
        parts(tmp_path, [])


def test_a_folder_with_a_journal_is_no_place_for_a_new_run(tmp_path: Path) -> None:
    journal(tmp_path / "journal", MADE).append(arrival(MADE, 1))
    with pytest.raises(ConfigError, match="holds a run already"):
        parts(tmp_path, [], resume="none")


def test_outside_of_loopback_the_connection_carries_keys(tmp_path: Path) -> None:
    told: list[str] = []
    with closing(parts(tmp_path, told, bind=EVERYWHERE)) as made:
        connection = made.connection()
    names = ("server_key", "public_key", "secret_key")
    assert all(len(connection[name]) == 40 for name in names)
    with closing(parts(tmp_path, told, bind=EVERYWHERE)) as again:
        assert {name: again.connection()[name] for name in names} == {
            name: connection[name] for name in names
        }
    assert told == 2 * [UNBOUNDED, "a new run begins"]


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
    tmp_path: Path, settings: dict[str, str], host: str
) -> None:
    with closing(parts(tmp_path, [], http_bind=settings["bind"], **settings)) as made:
        connection = made.connection()
        ports = [int(made.hub.endpoint.rpartition(":")[2])]
        ports.append(int(made.hub.weights_endpoint.rpartition(":")[2]))
    assert connection["endpoint"] == f"tcp://{host}:{ports[0]}"
    assert connection["weights_endpoint"] == f"tcp://{host}:{ports[1]}"
    http_host = host if settings["bind"] == EVERYWHERE else "127.0.0.1"
    assert connection["http"].startswith(f"http://{http_host}:")


def test_both_ports_can_be_fixed_and_the_wrong_one_is_named(tmp_path: Path) -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as one,
        socket.create_server(("127.0.0.1", 0)) as two,
    ):
        ports = {"port": one.getsockname()[1], "weights_port": two.getsockname()[1]}
    with closing(parts(tmp_path / "a", [], **ports)) as made:
        found = (made.hub.endpoint, made.hub.weights_endpoint)
        assert [int(endpoint.rpartition(":")[2]) for endpoint in found] == list(ports.values())
        for name, port in ports.items():
            with pytest.raises(ConfigError, match=rf"in use: choose another with service\.{name}="):
                parts(tmp_path / name, [], **{name: port})


@pytest.mark.parametrize(("bind", "warned"), [(EVERYWHERE, True), ("127.0.0.1", False)])
def test_plain_transport_is_warned_of_where_others_reach_it(
    tmp_path: Path, bind: str, warned: bool
) -> None:
    told: list[str] = []
    with closing(parts(tmp_path, told, bind=bind, security="plain")) as made:
        assert set(made.connection()) == {"endpoint", "weights_endpoint", "run_id", "http"}
    assert (PLAIN in told) is warned
    assert not (tmp_path / "keys.json").exists()
