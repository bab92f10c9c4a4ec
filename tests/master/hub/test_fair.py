"""Turns of keys: in the queue alone, and in a hub that one key floods."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from master.hub.fair import FairQueue
from master.hub.security import Keys, Pair, read_keys, run_keys
from tangram_core.wire.messages import (
    WORKER_COLUMNS,
    Ack,
    AskStatus,
    Heartbeat,
    Reject,
    RunStatus,
    Welcome,
    decode_from_master,
)
from tests.agent.messages import SPEC, batch, hello
from tests.master.hub.dealers import Stage, staged
from tests.worker.talk.test_security import asked, give, raw


def served(queue: FairQueue[str], count: int, cost: float = 1.0) -> str:
    """Who is served, in order."""
    return "".join(queue.first() and queue.serve(cost) for _ in range(count))


@pytest.mark.fast
def test_who_was_served_least_is_next_and_nothing_is_saved_up() -> None:
    queue = FairQueue[str]()
    for key in "a" * 14:
        queue.put(key, key)
    assert served(queue, 6) == "aaaaaa"
    for key in "bbbb":
        queue.put(key, key)
    assert len(queue) == 12
    assert served(queue, 4) == "baba"  # b has no claim to the six before
    queue.put("c", "c")
    assert served(queue, 1, cost=5.0) == "b"
    assert served(queue, 7) == "caaaaab"
    assert served(queue, len(queue)) == "a"
    with pytest.raises(IndexError, match="nothing waits"):
        queue.first()
    for key in "ab":  # who was served alone, however long, owes nobody
        queue.put(key, key)
    assert served(queue, 2) == "ab"


@pytest.fixture
def two(tmp_path: Path) -> tuple[Keys, Pair, Pair]:
    """Keys of a run, and those that two others have of it."""
    file = tmp_path / "keys.json"
    run_keys(file)
    alice, mallory = give(file, "alice"), give(file, "mallory")
    return read_keys(file), alice, mallory


def joined(stage: Stage, keys: Keys, pair: Pair, process: str) -> Any:
    end = raw(stage, keys, pair)
    assert isinstance(asked(stage, end, hello(process=process)), Welcome)
    return end


def read(stage: Stage, done: Callable[[], bool]) -> None:
    """Let the hub read, and answer nobody."""
    while not done():
        stage.hub._sockets.wait(0.1)
        stage.hub._read()


@pytest.mark.cluster
def test_a_flood_of_one_key_does_not_delay_another(
    two: tuple[Keys, Pair, Pair], monkeypatch: pytest.MonkeyPatch
) -> None:
    keys, mine, other = two
    monkeypatch.setattr("master.hub.hub.SERVE_S", 0.0)  # one answer at a time
    with staged(keys=keys) as stage:
        alice, mallory = joined(stage, keys, mine, "a"), joined(stage, keys, other, "m")
        for _ in range(30):
            mallory.send_multipart(Heartbeat({}).encode())
        read(stage, lambda: len(stage.hub._inbox) == 30)
        alice.send_multipart(batch(1).encode(SPEC))
        read(stage, lambda: len(stage.hub._inbox) == 31)
        first = [stage.hub._serve() for _ in range(3)]
        assert [len(arrived) for arrived in first].count(1) == 1


@pytest.mark.cluster
def test_what_one_key_may_leave_unread_is_bounded(
    two: tuple[Keys, Pair, Pair], monkeypatch: pytest.MonkeyPatch
) -> None:
    keys, mine, other = two
    monkeypatch.setattr("master.hub.hub.INBOX_BYTES", 3 * 1024)
    with staged(keys=keys) as stage:
        alice, mallory = joined(stage, keys, mine, "a"), joined(stage, keys, other, "m")
        for _ in range(10):
            mallory.send_multipart(Heartbeat({}).encode())
        read(stage, lambda: stage.hub.counters["crowded_out"] == 7)
        alice.send_multipart(batch(1).encode(SPEC))  # larger than the bound: one always may come
        read(stage, lambda: len(stage.hub._inbox) == 4)
        stage.until(stage.batches)
        stage.until(lambda: not len(stage.hub._inbox))
        assert not +stage.hub._unread


@pytest.mark.cluster
def test_what_one_key_may_leave_waiting_is_bounded(
    two: tuple[Keys, Pair, Pair], monkeypatch: pytest.MonkeyPatch
) -> None:
    keys, mine, other = two
    monkeypatch.setattr("master.record.delivery.MAX_BYTES", 1)
    with staged(keys=keys) as stage:
        alice, mallory = (
            joined(stage, keys, pair, name) for pair, name in ((mine, "a"), (other, "m"))
        )
        for number in (1, 2):
            mallory.send_multipart(batch(number).encode(SPEC))
        stage.until(lambda: mallory.poll(0))
        refused = decode_from_master(mallory.recv_multipart(), None)
        assert isinstance(refused, Reject)
        assert (refused.sequence, refused.final) == (2, False)
        alice.send_multipart(batch(1).encode(SPEC))
        stage.until(lambda: len(stage.batches()) == 2)
        stage.hub.acknowledge(stage.batches()[0])
        stage.until(lambda: mallory.poll(0))
        assert decode_from_master(mallory.recv_multipart(), None) == Ack(1, duplicate=False)
        mallory.send_multipart(batch(2).encode(SPEC))
        stage.until(lambda: len(stage.batches()) == 3)


@pytest.mark.cluster
def test_each_key_is_told_how_the_run_stands(
    two: tuple[Keys, Pair, Pair], monkeypatch: pytest.MonkeyPatch
) -> None:
    keys, mine, other = two
    monkeypatch.setattr("master.hub.registry.STATUS_ANSWERS", 1)
    monkeypatch.setattr("master.hub.registry.STATUS_AGAIN_S", 600.0)
    with staged(keys=keys) as stage:
        stage.hub.tell(RunStatus({"updates": 7.0}, {}, np.zeros((0, len(WORKER_COLUMNS)))))
        for pair in (other, mine):
            assert isinstance(asked(stage, raw(stage, keys, pair), AskStatus()), RunStatus)
        raw(stage, keys, other).send_multipart(AskStatus().encode())
        stage.counted("status_asked_again")


@pytest.mark.cluster
def test_a_key_pays_for_no_time_in_which_the_master_was_stopped(
    two: tuple[Keys, Pair, Pair], monkeypatch: pytest.MonkeyPatch
) -> None:
    keys, mine, other = two
    with staged(keys=keys) as stage:
        for pair, name in ((mine, "a"), (other, "m")):
            joined(stage, keys, pair, name)
        beat, inbox = raw(stage, keys, mine), stage.hub._inbox
        beat.send_multipart(Heartbeat({}).encode())
        stage.until(lambda: beat.poll(0))
        before = inbox._served["alice"]
        now = iter([*np.arange(0.0, 1.0, 1e-3), *np.arange(3600.0, 3601.0, 1e-3)])
        with monkeypatch.context() as stopped:
            heard = stage.hub._heard

            def stall(received: Any) -> Any:
                for _ in range(1000):
                    next(now)
                return heard(received)

            stopped.setattr(stage.hub, "_heard", stall)
            beat.send_multipart(Heartbeat({}).encode())
            read(stage, lambda: len(inbox) == 1)
            stopped.setattr("master.hub.hub.time.monotonic", lambda: float(next(now)))
            stage.hub._serve()
        assert 0.0 < inbox._served["alice"] - before < 1.0
