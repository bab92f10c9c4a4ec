"""The connection to a master that is restarted, moved, silent or gone."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zmq

from tangram_core.errors import TangramError, UnavailableError
from tangram_core.wire.addresses import KEEPALIVE
from tangram_core.wire.messages import Alive, Greet, Heartbeat, Hello
from tests.agent.messages import SHAPES, episodes, weights
from tests.master.hub.dealers import staged
from tests.ports import free_ports
from tests.worker.talk.conversation import (
    LIMIT_S,
    QUICK,
    StandIn,
    both,
    joined,
    make_client,
    served,
    welcomed,
    write_connection,
)
from worker.talk import client as client_module
from worker.talk.client import Client
from worker.talk.connection import SURE, Sockets
from worker.talk.discovery import MasterAddress

pytestmark = pytest.mark.cluster


def test_a_restarted_master_gets_all_that_was_not_acknowledged() -> None:
    port = free_ports(1)
    with staged(port=port) as stage, make_client(stage.hub.endpoint, shapes=SHAPES) as client:
        assert served(stage, client.join)
        stage.hub.publish(weights(version=8))
        both(stage, client, client.newest_weights)
        for number in range(3):
            assert client.send(episodes(seed=number), 8)
        stage.counted("batches", 3)
        stage.hub.acknowledge(stage.batches()[0])
        both(stage, client, lambda: client.window_free == 1)
        # The second is in the checkpoint, its acknowledgement never leaves.
        stage.hub._registry.peers[0].ledger.held.discard(2)
        state, epoch = stage.hub.state(), stage.hub.epoch
        stage.hub.close()
        with staged(port=port) as again:
            again.hub.load_state(state)
            again.hub.publish(weights(version=1))
            again.until(lambda: client.poll() or again.batches())
            assert client.welcome.epoch not in ("", epoch)
            assert (client.welcome.index, client.welcome.incarnation) == (0, 1)
            assert [a.sequence for a in again.batches()] == [3]
            again.hub.acknowledge(again.batches()[0])
            both(again, client, lambda: client.window_free == 3)
            # Version 1 of this life is newer than version 8 of the one before.
            found: list[int] = []

            def newest() -> bool:
                newer = client.newest_weights()
                found.extend([] if newer is None else [newer.version])
                return bool(found)

            both(again, client, newest)
            assert found == [1]
            assert again.hub.counters["lost_batches"] == 0


def test_a_connection_that_does_not_answer_is_made_anew(master: StandIn) -> None:
    with welcomed(master, replace(QUICK, silence_s=0.2)) as client:
        first = master.identity
        assert client.send(episodes(), 1)
        again = master.await_kind(client, Hello)
        assert (again.index, again.incarnation, again.first) == (3, 2, 1)
        assert master.identity != first


def test_connections_that_died_without_a_word_are_found_without_pings(master: StandIn) -> None:
    """A master's weights would come no more; ZeroMQ's pings may end the process that sends them."""
    with welcomed(master) as client:
        sockets = client._connection.sockets
        assert sockets is not None
        for one in (sockets._dealer, sockets._sub):
            assert one is not None
            found = {name: one.getsockopt(getattr(zmq, name)) for name in KEEPALIVE}
            assert (found, one.getsockopt(zmq.HEARTBEAT_IVL)) == (KEEPALIVE, 0)


def test_a_lost_master_is_given_up_in_the_end(master: StandIn) -> None:
    with welcomed(master, replace(QUICK, silence_s=0.1, lost_s=0.3)) as client:
        with pytest.raises(UnavailableError) as caught:
            master.until(client, lambda: False)
        assert str(caught.value) == (
            f"the master at {master.endpoint} has not answered for 0.3 s: is it still running?"
        )


def test_a_busy_worker_does_not_take_its_own_silence_for_the_masters(
    master: StandIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It did not look for longer than `silence_s`, and the answer was there all the time."""
    now = time.monotonic()
    monkeypatch.setattr("worker.talk.client.time", SimpleNamespace(monotonic=lambda: now))
    with welcomed(master) as client:
        now += QUICK.heartbeat_s
        client.poll()
        master.until_heartbeat()
        master.say(Alive(-1))
        now += 2 * QUICK.silence_s
        client.poll(LIMIT_S)
        assert client.counters["reconnects"] == 0
        # Without the answer it is.
        now += QUICK.heartbeat_s
        client.poll()
        now += 2 * QUICK.silence_s
        client.poll()
        assert client.counters["reconnects"] == 1


def test_another_run_at_the_same_address_is_an_error(master: StandIn) -> None:
    with welcomed(master) as client:
        master.say(Greet())
        with pytest.raises(TangramError, match="runs 'other', not 'run': the connection file is"):
            master.welcome(client, run_id="other")


def test_closing_is_bounded_when_nobody_listens(tmp_path: Path) -> None:
    for connect in (f"tcp://127.0.0.1:{free_ports(1)}", tmp_path):
        client = make_client(connect)
        client.poll()
        client.close()


def test_a_waiting_client_says_what_it_waits_for(
    master: StandIn,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """First the file is missing, then the master does not answer, then it does not acknowledge."""
    monkeypatch.setattr(client_module, "TELL_S", 0.05)
    caplog.set_level("INFO")

    def until_said(client: Client, wait: Callable[[], Any], text: str) -> None:
        client.on_progress = lambda: text in caplog.text and client.stop("enough")
        wait()
        assert text in caplog.text

    with make_client(tmp_path) as client:
        until_said(client, client.join, f"waits for the connection file {tmp_path}, 0 s so far")
    nobody = f"tcp://127.0.0.1:{free_ports(1)}"
    with make_client(nobody) as client:
        until_said(client, client.join, f"waits for an answer of the master at {nobody}")
    with welcomed(master, window=1) as client:
        client.send(episodes(), 0)
        text = "waits for the master to take what was played"
        until_said(client, client.wait_for_window, text)


def test_a_host_that_dns_does_not_know_is_told_once_and_looked_up_again(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = ["no such host", "no such host", ""]
    monkeypatch.setattr("worker.talk.connection.host_error", lambda *_: answers.pop(0))
    timing = replace(QUICK, silence_s=0.1, join_s=1.0)
    with make_client("127.0.0.1:9", timing) as client:
        deadline = time.monotonic() + LIMIT_S
        while answers:
            assert time.monotonic() < deadline
            client.poll(0.01)
            error = client._connection.no_master(1.0)
            assert ("in 1 s: no such host" in str(error)) == bool(answers)
            assert isinstance(error, UnavailableError)
    assert caplog.messages.count("no such host") == 1


def test_a_silent_master_is_told_and_its_return_too(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    timing = replace(QUICK, silence_s=0.3)
    port = free_ports(1)
    with staged(port=port) as stage, joined(stage, timing=timing) as client:
        endpoint = stage.hub.endpoint

        def told(text: str) -> bool:
            client.poll(0.01)
            return any(text in record.message for record in caplog.records)

        deadline = time.monotonic() + LIMIT_S
        while not told(
            f"the master at {endpoint} has not answered for 0.3 s: tries again for 35999.7 s"
        ):
            assert time.monotonic() < deadline
        stage.until(lambda: told(f"the master at {endpoint} answers again"))


def test_an_answer_ends_doubts_about_the_keys(
    master: StandIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over weeks a few handshakes fail under load."""
    events = list[dict[str, int]]()
    monkeypatch.setattr("worker.talk.connection.recv_monitor_message", lambda _: events.pop())
    monitor = SimpleNamespace(poll=lambda _: events)

    def fails(sockets: Sockets, count: int) -> bool:
        events.extend([{"event": zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL}] * count)
        with monkeypatch.context() as seen:
            seen.setattr(sockets, "_monitor", monitor)
            seen.setattr(sockets, "_ready", [monitor])
            return sockets.handshake_failed()

    with zmq.Context() as context:
        sockets = Sockets(context, MasterAddress(master.endpoint))
        try:
            assert not fails(sockets, SURE - 1)
            sockets.send(Heartbeat({}).encode())
            while master.listen() is None:
                pass
            master.say(Greet())
            while not list(sockets.messages()):
                sockets.wait(0.1)
            assert not fails(sockets, SURE - 1)
            assert fails(sockets, 1)
        finally:
            sockets.close()


def test_a_master_that_moved_is_followed_at_once(tmp_path: Path) -> None:
    """Its new address stands in the file; nobody waits for the old one to be silent."""
    with staged() as first:
        write_connection(tmp_path, first.hub.endpoint)
        with make_client(tmp_path) as client:
            assert served(first, client.join)
            client.send(episodes(), 0)
            with staged() as second:
                write_connection(tmp_path, second.hub.endpoint)
                both(second, client, second.batches)
                (again,) = second.batches()
                assert (again.incarnation, again.sequence) == (1, 1)
                assert client.counters["reconnects"] == 1
                # A file that is being replaced in a clumsy way changes nothing.
                (tmp_path / "connection.json").write_text("{")
                heartbeats = second.hub.counters["heartbeats"]
                both(second, client, lambda: second.hub.counters["heartbeats"] > heartbeats + 5)
