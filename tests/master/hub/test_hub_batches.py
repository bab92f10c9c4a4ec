"""Batches and orders: each is handed on once, in order, and never more than a window."""

from dataclasses import replace

import numpy as np
import pytest

from master.record.journal import MARK
from tangram_core.wire.messages import Ack, Alive, Bye, Go, Reject, Stop, Welcome
from tests.agent.messages import SPEC, batch, hello, with_checksum, with_header
from tests.master.hub.dealers import INFO, WINDOW, Dealer, Stage, staged

pytestmark = pytest.mark.cluster


def test_a_batch_arrives_as_it_was_sent_and_is_acknowledged_after_its_insert_only(
    stage: Stage, player: Dealer
) -> None:
    player.send(1)
    stage.counted("batches")
    assert player.beat() == [Alive(-1)]  # and no acknowledgement before it
    [arrival] = stage.batches()
    assert (arrival.index, arrival.incarnation, arrival.sequence) == (0, 1, 1)
    assert arrival.weights_version == 7
    for name, sent in batch().episodes.arrays.items():
        np.testing.assert_array_equal(sent, arrival.episodes[name])
    for _ in range(2):
        stage.hub.acknowledge(arrival)
    assert player.beat() == [Ack(1, duplicate=False), Alive(-1)]
    [peer] = stage.hub.peers
    assert (peer.batches, peer.episodes, peer.transitions) == (1, 3, 12)


def test_in_lockstep_a_batch_is_what_was_ordered_or_it_is_ordered_again() -> None:
    with staged(info=replace(INFO, lockstep=True)) as stage:
        player = stage.dealer()
        player.join(index=0)
        # As after a restart: it was played for an order of the master before this one.
        waits = "player 0: batch 1: this player has no order now"
        player.send(1)
        assert player.hear() == Reject(reason=waits, sequence=1, final=False)
        order = Go(4, 9, 12, 3)
        for few in (Go(4, 7, 12, 2), order):  # another number of episodes, other weights
            stage.hub.order({0: few})
            assert player.hear() == few
            player.send(1 if few.episodes == 2 else 2)
            refused = player.hear()
            assert isinstance(refused, Reject)
            assert refused.final
            assert refused.reason.endswith(
                f"3 episodes with weights 7, but the order was {few.episodes} "
                f"with weights {few.version}"
            )
            assert player.hear() == few
        stage.hub.order({0: Go(4, 7, 12, 3)})
        assert player.hear() == Go(4, 7, 12, 3)
        player.send(3)
        stage.counted("batches")
        # It came, so that nothing more is ordered: a second one waits, the first is known.
        assert player.ask(batch(4).encode(SPEC)) == Reject(
            reason="player 0: batch 4: this player has no order now", sequence=4, final=False
        )
        stage.hub.acknowledge(stage.batches()[0])
        assert player.hear() == Ack(3, duplicate=False)
        assert player.ask(batch(3).encode(SPEC)) == Ack(3, duplicate=True)
        assert len(stage.batches()) == 1


def test_in_lockstep_a_restarted_master_gives_the_first_index_to_whoever_comes() -> None:
    """It kept it for a worker that had ended, and ordered what nobody was there to play."""
    with staged(info=replace(INFO, lockstep=True)) as stage:
        known = {"player/0": {"incarnation": 1, "sequence": 4}}
        stage.hub.load_state(known)
        assert stage.dealer().join().index == 0


def test_an_order_is_told_again_until_its_batch_has_come(stage: Stage) -> None:
    one, other, evaluator = stage.dealer(), stage.dealer(), stage.dealer()
    one.join(index=0)
    evaluator.join(role="evaluator")
    first, second = Go(0, 0, 0, 3), Go(1, 5, 3, 3)
    stage.hub.order({0: first, 1: second})
    assert one.hear() == first
    # This one joins after the order was given.
    assert isinstance(other.ask(hello(process="other", index=1)), Welcome)
    assert other.hear() == second
    assert one.beat() == [Alive(-1), first]
    assert other.beat() == [Alive(-1), second]
    one.send(1)
    stage.counted("batches")
    assert one.beat() == [Alive(-1)]
    stage.hub.acknowledge(stage.batches()[0])
    assert one.hear() == Ack(1, duplicate=False)

    # Sent again, since the acknowledgement did not come in time; the next order stays.
    stage.hub.order({0: second})
    assert one.hear() == second
    assert one.ask(batch(1).encode(SPEC)) == Ack(1, duplicate=True)
    assert one.beat() == [Alive(-1), second]
    assert evaluator.beat() == [Alive(-1)]


def test_duplicates_gaps_and_what_is_over_the_window_are_not_delivered(
    stage: Stage, player: Dealer
) -> None:
    """The words are those of the ledger, whose own tests have every case."""
    player.send(2)
    gap = "batch 2: batch 1 must come first"
    assert player.hear() == Reject(reason=gap, sequence=2, final=False)
    player.send(1, 1, *range(2, WINDOW + 2))  # the second 1 is held: answered after its insert
    excess = "batch 4: 3 batches are unacknowledged, which is the limit"
    assert player.hear() == Reject(reason=excess, sequence=4, final=False)
    assert [a.sequence for a in stage.batches()] == [1, 2, 3]
    stage.hub.acknowledge(stage.batches()[0])
    assert player.hear() == Ack(1, duplicate=False)
    assert player.ask(batch(1).encode(SPEC)) == Ack(1, duplicate=True)  # the first was lost
    player.send(WINDOW + 1)
    stage.counted("batches", WINDOW + 1)
    for name in ("gaps", "held_duplicates", "over_window", "duplicates"):
        assert stage.hub.counters[name] == 1, name


def test_a_wrong_batch_is_refused_for_good_and_those_after_it_are_taken(stage: Stage) -> None:
    dealer = stage.dealer()
    dealer.join(index=5)
    frames = batch(1).encode(SPEC)
    rewards = np.frombuffer(frames[5], "<f4").copy()
    rewards[0] = np.nan
    wrong = with_checksum([*frames[:5], rewards.tobytes(), frames[6]])
    assert dealer.ask(wrong) == Reject(
        reason="player 5: batch 1: rewards holds nan at [0, 0], must be finite and between "
        "-1 and 1",
        sequence=1,
        final=True,
    )
    again = dealer.ask(wrong)  # the answer was lost
    assert isinstance(again, Reject)
    assert (again.sequence, again.final) == (1, True)
    dealer.send(2)
    stage.counted("batches")
    assert stage.batches()[0].sequence == 2
    assert stage.hub.counters["rejected"] == 2
    # Out of turn it may be a mutation of one that will come again. A worker whose first batch this
    # is must learn that one is missing: a killed master refused that for good.
    answer = dealer.ask(with_header(batch(9).encode(SPEC), count=0))
    assert answer == Reject("player 5: batch 9: batch 3 must come first", 9, final=False)
    dealer.send(3)
    stage.counted("batches", 2)


def test_a_batch_with_the_mark_of_the_journals_records_is_refused_for_good(stage: Stage) -> None:
    """Else what a player wrote could be read as a record where the disk is damaged."""
    dealer = stage.dealer()
    dealer.join(index=5)
    frames = batch(1).encode(SPEC)
    states = MARK + frames[1][len(MARK) :]
    answer = dealer.ask(with_checksum([frames[0], states, *frames[2:]]))
    assert answer == Reject("player 5: batch 1: it has the mark of our records", 1, final=True)
    dealer.send(2)
    stage.counted("batches")
    assert stage.batches()[0].sequence == 2


def flipped(number: int) -> list[bytes]:
    """A batch with the lowest bit of a frame changed: an array stays within its bounds."""
    frames = batch(1).encode(SPEC)
    frames[number] = bytes([frames[number][0] ^ 1]) + frames[number][1:]
    return frames


def test_a_damaged_batch_is_no_batch_and_who_sends_nothing_else_must_end(
    stage: Stage, player: Dealer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("master.hub.hub.MAX_DAMAGED", 6)
    for number in range(1, 6):
        answer = player.ask(flipped(number))
        assert isinstance(answer, Reject)
        assert answer.reason.startswith("the message is damaged: its checksum is ")
        assert (answer.sequence, answer.final) == (0, False)
    assert (stage.hub.counters["damaged"], stage.arrivals) == (5, [])
    player.send(1)  # an intact one: counted from the beginning
    stage.counted("batches")
    np.testing.assert_array_equal(
        stage.batches()[0].episodes["corners"], batch(1).episodes["corners"]
    )
    for _ in range(5):
        assert isinstance(player.ask(flipped(1)), Reject)
        assert player.beat() == [Alive(-1)]  # small messages may come through all the time
    assert player.ask(flipped(1)) == Stop(
        "6 messages of player 0 in a row were damaged on their way: check the memory and the "
        "network of its machine"
    )


def test_batches_that_wait_are_bounded_over_all_processes_of_an_index(stage: Stage) -> None:
    """Each HELLO of a new process began a new window, and memory had no bound."""
    for number in range(4):
        dealer = stage.dealer()
        dealer.join(index=0, process=f"p{number}")
        dealer.send(1)
        if number < WINDOW:
            stage.counted("batches", number + 1)
        else:
            answer = dealer.hear()
            assert isinstance(answer, Reject)
            assert not answer.final
    assert len(stage.batches()) == WINDOW
    stage.hub.acknowledge(stage.batches()[0])  # of a process that was taken over
    dealer.send(1)
    stage.counted("batches", WINDOW + 1)


def test_batches_that_wait_are_bounded_over_those_who_have_left(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Index after index would fill the memory, a window each."""
    monkeypatch.setattr("master.record.delivery.SPARE_PEERS", 0)
    left, late = stage.dealer(), stage.dealer()
    left.join(process="left")
    left.send(*range(1, WINDOW + 1))
    left.say(Bye("done"))
    stage.until(lambda: not stage.hub.peers)
    late.join(process="late", index=5)
    answer = late.ask(batch(1).encode(SPEC))
    assert isinstance(answer, Reject)
    assert not answer.final
    stage.hub.acknowledge(stage.batches()[0])
    late.send(1)
    stage.counted("batches", WINDOW + 1)
    for arrival in stage.batches()[1:]:
        stage.hub.acknowledge(arrival)
    assert not stage.hub._waiting._of


def test_what_the_disk_lost_is_told_when_its_worker_comes_back(
    stage: Stage, caplog: pytest.LogCaptureFixture
) -> None:
    stage.hub.load_state({"player/0": {"incarnation": 1, "sequence": 5}})
    for first, lost in ((6, 0), (9, 3), (9, 3)):
        dealer = stage.dealer()
        dealer.join(index=0, incarnation=1, first=first)
        assert stage.hub.counters["lost_batches"] == lost
        dealer.say(Bye("done"))
        stage.until(lambda: not stage.hub.peers)
    assert [r.message for r in caplog.records] == [
        "losses (number 1): player 0 reports 3 acknowledged batches that are not in "
        "the replay: if this is right, the disk has lost them"
    ]
