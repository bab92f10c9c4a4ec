"""The link with a real hub, over losses and restarts, and with a master that says odd things."""

import json
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar

import numpy as np
import pytest

from master.arrivals import ScoresArrived
from tangram_agent.payloads import encode_weights
from tangram_agent.types import Episodes
from tangram_agent.wire import (
    Ack,
    Alive,
    EpisodeBatch,
    Greet,
    Hello,
    Refused,
    Reject,
    Stop,
    ToMaster,
    WantWeights,
)
from tangram_sim.errors import RunError, TangramError, WireError
from tests.agent.messages import FINGERPRINTS, SHAPES, episodes, scores, weights, with_header
from tests.master.dealers import Stage, staged
from tests.worker.standin import LIMIT_S, QUICK, make_link, standing_in
from worker import link as link_module
from worker.link import Link

pytestmark = pytest.mark.cluster

Result = TypeVar("Result")


def served(stage: Stage, call: Callable[[], Result]) -> Result:
    """What a call that waits returns, while the hub is served."""
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(call)
        stage.until(future.done)
        return future.result()


@contextmanager
def joined(stage: Stage, **more: Any) -> Iterator[Link]:
    with make_link(stage.hub.endpoint, **more) as link:
        assert served(stage, link.join)
        yield link


def both(stage: Stage, link: Link, done: Callable[[], Any]) -> None:
    """Serve the hub and let the link work until something holds."""

    def step() -> Any:
        link.poll()
        return done()

    stage.until(step)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


def write_connection(folder: Path, endpoint: str, run_id: str = "run") -> None:
    aside = folder / "aside"
    aside.write_text(json.dumps({"endpoint": endpoint, "run_id": run_id}))
    aside.replace(folder / "connection.json")


def numbers(heard: list[ToMaster]) -> list[int]:
    return [message.sequence for message in heard if isinstance(message, EpisodeBatch)]


def test_a_link_joins_and_is_told_what_it_needs() -> None:
    with staged() as stage, joined(stage, index=5) as link:
        welcome = link.welcome
        assert (welcome.run_id, welcome.seed, welcome.index) == ("run", 7, 5)
        assert welcome.incarnation == 1
        assert link.window_free == 3  # the hub's window, which is smaller than the link's
        assert not link.stopped


def test_a_link_waits_for_the_connection_file(tmp_path: Path) -> None:
    with staged() as stage, make_link(str(tmp_path)) as link, ThreadPoolExecutor(1) as pool:
        future = pool.submit(link.join)
        write_connection(tmp_path, stage.hub.endpoint)
        stage.until(future.done)
        assert future.result() is True


def test_no_master_at_an_address_says_so() -> None:
    endpoint = f"tcp://127.0.0.1:{free_port()}"
    with make_link(endpoint, replace(QUICK, join_s=0.2)) as link:
        with pytest.raises(TangramError) as caught:
            link.join()
        assert str(caught.value) == (
            f"no master answers at {endpoint} after 0.2 s: is tangram-master running there?"
        )


def test_no_connection_file_says_so(tmp_path: Path) -> None:
    with make_link(str(tmp_path), replace(QUICK, join_s=0.2)) as link:
        with pytest.raises(TangramError) as caught:
            link.join()
        assert str(caught.value) == (
            f"no connection file is at {tmp_path} after 0.2 s: is tangram-master running there?"
        )


def test_before_joining_there_is_no_welcome(tmp_path: Path) -> None:
    with (
        make_link(str(tmp_path)) as link,
        pytest.raises(TangramError, match=r"has not joined a master yet: call join\(\) first"),
    ):
        _ = link.welcome


def test_a_refusal_is_raised_with_the_masters_reason() -> None:
    other = FINGERPRINTS | {"net": "other"}
    with staged() as stage, make_link(stage.hub.endpoint, fingerprints=other) as link:
        with pytest.raises(TangramError) as caught:
            served(stage, link.join)
        assert str(caught.value) == (
            f"the master at {stage.hub.endpoint} refused this player: its settings of net differ "
            "from the master's: start both with the same overrides of net"
        )


def test_a_master_of_another_protocol_is_an_error() -> None:
    with standing_in() as master, make_link(master.endpoint) as link:
        master.until(link, lambda: master.heard)
        master.say(with_header(Greet().encode(), v=99))
        with pytest.raises(
            TangramError, match=r"speaks protocol 99, this one .*: install the same"
        ):
            master.until(link, lambda: False)


def test_a_stale_connection_file_is_told(tmp_path: Path) -> None:
    with staged() as stage, make_link(str(tmp_path)) as link:
        write_connection(tmp_path, stage.hub.endpoint, "an older run")
        with pytest.raises(TangramError) as caught:
            served(stage, link.join)
        assert str(caught.value) == (
            f"the master at {stage.hub.endpoint} runs 'run', not 'an older run': the connection "
            "file is stale, take the one of a master that is running"
        )


@pytest.mark.parametrize("wait", ["join", "wait_for_window", "wait_for_weights"])
def test_stop_ends_each_wait(wait: str) -> None:
    """As a signal handler does."""
    with standing_in() as master, make_link(master.endpoint, window=1) as link:
        if wait != "join":
            master.welcome(link)
            assert link.send(episodes(), 1)
        timer = threading.Timer(0.05, link.stop, ["SIGTERM"])
        timer.start()
        assert not getattr(link, wait)()
        timer.join()
        assert (link.stopped, link.stopped_by_master, link.stop_reason) == (True, False, "SIGTERM")
        link.stop("again")
        assert link.stop_reason == "SIGTERM"
        assert link.send(episodes(), 1) is False


def test_a_real_signal_ends_a_wait(tmp_path: Path) -> None:
    with make_link(str(tmp_path)) as link:
        before = signal.signal(signal.SIGALRM, lambda *_: link.stop("SIGALRM"))
        try:
            signal.setitimer(signal.ITIMER_REAL, 0.05)
            assert link.join() is False
        finally:
            signal.signal(signal.SIGALRM, before)


def test_batches_arrive_and_are_forgotten_when_they_are_acknowledged() -> None:
    with staged() as stage, joined(stage) as link:
        for number in range(3):
            assert link.send(episodes(seed=number), number)
        stage.counted("batches", 3)
        assert link.window_free == 0
        for number, arrival in enumerate(stage.batches()):
            assert (arrival.sequence, arrival.weights_version) == (number + 1, number)
            for field in fields(Episodes):
                sent = getattr(episodes(seed=number), field.name)
                np.testing.assert_array_equal(getattr(arrival.episodes, field.name), sent)
            stage.hub.acknowledge(arrival)
        both(stage, link, lambda: link.window_free == 3)
        assert link.counters["resent"] == 0


def test_a_full_window_waits_for_an_acknowledgement() -> None:
    with staged() as stage, joined(stage, window=1) as link, ThreadPoolExecutor(1) as pool:
        assert link.send(episodes(), 1)
        stage.counted("batches")
        late = pool.submit(link.send, episodes(), 1)
        # While it waits it shows that it lives.
        beats = stage.hub.counters["heartbeats"]
        stage.until(lambda: stage.hub.counters["heartbeats"] >= beats + 2)
        assert not late.done()
        assert len(stage.batches()) == 1
        stage.hub.acknowledge(stage.batches()[0])
        stage.until(late.done)
        assert late.result() is True
        stage.counted("batches", 2)


def test_a_batch_out_of_bounds_is_not_sent() -> None:
    with staged() as stage, joined(stage) as link:
        bad = episodes()
        bad.rewards[0, 0] = np.nan
        with pytest.raises(WireError, match=r"rewards holds nan at \[0, 0\]"):
            link.send(bad, 1)
        assert link.send(episodes(), 1)
        stage.counted("batches")
        assert stage.batches()[0].sequence == 1


def test_without_an_acknowledgement_all_is_sent_again_in_order() -> None:
    with standing_in() as master, make_link(master.endpoint, replace(QUICK, resend_s=0.1)) as link:
        master.welcome(link)
        for _ in range(3):
            assert link.send(episodes(), 1)
        master.until(link, lambda: len(numbers(master.heard)) >= 6)
        assert numbers(master.heard)[:6] == [1, 2, 3, 1, 2, 3]
        master.say(Ack(1, duplicate=False), Ack(1, duplicate=True), Ack(3, duplicate=False))
        master.until(link, lambda: link.window_free == 3)
        master.heard.clear()
        master.until(link, lambda: len(numbers(master.heard)) >= 2)
        assert set(numbers(master.heard)) == {2}


def test_a_lost_acknowledgement_is_given_again() -> None:
    with (
        staged() as stage,
        joined(stage, timing=replace(QUICK, resend_s=0.1)) as link,
        pytest.MonkeyPatch.context() as patch,
    ):
        assert link.send(episodes(), 1)
        stage.counted("batches")
        with patch.context() as lossy:
            lossy.setattr(stage.hub._post, "send", lambda *_: None)
            stage.hub.acknowledge(stage.batches()[0])
        both(stage, link, lambda: link.window_free == 3)
        assert stage.hub.counters["duplicates"] >= 1
        assert len(stage.batches()) == 1


def test_what_came_out_of_turn_is_sent_again_with_all_before_it() -> None:
    with standing_in() as master, make_link(master.endpoint) as link:
        master.welcome(link)
        for _ in range(2):
            assert link.send(episodes(), 1)
        master.until(link, lambda: numbers(master.heard) == [1, 2])
        master.say(Reject(reason="batch 2: batch 1 must come first", sequence=2, final=False))
        master.until(link, lambda: numbers(master.heard) == [1, 2, 1, 2])
        assert link.counters["out_of_turn"] == 1


def test_what_is_refused_for_good_is_not_sent_again() -> None:
    with standing_in() as master, make_link(master.endpoint, replace(QUICK, resend_s=0.1)) as link:
        master.welcome(link)
        for _ in range(2):
            assert link.send(episodes(), 1)
        master.until(link, lambda: numbers(master.heard) == [1, 2])
        master.heard.clear()
        master.say(Reject(reason="player 3: rewards holds nan", sequence=1, final=True))
        master.say(Reject(reason="unknown kind", sequence=0, final=True))
        master.until(link, lambda: link.counters["rejected"] == 2)
        master.heard.clear()
        master.until(link, lambda: len(numbers(master.heard)) >= 2)
        assert set(numbers(master.heard)) == {2}


def test_hello_is_repeated_until_it_is_answered_and_says_the_same() -> None:
    with standing_in() as master, make_link(master.endpoint) as link:
        master.until(link, lambda: len(master.heard) == 2)
        assert master.heard[0] == master.heard[1]
        [hello] = master.heard[:1]
        assert isinstance(hello, Hello)
        assert (hello.index, hello.incarnation, hello.first) == (-1, 0, 1)


def test_a_restarted_master_gets_all_that_was_not_acknowledged() -> None:
    port = free_port()
    with staged(port=port) as stage, make_link(stage.hub.endpoint, shapes=SHAPES) as link:
        assert served(stage, link.join)
        stage.hub.publish(weights(version=8))
        both(stage, link, link.newest_weights)
        for number in range(3):
            assert link.send(episodes(seed=number), 8)
        stage.counted("batches", 3)
        stage.hub.acknowledge(stage.batches()[0])
        both(stage, link, lambda: link.window_free == 1)
        # The second is in the checkpoint, its acknowledgement never leaves.
        stage.hub._registry.peers[0].ledger.held.discard(2)
        state, epoch = stage.hub.state(), stage.hub.epoch
        stage.hub.close()
        with staged(port=port) as again:
            again.hub.load_state(state)
            again.hub.publish(weights(version=1))
            again.until(lambda: link.poll() or again.batches())
            assert link.welcome.epoch not in ("", epoch)
            assert (link.welcome.index, link.welcome.incarnation) == (0, 1)
            assert [a.sequence for a in again.batches()] == [3]
            again.hub.acknowledge(again.batches()[0])
            both(again, link, lambda: link.window_free == 3)
            # Version 1 of this life is newer than version 8 of the one before.
            found: list[int] = []

            def newest() -> bool:
                newer = link.newest_weights()
                found.extend([] if newer is None else [newer.version])
                return bool(found)

            both(again, link, newest)
            assert found == [1]
            assert again.hub.counters["lost_batches"] == 0


def test_a_master_on_another_port_is_found_through_its_file(tmp_path: Path) -> None:
    quick = replace(QUICK, silence_s=0.3)
    with make_link(str(tmp_path), quick) as link:
        with staged() as stage:
            write_connection(tmp_path, stage.hub.endpoint)
            assert served(stage, link.join)
            assert link.send(episodes(), 1)
            stage.counted("batches")
        with staged() as again:
            write_connection(tmp_path, again.hub.endpoint)
            both(again, link, again.batches)
            assert again.batches()[0].sequence == 1
            assert link.counters["reconnects"] >= 1


def test_a_connection_that_does_not_answer_is_made_anew() -> None:
    with standing_in() as master, make_link(master.endpoint, replace(QUICK, silence_s=0.2)) as link:
        master.welcome(link)
        first = master.identity
        assert link.send(episodes(), 1)
        again = master.await_kind(link, Hello)
        assert (again.index, again.incarnation, again.first) == (3, 2, 1)
        assert master.identity != first


def test_a_lost_master_is_given_up_in_the_end() -> None:
    timing = replace(QUICK, silence_s=0.1, lost_s=0.3)
    with standing_in() as master, make_link(master.endpoint, timing) as link:
        master.welcome(link)
        with pytest.raises(TangramError) as caught:
            master.until(link, lambda: False)
        assert str(caught.value) == (
            f"the master at {master.endpoint} has not answered for 0.3 s: is it still running?"
        )


def test_a_busy_worker_does_not_take_its_own_silence_for_the_masters(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It did not look for longer than `silence_s`, and the answer was there all the time."""
    now = time.monotonic()
    monkeypatch.setattr("worker.talk.time", SimpleNamespace(monotonic=lambda: now))
    with standing_in() as master, make_link(master.endpoint) as link:
        master.welcome(link)
        now += QUICK.heartbeat_s
        link.poll()
        master.until_heartbeat()
        master.say(Alive(-1))
        now += 2 * QUICK.silence_s
        link.poll(LIMIT_S)
        assert link.counters["reconnects"] == 0
        # Without the answer it is.
        now += QUICK.heartbeat_s
        link.poll()
        now += 2 * QUICK.silence_s
        link.poll()
        assert link.counters["reconnects"] == 1


def test_another_run_at_the_same_address_is_an_error() -> None:
    with standing_in() as master, make_link(master.endpoint) as link:
        master.welcome(link)
        master.say(Greet())
        with pytest.raises(TangramError, match="runs 'other', not 'run': the connection file is"):
            master.welcome(link, run_id="other")


def test_weights_come_newest_only_and_once() -> None:
    with staged() as stage:
        stage.hub.publish(weights(version=1))
        with joined(stage, shapes=SHAPES) as link:
            first = served(stage, link.wait_for_weights)
            assert first is not None
            assert first.version == 1
            assert first.tensors.keys() == SHAPES.keys()
            assert link.newest_weights() is None
            for version in range(2, 9):
                stage.hub.publish(weights(version))
            seen: list[int] = []

            def newest() -> bool:
                newer = link.newest_weights()
                seen.extend([] if newer is None else [newer.version])
                return 8 in seen

            both(stage, link, newest)
            assert seen == sorted(set(seen))


def test_who_was_busy_skips_all_broadcasts_but_the_newest() -> None:
    with standing_in() as master, make_link(master.endpoint) as link:
        master.welcome(link)
        frames = [encode_weights("e1", weights(version)) for version in range(500)]
        master.until(link, lambda: master.broadcast(frames[0]) or link._talk.inbox.version == 0)
        for frame in frames:
            master.broadcast(frame)
        seen: set[int] = set()

        def last() -> bool:
            seen.add(link._talk.inbox.version)
            return 499 in seen

        master.until(link, last)
        assert len(seen) < 250


def test_a_missed_broadcast_is_asked_for() -> None:
    with standing_in() as master, make_link(master.endpoint) as link:
        master.welcome(link)
        master.say(Alive(version=4))
        assert master.await_kind(link, WantWeights) == WantWeights("e1", -1)
        master.say(
            [*with_header(Greet().encode(), kind="weights"), encode_weights("e1", weights(4))]
        )
        master.until(link, lambda: link._talk.inbox.version == 4)
        newest = link.newest_weights()
        assert newest is not None
        assert newest.version == 4


def test_weights_of_another_network_are_refused_and_counted() -> None:
    with standing_in() as master, make_link(master.endpoint, shapes={"a": (1,)}) as link:
        master.welcome(link)
        frame = encode_weights("e1", weights())
        master.until(link, lambda: master.broadcast(frame) or link.counters["malformed"])
        assert link.newest_weights() is None


def test_garbage_from_the_master_is_counted() -> None:
    with standing_in() as master, make_link(master.endpoint) as link:
        master.welcome(link)
        for frames in ([b""], [b"\xc1"], with_header(Ack(1, duplicate=True).encode(), sequence=0)):
            master.say(frames)
        master.until(link, lambda: link.counters["malformed"] == 3)
        assert not link.stopped


def test_the_newest_process_of_an_index_wins() -> None:
    with staged() as stage, joined(stage, index=0) as old, joined(stage, index=0) as new:
        both(stage, old, lambda: old.stopped_by_master)
        assert old.stop_reason == "player 0 was taken over by a newer process"
        assert (new.welcome.incarnation, new.stopped) == (2, False)


def test_stop_ends_a_link_and_it_says_bye() -> None:
    with staged() as stage:
        with joined(stage) as link:
            assert link.send(episodes(), 1)
            stage.counted("batches")
            stage.hub.stop("max_updates=10")
            assert served(stage, link.wait_for_weights) is None
            assert (link.stopped_by_master, link.stop_reason) == (True, "max_updates=10")
            # The master takes nothing more, so there is nothing to wait for.
            assert link.drain(30.0) is False
        stage.counted("byes")
        assert stage.hub.peers == []


def test_a_repeated_stop_is_heard_by_who_missed_the_first() -> None:
    with standing_in() as master, make_link(master.endpoint) as link:
        master.until(link, lambda: master.heard)
        master.say(Stop("over"))
        assert link.join() is False
        assert link.stop_reason == "over"


def test_draining_waits_for_what_is_on_its_way_also_after_a_signal() -> None:
    with staged() as stage, joined(stage) as link, ThreadPoolExecutor(1) as pool:
        assert link.send(episodes(), 1)
        link.stop("SIGTERM")
        stage.counted("batches")
        assert link.drain(0.05) is False
        waiting = pool.submit(link.drain, 20.0)
        stage.hub.acknowledge(stage.batches()[0])
        stage.until(waiting.done)
        assert waiting.result() is True


def test_scores_and_stats_arrive() -> None:
    with staged() as stage, joined(stage, role="evaluator") as link:
        link.stats["episodes"] = 12.0
        link.send_scores(scores())
        stage.counted("scores")
        assert isinstance(stage.arrivals[0], ScoresArrived)
        both(stage, link, lambda: stage.hub.peers[0].stats == {"episodes": 12.0})


def test_scores_for_a_master_that_is_away_are_lost_and_counted() -> None:
    with standing_in() as master, make_link(master.endpoint) as link:
        link.send_scores(scores())
        assert link.counters["lost_scores"] == 1


def test_a_refused_rejoin_ends_the_worker() -> None:
    with standing_in() as master, make_link(master.endpoint) as link:
        master.welcome(link)
        master.say(Refused("its settings of net differ"))
        with pytest.raises(TangramError, match="refused this player: its settings of net differ"):
            master.until(link, lambda: False)


def test_closing_is_bounded_when_nobody_listens(tmp_path: Path) -> None:
    for connect in (f"tcp://127.0.0.1:{free_port()}", str(tmp_path)):
        link = make_link(connect)
        link.poll()
        link.close()


def test_an_address_that_zeromq_does_not_take() -> None:
    with make_link("tcp://bad host:5555") as link, pytest.raises(RunError) as caught:
        link.join()
    assert str(caught.value).startswith("cannot connect to tcp://bad host:5555 (")


def test_a_waiting_link_says_what_it_waits_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """First the file is missing, then the master does not answer, then it does not acknowledge."""
    monkeypatch.setattr(link_module, "TELL_S", 0.2)
    caplog.set_level("INFO")

    def said(text: str) -> bool:
        return any(text in record.message for record in caplog.records)

    def wait_until_said(link: Link, call: Callable[[], Any], text: str) -> None:
        with ThreadPoolExecutor(1) as pool:
            future = pool.submit(call)
            deadline = time.monotonic() + LIMIT_S
            while not said(text):
                assert time.monotonic() < deadline, [r.message for r in caplog.records]
                time.sleep(0.01)
            link.stop("enough")
            future.result()

    with make_link(str(tmp_path)) as link:
        wait_until_said(link, link.join, f"waits for the connection file {tmp_path} since 0 s")
    write_connection(tmp_path, f"tcp://127.0.0.1:{free_port()}")
    with make_link(str(tmp_path)) as link:
        wait_until_said(link, link.join, "waits for an answer of the master at tcp://127.0.0.1:")
    with staged() as stage, joined(stage, window=1) as link:
        link.send(episodes(), 0)
        with ThreadPoolExecutor(1) as pool:
            future = pool.submit(link.wait_for_window)
            stage.until(lambda: said("waits for the master to take what was played since"))
            link.stop("enough")
            stage.until(future.done)


def test_a_silent_master_is_told_and_its_return_too(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    timing = replace(QUICK, silence_s=0.3)
    port = free_port()
    with staged(port=port) as stage, joined(stage, timing=timing) as link:
        endpoint = stage.hub.endpoint

        def told(text: str) -> bool:
            link.poll(0.01)
            return any(text in record.message for record in caplog.records)

        deadline = time.monotonic() + LIMIT_S
        while not told(f"the master at {endpoint} has not answered for 0.3 s: tries again"):
            assert time.monotonic() < deadline
        stage.until(lambda: told(f"the master at {endpoint} answers again"))


def test_a_master_that_moved_is_followed_at_once(tmp_path: Path) -> None:
    """Its new address stands in the file; nobody waits for the old one to be silent."""
    patient = replace(QUICK, silence_s=3600.0)
    with staged() as first:
        write_connection(tmp_path, first.hub.endpoint)
        with make_link(str(tmp_path), timing=patient) as link:
            assert served(first, link.join)
            link.send(episodes(), 0)
            with staged() as second:
                write_connection(tmp_path, second.hub.endpoint)
                both(second, link, second.batches)
                (again,) = second.batches()
                assert (again.incarnation, again.sequence) == (1, 1)
                # A file that is being replaced in a clumsy way changes nothing.
                (tmp_path / "connection.json").write_text("{")
                heartbeats = second.hub.counters["heartbeats"]
                both(second, link, lambda: second.hub.counters["heartbeats"] > heartbeats + 5)
