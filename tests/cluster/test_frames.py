"""What must not come over a wire, between real masters and workers that must not mind."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zmq

from tangram_agent.messages import Alive, Heartbeat, Hello, Welcome, decode_from_master
from tests.cluster.mangler import KINDS, Mangler
from tests.cluster.players import (
    Player,
    assert_exactly_once,
    finish,
    master,
    more_acknowledged,
    players,
    setup_of,
    tags_in_replay,
    until,
)
from worker.status import ask_status

pytestmark = pytest.mark.cluster


def endpoint_of(folder: Path) -> str:
    return str(json.loads((folder / "connection.json").read_text())["endpoint"])


def numbers(folder: Path) -> dict[str, float]:
    with zmq.Context() as context:
        return ask_status(str(folder), context).numbers


# TANGRAM_MANGLE_SEEDS=1-200 runs the test below once for each of these seeds.
FIRST, LAST = map(int, os.environ.get("TANGRAM_MANGLE_SEEDS", "1-1").split("-"))


@pytest.mark.parametrize("seed", range(FIRST, LAST + 1), ids="seed={}".format)
def test_repeated_swapped_and_damaged_messages_change_nothing(folder: Path, seed: int) -> None:
    """One player behind the relay, one beside it, who must not notice."""
    print(f"seed of the mangler: {seed}")
    with (
        master(folder) as process,
        Mangler(endpoint_of(folder), seed) as mangler,
        players(setup_of(folder), f"tcp://127.0.0.1:{mangler.port}", beside=folder) as made,
    ):
        wanted = {(kind, way) for kind in KINDS for way in ("up", "down")}
        wanted -= {("a bit of an array", "down")}  # nobody asked for weights
        until(made, lambda: wanted <= mangler.done.keys())
        more_acknowledged(made, 10)
        told = {"hub/malformed", "hub/damaged", "hub/duplicates"}
        until(made, lambda: told <= numbers(folder).keys())
        assert "hub/rejected" not in numbers(folder)  # nothing of it was taken for a batch
        _, beside = made
        assert beside.client.counters.keys().isdisjoint({"reconnects", "malformed", "rejected"})
        finish(made, process)
    assert_exactly_once(folder, made)


def test_the_newest_of_two_processes_with_one_index_goes_on(folder: Path) -> None:
    with master(folder) as process:
        setup = setup_of(folder)
        with players(setup, folder) as (older,):
            more_acknowledged([older], 5)
            newer = Player(folder, older.index, setup, tag_index=1)
            with newer.client:
                assert newer.client.join()
                until([older, newer], lambda: older.client.stopped)
                assert older.client.stop_reason.startswith(
                    "player 0 was taken over by a newer process"
                )
                more_acknowledged([newer], 5)
                finish([newer], process)
    found = tags_in_replay(folder)
    for player in (older, newer):
        player.assert_exactly_once(found)
    assert len(found) >= older.acknowledged + newer.acknowledged


def test_a_connection_that_takes_anothers_name_is_not_heard(folder: Path) -> None:
    """ZeroMQ lets peers choose the name of their connection: the first one keeps it."""
    with master(folder) as process, zmq.Context() as context:
        with named(context, folder) as first:
            hello = Hello("player", 0, 0, "one", 1, setup_of(folder).fingerprints(), "")
            first.send_multipart(hello.encode())
            assert isinstance(heard(first), Welcome)
            with named(context, folder) as second:
                second.send_multipart(Heartbeat({}).encode())
                first.send_multipart(Heartbeat({}).encode())
                assert isinstance(heard(first), Alive)
                assert second.poll(500) == 0
        finish([], process)


@contextmanager
def named(context: "zmq.Context[zmq.Socket[bytes]]", folder: Path) -> Iterator[Any]:
    with context.socket(zmq.DEALER) as end:
        end.setsockopt(zmq.LINGER, 0)
        end.setsockopt(zmq.IDENTITY, b"the same")
        end.connect(endpoint_of(folder))
        yield end


def heard(end: Any) -> object:
    assert end.poll(20_000)
    return decode_from_master(end.recv_multipart(), None)
