"""Encrypted sockets: who has the run's connection file is let in, and nobody else."""

import json
import socket
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
import zmq

from master.hub import Hub
from master.security import Keys, make_keys
from tangram_agent.types import Weights
from tangram_sim.errors import TangramError
from tests.agent.messages import episodes, hello, weights
from tests.master.dealers import INFO, Stage, staged
from tests.worker.conversation import QUICK, both, free_port, make_client, served

pytestmark = pytest.mark.cluster

HASTY = replace(QUICK, join_s=0.1, retry_s=0.1)


@pytest.fixture(autouse=True)
def unlingering(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody waits for a BYE to those who took no key."""
    monkeypatch.setattr("worker.connection.LINGER_MS", 0)


def write_file(folder: Path, hub: Hub, keys: Keys | None, run_id: str = "run") -> Path:
    """What a master with these keys would write."""
    content = {"endpoint": hub.endpoint, "run_id": run_id}
    if keys is not None:
        content |= {
            "server_key": keys.server_public,
            "public_key": keys.worker_public,
            "secret_key": keys.worker_secret,
        }
    path = folder / "connection.json"
    path.write_text(json.dumps(content))
    return path


def turned_away(stage: Stage, connect: object) -> str:
    """Why a client that got no further than the handshake is given up."""
    with make_client(connect, HASTY) as client:
        both(stage, client, lambda: client.counters["handshakes_failed"] >= 2)
        with pytest.raises(TangramError) as caught:
            served(stage, client.join)
    return str(caught.value)


def test_the_file_lets_a_worker_in_and_everything_works(tmp_path: Path) -> None:
    """Without heartbeats nothing tells of weights but the broadcast, of which none was missed."""
    keys, silent = make_keys(), replace(QUICK, heartbeat_s=3600.0)
    with (
        staged(keys=keys) as stage,
        make_client(write_file(tmp_path, stage.hub, keys), silent) as client,
    ):
        assert served(stage, client.join)
        client.send(episodes(), 0)
        stage.until(stage.batches)
        stage.hub.acknowledge(stage.batches()[0])
        got: list[Weights | None] = []

        def heard() -> bool:
            stage.hub.publish(weights(version=len(got) + 1))
            got.append(client.newest_weights())
            return got[-1] is not None and client.outbox.first == 2

        both(stage, client, heard)
        assert stage.hub.counters["refused_keys"] == 0


@pytest.mark.parametrize("wrong", ["server", "worker", "both", "none", "of a plain master"])
def test_other_keys_are_turned_away_and_the_worker_names_its_file(
    tmp_path: Path, wrong: str, caplog: pytest.LogCaptureFixture
) -> None:
    keys, other = make_keys(), make_keys()
    given: Keys | None = {
        "server": replace(keys, server_public=other.server_public),
        "worker": replace(
            keys, worker_public=other.worker_public, worker_secret=other.worker_secret
        ),
        "none": None,
    }.get(wrong, other)
    with staged(keys=None if wrong == "of a plain master" else keys) as stage:
        path = write_file(tmp_path, stage.hub, given)
        reason = turned_away(stage, path)
        assert reason == (
            f"wrong or stale connection file: what answers at {stage.hub.endpoint} does not take "
            f"the keys of {path}; take the file of a master that is running"
        )
        assert stage.hub.counters["refused_keys"] >= (wrong == "worker")
        assert stage.hub.peers == []
    # It was told at once, too, not only when the patience was over.
    assert [r.message for r in caplog.records if r.name == "worker.connection"] == [reason]


def test_an_address_alone_is_not_enough() -> None:
    with staged(keys=make_keys()) as stage:
        reason = turned_away(stage, stage.hub.endpoint)
    assert "wants keys, or is none: name its connection file" in reason


def test_a_file_that_becomes_right_is_read_again(tmp_path: Path) -> None:
    """A worker may be there before its master, whose file of another life still lies there."""
    keys = make_keys()
    with staged(keys=keys) as stage:
        path = write_file(tmp_path, stage.hub, make_keys())
        with make_client(path) as client:
            both(stage, client, lambda: client.counters["handshakes_failed"])
            write_file(tmp_path, stage.hub, keys)
            both(stage, client, lambda: client.joined)


def test_a_master_that_gets_the_right_keys_is_joined_without_waiting_for_silence(
    tmp_path: Path,
) -> None:
    """ZeroMQ itself never connects again after it was refused."""
    keys, other, port = make_keys(), make_keys(), free_port()
    others = replace(keys, worker_public=other.worker_public, worker_secret=other.worker_secret)
    with staged(port=port, keys=others) as stage:
        path = write_file(tmp_path, stage.hub, keys)
        with make_client(path, replace(QUICK, silence_s=3600.0)) as client:
            both(stage, client, lambda: client.counters["handshakes_failed"])
            stage.hub.close()
            with staged(port=port, keys=keys) as again:
                both(again, client, lambda: client.joined)


def test_a_stranger_without_keys_is_not_heard_at_all() -> None:
    """No reason is given to those who are not authenticated, whatever they say."""
    with staged(keys=make_keys()) as stage, zmq.Context() as context:
        socket = context.socket(zmq.DEALER)
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(stage.hub.endpoint)
        for _ in range(3):
            socket.send_multipart(hello().encode())
        with pytest.raises(TimeoutError):
            stage.until_within(0.5, lambda: socket.poll(0) or stage.hub.counters)
        socket.close()


def test_the_port_of_an_encrypted_hub_is_free_after_it_is_closed() -> None:
    first = Hub("127.0.0.1", 0, INFO, keys=make_keys())
    port = int(first.endpoint.rpartition(":")[2])
    first.close()
    Hub("127.0.0.1", port, INFO, keys=make_keys()).close()


def test_a_connection_that_is_lost_in_the_handshake_is_no_wrong_key(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A network that fails at the wrong moment, twice, before it works."""
    keys = make_keys()
    with staged(keys=keys) as stage, socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        path = write_file(tmp_path, stage.hub, keys)
        content = json.loads(path.read_text())
        path.write_text(json.dumps(content | {"endpoint": f"tcp://127.0.0.1:{port}"}))
        with make_client(path) as client, ThreadPoolExecutor(1) as pool:
            future = pool.submit(client.join)
            for _ in range(2):
                near, _ = listener.accept()
                near.recv(10)
                near.close()
            write_file(tmp_path, stage.hub, keys)
            stage.until(future.done)
            assert future.result()
            assert client.counters["handshakes_failed"] == 0
    assert "wrong or stale" not in caplog.text
