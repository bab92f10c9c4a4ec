"""The client with a real hub, over losses and stops, and with a master that says odd things."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tangram_core.errors import RunError, TangramError, UnavailableError, WireError
from tangram_core.wire.messages import (
    Ack,
    Alive,
    Go,
    Greet,
    Hello,
    Refused,
    Reject,
    Scores,
    Stop,
    WantWeights,
    WeightsMessage,
)
from tests.agent.messages import SHAPES, broadcast, episodes, scores, weights, with_header
from tests.master.hub.dealers import Stage
from tests.ports import free_ports
from tests.worker.talk.conversation import (
    QUICK,
    StandIn,
    both,
    joined,
    make_client,
    numbers,
    served,
    welcomed,
    write_connection,
)

pytestmark = pytest.mark.cluster

SENT_AGAIN = replace(QUICK, resend_s=0.1)


def test_a_client_waits_for_the_connection_file_and_is_told_what_it_needs(
    stage: Stage, tmp_path: Path
) -> None:
    with make_client(tmp_path, index=5) as client, ThreadPoolExecutor(1) as pool:
        with pytest.raises(TangramError, match=r"not joined a master yet: call join\(\) first"):
            _ = client.welcome
        future = pool.submit(client.join)
        write_connection(tmp_path, stage.hub.endpoint)
        stage.until(future.done)
        assert future.result() is True
        welcome = client.welcome
        assert (welcome.run_id, welcome.seed, welcome.index) == ("run", 7, 5)
        assert (welcome.incarnation, client.stopped) == (1, False)
        assert client.window_free == 3  # the hub's window, which is smaller than the client's


@pytest.mark.parametrize("what", ["address", "file"])
def test_no_master_in_time_says_where_none_is(tmp_path: Path, what: str) -> None:
    endpoint = f"tcp://127.0.0.1:{free_ports(1)}"
    connect, nobody = {
        "address": (endpoint, f"no master answers at {endpoint} after 0.2 s"),
        "file": (
            tmp_path,
            f"no connection file is at {tmp_path} after 0.2 s, or its sockets do not exist",
        ),
    }[what]
    with make_client(connect, replace(QUICK, join_s=0.2)) as client:
        with pytest.raises(UnavailableError) as caught:
            client.join()
        assert str(caught.value) == f"{nobody}: is tangram-master running there?"


@pytest.mark.parametrize(
    ("answer", "reason", "later"),
    [
        (Refused("its settings of net differ"), "refused this player: its settings of net", False),
        (Refused("100 take part", later=True), "refused this player: 100 take part", True),
        (with_header(Greet().encode(), v=99), "speaks protocol 99, .*: install the same", False),
    ],
)
@pytest.mark.parametrize("before", [True, False])
def test_a_master_that_does_not_fit_ends_a_worker(
    master: StandIn, answer: Refused | list[bytes], reason: str, later: bool, before: bool
) -> None:
    with make_client(master.endpoint) as client:
        master.until(client, lambda: master.heard)
        if before:  # it had been welcomed
            master.welcome(client)
        master.say(answer)
        with pytest.raises(TangramError, match=reason) as caught:
            master.until(client, lambda: False)
        assert isinstance(caught.value, UnavailableError) == later


def test_a_master_of_another_run_gets_nothing(master: StandIn, tmp_path: Path) -> None:
    """One that took the port of a master that is gone, and says yes to everybody."""
    write_connection(tmp_path, master.endpoint, "mine")
    with make_client(tmp_path) as client:
        hello = master.await_kind(client, Hello)
        assert isinstance(hello, Hello)
        assert hello.run_id == "mine"
        master.say(master.welcome_message())
        with pytest.raises(TangramError, match="runs 'run', not 'mine': the connection file is st"):
            master.until(client, lambda: False)


def test_an_address_that_zeromq_does_not_take() -> None:
    with make_client("tcp://-:5555") as client, pytest.raises(RunError) as caught:
        client.join()
    assert str(caught.value).startswith("cannot connect to tcp://-:5555 (")


@pytest.mark.parametrize("wait", ["join", "wait_for_window", "wait_for_weights"])
def test_stop_ends_each_wait(master: StandIn, wait: str) -> None:
    """As a signal handler does."""
    with make_client(master.endpoint, window=1) as client:
        if wait != "join":
            master.welcome(client)
            assert client.send(episodes(), 1)
        timer = threading.Timer(0.05, client.stop, ["SIGTERM"])
        timer.start()
        assert not getattr(client, wait)()
        timer.join()
        client.stop("again")
        assert (client.stopped, client.stop_reason) == (True, "SIGTERM")
        assert client.send(episodes(), 1) is False


def test_a_full_window_waits_for_an_acknowledgement(stage: Stage) -> None:
    with joined(stage, window=1) as client, ThreadPoolExecutor(1) as pool:
        assert client.send(episodes(), 1)
        stage.counted("batches")
        late = pool.submit(client.send, episodes(), 2)
        # While it waits it shows that it lives.
        beats = stage.hub.counters["heartbeats"]
        stage.until(lambda: stage.hub.counters["heartbeats"] >= beats + 2)
        assert not late.done()
        assert len(stage.batches()) == 1
        stage.hub.acknowledge(stage.batches()[0])
        stage.until(late.done)
        assert late.result() is True
        stage.counted("batches", 2)
        told = [(batch.sequence, batch.weights_version) for batch in stage.batches()]
        assert told == [(1, 1), (2, 2)]
        assert client.counters["resent"] == 0


def test_a_number_that_a_killed_master_had_refused_for_good_is_passed_over(stage: Stage) -> None:
    """It is in no journal, so the next master waits for it."""
    with make_client(stage.hub.endpoint) as client:
        assert served(stage, client.join)
        client.outbox.next = 2
        client.send(episodes(), 0)
        both(stage, client, stage.batches)
        assert [batch.sequence for batch in stage.batches()] == [2]


def test_a_batch_out_of_bounds_is_not_sent(stage: Stage) -> None:
    with joined(stage) as client:
        bad = episodes()
        bad.rewards[0, 0] = np.nan
        with pytest.raises(WireError, match=r"rewards holds nan at \[0, 0\]") as refused:
            client.send(bad, 1)
        assert refused.value.status == 1  # if it ends the worker, another is started
        assert client.send(episodes(), 1)
        stage.counted("batches")
        assert stage.batches()[0].sequence == 1


def test_without_an_acknowledgement_all_is_sent_again_in_order(master: StandIn) -> None:
    with welcomed(master, SENT_AGAIN) as client:
        for _ in range(3):
            assert client.send(episodes(), 1)
        master.until(client, lambda: len(numbers(master.heard)) >= 6)
        assert numbers(master.heard)[:6] == [1, 2, 3, 1, 2, 3]
        master.say(Ack(1, duplicate=False), Ack(1, duplicate=True), Ack(3, duplicate=False))
        master.until(client, lambda: client.window_free == 3)
        master.heard.clear()
        master.until(client, lambda: len(numbers(master.heard)) >= 2)
        assert set(numbers(master.heard)) == {2}


@pytest.mark.parametrize(
    ("acknowledged", "seconds"),
    [
        ((), [10, 30, 70, 150, 230, 310]),
        # The master is at work again: as in the beginning.
        ((30,), [10, 30, 40, 60, 100, 180, 260, 340]),
        ((30, 70), [10, 30, 40, 60, 80, 100, 140, 220, 300]),
    ],
)
def test_a_master_that_is_behind_is_sent_all_again_less_and_less_often(
    master: StandIn, acknowledged: tuple[int, ...], seconds: list[int]
) -> None:
    """Ten seconds after the first batch, then twice as long each time, up to eight times."""
    slow = replace(QUICK, resend_s=10.0, heartbeat_s=1e6, silence_s=1e6)
    with welcomed(master, slow) as client:
        for _ in range(3):
            assert client.send(episodes(), 1)
        begin, sent = client._resend_at - 10.0, list[int]()
        sockets, answers = client._connection.sockets, iter((1, 2))
        assert sockets is not None
        for second in range(350):
            before = client.counters["resent"]
            client._do_what_is_due(sockets, begin + second)
            if client.counters["resent"] > before:
                sent.append(second)
            if second in acknowledged:
                client._handle(Ack(next(answers), duplicate=False), begin + second)
        assert sent == seconds


def test_what_came_out_of_turn_is_sent_again_with_all_before_it(master: StandIn) -> None:
    with welcomed(master) as client:
        for _ in range(2):
            assert client.send(episodes(), 1)
        master.until(client, lambda: numbers(master.heard) == [1, 2])
        master.say(Reject(reason="batch 2: batch 1 must come first", sequence=2, final=False))
        master.until(client, lambda: numbers(master.heard) == [1, 2, 1, 2])
        assert client.counters["out_of_turn"] == 1


def test_what_is_refused_again_and_again_is_sent_less_and_less_often(master: StandIn) -> None:
    slow = replace(QUICK, resend_s=10.0, retry_s=1.0, heartbeat_s=1e6, silence_s=1e6)
    full = Reject(reason="64 batches wait already", sequence=1, final=False)
    with welcomed(master, slow) as client:
        assert client.send(episodes(), 1)
        sockets, now, sent = client._connection.sockets, time.monotonic(), list[int]()
        assert sockets is not None
        for second in range(32):
            before = client.counters["resent"]
            client._do_what_is_due(sockets, now + second)
            if client.counters["resent"] > before or not second:
                sent.append(second)
                client._handle(full, now + second)
        assert sent == [0, 1, 3, 7, 15, 23, 31]


def test_what_is_refused_for_good_is_not_sent_again(master: StandIn) -> None:
    with welcomed(master, SENT_AGAIN) as client:
        for _ in range(2):
            assert client.send(episodes(), 1)
        master.until(client, lambda: numbers(master.heard)[:2] == [1, 2])
        master.say(Reject(reason="player 3: rewards holds nan", sequence=1, final=True))
        master.say(Reject(reason="unknown kind", sequence=0, final=True))
        master.until(client, lambda: client.counters["rejected"] == 2)
        client.stats["rejected"] = 2.0
        master.until(client, lambda: master.stats)  # what was sent before that has been heard
        master.heard.clear()
        master.until(client, lambda: len(numbers(master.heard)) >= 2)
        assert set(numbers(master.heard)) == {2}


def test_in_lockstep_what_was_refused_is_played_again(master: StandIn) -> None:
    order = Go(4, 9, 12, 3)
    with welcomed(master) as client:
        master.say(order)
        assert client.wait_for_order(None) == order
        assert client.send(episodes(3), 9)
        master.until(client, lambda: numbers(master.heard) == [1])
        master.say(Reject(reason="scores are not yours", sequence=0, final=True), order)
        master.until(client, lambda: client.counters["rejected"] == 1)
        client.on_progress = lambda: client.stop("nothing new")  # told again, as with a heartbeat
        assert client.wait_for_order(order) is None
    with welcomed(master) as client:
        master.say(order)
        assert client.wait_for_order(None) == order
        assert client.send(episodes(3), 9)
        master.until(client, lambda: numbers(master.heard)[-1:] == [1])
        master.say(Reject(reason="player 3: rewards holds nan", sequence=1, final=True))
        master.until(client, lambda: client.counters["rejected"] == 1)
        assert client.wait_for_order(order) == order


@pytest.mark.parametrize("playing", [False, True])
def test_of_another_master_the_index_counts_and_the_same_order_is_played_again(
    master: StandIn, playing: bool
) -> None:
    """If it has lost the batch, but not what is being played; a WELCOME may have come late."""
    order = Go(4, 9, 12, 3)
    with welcomed(master) as client:
        master.say(order)
        assert client.wait_for_order(None) == order
        master.say(master.welcome_message(epoch="another", index=5))
        master.until(client, lambda: client.welcome.index == 5)
        if playing:
            client.send(episodes(3), 9)
        master.say(order)
        master.until(client, lambda: client._order == order)
        if playing:
            client.on_progress = lambda: client.stop("played already")
        assert client.wait_for_order(order) == (None if playing else order)


def test_a_master_that_went_on_in_another_mode_is_left(master: StandIn) -> None:
    """It ordered nothing, and its worker waited for orders."""
    with welcomed(master) as client:
        master.say(master.welcome_message(epoch="another", lockstep=True))
        with pytest.raises(TangramError, match=r"another service\.mode now: start this worker"):
            master.until(client, lambda: False)


def test_whoever_watches_sees_a_client_at_work(tmp_path: Path) -> None:
    seen: list[int] = []
    with make_client(tmp_path) as client:
        client.on_progress = lambda: seen.append(len(seen))
        client.poll()
        client.poll()
    assert seen == [0, 1]


def test_hello_is_repeated_until_it_is_answered_and_says_the_same(master: StandIn) -> None:
    with make_client(master.endpoint) as client:
        master.until(client, lambda: len(master.heard) == 2)
        hello, again = master.heard
        assert hello == again
        assert isinstance(hello, Hello)
        assert (hello.index, hello.incarnation, hello.first) == (-1, 0, 1)


def test_weights_come_newest_only_and_once(stage: Stage) -> None:
    stage.hub.publish(weights(version=1))
    with joined(stage, shapes=SHAPES) as client:
        first = served(stage, client.wait_for_weights)
        assert first is not None
        assert first.version == 1
        assert first.tensors.keys() == SHAPES.keys()
        assert client.newest_weights() is None
        seen: list[int] = []

        def newest() -> bool:
            newer = client.newest_weights()
            seen.extend([] if newer is None else [newer.version])
            return 8 in seen

        for version in range(2, 9):
            stage.hub.publish(weights(version))
        both(stage, client, newest)
        assert seen == sorted(set(seen))


def test_who_was_busy_skips_all_broadcasts_but_the_newest(master: StandIn) -> None:
    with welcomed(master) as client:
        frames = [broadcast(weights(version), "e1") for version in range(500)]
        master.until(client, lambda: master.broadcast(frames[0]) or client.newest.version == 0)
        for frame in frames:
            master.broadcast(frame)
        seen: set[int] = set()

        def last() -> bool:
            seen.add(client.newest.version)
            return 499 in seen

        master.until(client, last)
        assert len(seen) < 250


def test_a_missed_broadcast_is_asked_for(master: StandIn) -> None:
    with welcomed(master) as client:
        master.say(Alive(version=4))
        assert master.await_kind(client, WantWeights) == WantWeights("e1", -1)
        master.say(WeightsMessage("e1", weights(4)).encode())
        master.until(client, lambda: client.newest.version == 4)
        newest = client.newest_weights()
        assert newest is not None
        assert newest.version == 4


def test_garbage_and_weights_of_another_network_are_refused_and_counted(master: StandIn) -> None:
    with welcomed(master, shapes={"a": (1,)}) as client:
        for frames in ([b""], [b"\xc1"], with_header(Ack(1, duplicate=True).encode(), sequence=0)):
            master.say(frames)
        master.until(client, lambda: client.counters["malformed"] == 3)
        frame = broadcast(weights(), "e1")
        master.until(client, lambda: master.broadcast(frame) or client.counters["malformed"] > 3)
        assert client.newest_weights() is None
        assert not client.stopped


def test_stop_ends_a_client_and_it_says_bye(stage: Stage) -> None:
    with joined(stage) as client:
        assert client.send(episodes(), 1)
        stage.counted("batches")
        stage.hub.stop("max_updates=10")
        assert served(stage, client.wait_for_weights) is None
        assert (client.stopped, client.stop_reason) == (True, "max_updates=10")
    stage.counted("byes")
    assert stage.hub.peers == []


def test_a_repeated_stop_is_heard_by_who_missed_the_first(master: StandIn) -> None:
    with make_client(master.endpoint) as client:
        master.until(client, lambda: master.heard)
        master.say(Stop("over"))
        assert client.join() is False
        assert client.stop_reason == "over"


def test_scores_and_stats_arrive_and_without_a_master_scores_are_lost_and_counted(
    stage: Stage,
) -> None:
    with make_client(stage.hub.endpoint, role="evaluator", index=2) as client:
        client.send_scores(scores())
        assert client.counters["lost_scores"] == 1
        assert served(stage, client.join)
        client.stats["episodes"] = 12.0
        stage.hub.publish(weights(scores().weights_version))
        client.send_scores(scores())
        stage.counted("scores")
        [arrival] = stage.arrivals
        assert isinstance(arrival, Scores)
        assert arrival.scalars == scores().scalars
        np.testing.assert_array_equal(arrival.picture, scores().picture)
        both(stage, client, lambda: stage.hub.peers[0].stats == {"episodes": 12.0})
