"""Batches and orders: each is handed on once, in order, and never more than a window."""

from dataclasses import fields

import numpy as np
import pytest

from tangram_agent.messages import Ack, Alive, Go, Heartbeat, Reject, Stop, ToWorker, Welcome
from tangram_agent.types import Episodes
from tangram_sim.errors import RunError
from tests.agent.messages import (
    SPEC,
    batch,
    hello,
    with_checksum,
    with_header,
)
from tests.master.dealers import WINDOW, Dealer, staged

pytestmark = pytest.mark.cluster


def test_a_batch_arrives_as_it_was_sent_and_is_acknowledged_after_its_insert_only() -> None:
    with staged() as stage:
        dealer = stage.dealer()
        dealer.join()
        dealer.send(1)
        stage.counted("batches")
        # An answer to something sent later comes first: there was no acknowledgement before it.
        dealer.say(Heartbeat({}).encode())
        assert dealer.hear() == Alive(-1)
        [arrival] = stage.batches()
        assert (arrival.index, arrival.incarnation, arrival.sequence) == (0, 1, 1)
        assert arrival.weights_version == 7
        for field in fields(Episodes):
            sent, got = getattr(batch().episodes, field.name), getattr(arrival.episodes, field.name)
            np.testing.assert_array_equal(sent, got)
        stage.hub.acknowledge(arrival)
        assert dealer.hear() == Ack(1, duplicate=False)
        [peer] = stage.hub.peers
        assert (peer.batches, peer.episodes, peer.transitions) == (1, 3, 12)


def test_an_order_is_told_again_until_its_batch_has_come() -> None:
    with staged() as stage:
        one, other, evaluator = stage.dealer(), stage.dealer(), stage.dealer()
        one.join(index=0)
        evaluator.join(role="evaluator")
        first, second = Go(0, 0, 0, 3), Go(1, 5, 3, 3)
        stage.hub.order({0: first, 1: second})
        assert one.hear() == first
        other.say(hello(process="other", index=1).encode())  # joins after the order was given
        assert isinstance(other.hear(), Welcome)
        assert other.hear() == second
        assert heartbeat(one) == [Alive(-1), first]
        assert heartbeat(other) == [Alive(-1), second]
        one.send(1)
        stage.counted("batches")
        assert heartbeat(one) == [Alive(-1)]
        stage.hub.acknowledge(stage.batches()[0])
        assert one.hear() == Ack(1, duplicate=False)

        # Sent again, since the acknowledgement did not come in time; the next order stays.
        stage.hub.order({0: second})
        assert one.hear() == second
        one.send(1)
        assert one.hear() == Ack(1, duplicate=True)
        assert heartbeat(one) == [Alive(-1), second]
        assert heartbeat(evaluator) == [Alive(-1)]


def heartbeat(dealer: Dealer) -> list[ToWorker]:
    """All the answers to a heartbeat: those before the answer to what follows it."""
    dealer.say(Heartbeat({}).encode())
    dealer.say([b"no message"])
    answers: list[ToWorker] = []
    while not isinstance(answer := dealer.hear(), Reject):
        answers.append(answer)
    return answers


def test_a_duplicate_is_not_delivered_again() -> None:
    with staged() as stage:
        dealer = stage.dealer()
        dealer.join()
        dealer.send(1, 1, 2)
        stage.counted("batches", 2)
        # Held by the master and not inserted: counted, answered after the insert.
        assert [a.sequence for a in stage.batches()] == [1, 2]
        assert stage.hub.counters["held_duplicates"] == 1
        stage.hub.acknowledge(stage.batches()[0])
        assert dealer.hear() == Ack(1, duplicate=False)
        # Inserted, and the acknowledgement was lost: acknowledged again.
        dealer.send(1)
        assert dealer.hear() == Ack(1, duplicate=True)
        assert stage.hub.counters["duplicates"] == 1
        assert len(stage.batches()) == 2


def test_acknowledging_twice_counts_once() -> None:
    with staged() as stage:
        dealer = stage.dealer()
        dealer.join()
        dealer.send(1)
        stage.counted("batches")
        for _ in range(2):
            stage.hub.acknowledge(stage.batches()[0])
        assert dealer.hear() == Ack(1, duplicate=False)
        assert stage.hub.peers[0].batches == 1
        dealer.say(Heartbeat({}).encode())
        assert dealer.hear() == Alive(-1)


def test_a_gap_is_refused_until_it_is_filled() -> None:
    with staged() as stage:
        dealer = stage.dealer()
        dealer.join()
        dealer.send(2)
        assert dealer.hear() == Reject(
            reason="batch 2: batch 1 must come first", sequence=2, final=False
        )
        dealer.send(1, 2)
        stage.counted("batches", 2)
        assert [a.sequence for a in stage.batches()] == [1, 2]
        assert stage.hub.counters["gaps"] == 1


def test_no_more_than_a_window_is_taken_unacknowledged() -> None:
    with staged() as stage:
        dealer = stage.dealer()
        dealer.join()
        dealer.send(*range(1, WINDOW + 2))
        assert dealer.hear() == Reject(
            reason="batch 4: 3 batches are unacknowledged, the most there may be",
            sequence=4,
            final=False,
        )
        assert stage.hub.counters["over_window"] == 1
        assert len(stage.batches()) == WINDOW
        stage.hub.acknowledge(stage.batches()[0])
        dealer.send(WINDOW + 1)
        stage.counted("batches", WINDOW + 1)


def test_a_wrong_batch_is_refused_for_good_and_those_after_it_are_taken() -> None:
    with staged() as stage:
        dealer = stage.dealer()
        dealer.join(index=5)
        frames = batch(1).encode(SPEC)
        rewards = np.frombuffer(frames[4], "<f4").copy()
        rewards[0] = np.nan
        dealer.say(with_checksum([*frames[:4], rewards.tobytes(), frames[5]]))
        assert dealer.hear() == Reject(
            reason="player 5: batch 1: rewards holds nan at [0, 0], must be finite and between "
            "-1e+06 and 1e+06",
            sequence=1,
            final=True,
        )
        dealer.send(2)
        stage.counted("batches")
        assert stage.batches()[0].sequence == 2
        assert stage.hub.counters["rejected"] == 1
        # Out of turn it may be a mutation of one that will come again.
        dealer.say(with_header(batch(9).encode(SPEC), count=0))
        answer = dealer.hear()
        assert isinstance(answer, Reject)
        assert (answer.sequence, answer.final) == (9, False)
        dealer.send(3)
        stage.counted("batches", 2)


def flipped(frames: list[bytes], number: int) -> list[bytes]:
    """The lowest bit of a frame's first byte is another: an array stays within its bounds."""
    changed = list(frames)
    changed[number] = bytes([changed[number][0] ^ 1]) + changed[number][1:]
    return changed


@pytest.mark.parametrize("number", [1, 2, 3, 4, 5])
def test_a_damaged_batch_is_no_batch_and_the_true_one_is_taken_after_it(number: int) -> None:
    with staged() as stage:
        dealer = stage.dealer()
        dealer.join()
        dealer.say(flipped(batch(1).encode(SPEC), number))
        answer = dealer.hear()
        assert isinstance(answer, Reject)
        assert answer.reason.startswith("the message is damaged: its checksum is ")
        assert (answer.sequence, answer.final) == (0, False)
        assert (stage.hub.counters["damaged"], stage.arrivals) == (1, [])
        dealer.send(1)
        stage.counted("batches")
        np.testing.assert_array_equal(
            stage.batches()[0].episodes.corners, batch(1).episodes.corners
        )


def test_who_sends_nothing_but_damaged_batches_must_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("master.hub.MAX_DAMAGED", 3)
    with staged() as stage:
        dealer = stage.dealer()
        dealer.join()
        damaged = flipped(batch(1).encode(SPEC), 1)
        for _ in range(2):
            dealer.say(damaged)
            assert isinstance(dealer.hear(), Reject)
        dealer.send(1)  # an intact one: counted from the beginning
        for _ in range(2):
            dealer.say(damaged)
            assert isinstance(dealer.hear(), Reject)
            dealer.say(Heartbeat({}).encode())  # small messages may come through all the time
            assert dealer.hear() == Alive(-1)
        dealer.say(damaged)
        assert dealer.hear() == Stop(
            "3 messages of player 0 in a row were damaged on their way: look at the memory and "
            "the network of its machine"
        )


def test_after_the_end_no_batch_is_refused_for_good() -> None:
    """It was not inserted, and who forgot it would believe it was; found by the relay's test."""
    with staged() as stage:
        dealer = stage.dealer()
        dealer.join()
        stage.hub.stop("SIGTERM")
        assert dealer.hear() == Stop("SIGTERM")
        for frames in (batch(1).encode(SPEC), with_header(batch(1).encode(SPEC), count=0)):
            dealer.say(frames)
            assert dealer.hear() == Stop("SIGTERM")
        assert stage.hub.state()["player/0"]["sequence"] == 0


def test_after_a_restart_duplicates_are_known_and_the_rest_is_taken() -> None:
    with staged() as stage:
        dealer = stage.dealer()
        dealer.join(index=0, process="p")
        dealer.send(1, 2)
        stage.counted("batches", 2)
        stage.hub.acknowledge(stage.batches()[0])
        state, epoch = stage.hub.state(), stage.hub.epoch
    with staged() as stage:
        stage.hub.load_state(state)
        assert stage.hub.epoch != epoch
        dealer = stage.dealer()
        assert dealer.join(index=0, process="p", incarnation=1, first=1).incarnation == 1
        dealer.send(1, 2)
        assert dealer.hear() == Ack(1, duplicate=True)
        stage.counted("batches")
        assert stage.batches()[0].sequence == 2
        with pytest.raises(RunError, match="unknown key"):
            stage.hub.load_state({"x": {}})
