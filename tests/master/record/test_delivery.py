"""Batches of one incarnation: new, seen, missing, too many."""

from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from master.record.delivery import (
    MAX_EVALUATORS,
    EpisodesArrived,
    Exams,
    Ledger,
    Verdict,
    Waiting,
)
from tangram_core.wire.messages import EpisodeBatch

pytestmark = pytest.mark.fast

WINDOW = 3


@pytest.mark.parametrize(
    ("received", "held", "sequence", "verdict"),
    [
        (0, set(), 1, Verdict.NEW),
        (0, set(), 2, Verdict.GAP),
        (5, set(), 5, Verdict.INSERTED),
        (5, set(), 1, Verdict.INSERTED),
        (5, set(), 6, Verdict.NEW),
        (5, set(), 7, Verdict.GAP),
        (5, {4, 5}, 4, Verdict.HELD),
        (5, {4, 5}, 3, Verdict.INSERTED),
        (5, {4, 5}, 6, Verdict.NEW),
        (5, {3, 4, 5}, 6, Verdict.EXCESS),
        (5, {3, 4, 5}, 7, Verdict.GAP),
        (5, {3, 4, 5}, 4, Verdict.HELD),
    ],
)
def test_what_to_do_with_a_batch(
    received: int, held: set[int], sequence: int, verdict: Verdict
) -> None:
    assert Ledger(1, received, held=held).judge(sequence, WINDOW) is verdict


@pytest.mark.parametrize(
    ("received", "held", "inserted"),
    [(0, set(), 0), (5, set(), 5), (5, {5}, 4), (5, {3, 5}, 2), (5, {3}, 2)],
)
def test_inserted_is_what_a_restart_may_rely_on(
    received: int, held: set[int], inserted: int
) -> None:
    assert Ledger(1, received, held=held).inserted == inserted


def test_skipping_counts_what_never_came() -> None:
    ledger = Ledger(1, 5)
    assert (ledger.skip_to(4), ledger.received) == (0, 5)
    assert (ledger.skip_to(6), ledger.received) == (0, 5)
    assert (ledger.skip_to(9), ledger.received) == (3, 8)


@given(st.lists(st.tuples(st.sampled_from(["send", "insert", "restart"]), st.integers(0, 9))))
def test_over_any_losses_each_batch_is_inserted_once_and_in_order(
    steps: list[tuple[str, int]],
) -> None:
    """A naive worker that sends any of its batches again and again, and restarts of the master."""
    ledger, held, inserted = Ledger(1), [], []
    checkpoint: tuple[int, list[int]] = (0, [])
    for action, number in steps:
        if action == "send":
            sequence = number + 1
            if ledger.take(sequence, WINDOW) is Verdict.NEW:
                held.append(sequence)
        elif action == "insert" and held:
            sequence = held.pop(number % len(held))
            ledger.held.discard(sequence)
            inserted.append(sequence)
            assert len(ledger.held) <= WINDOW
            if not held:
                checkpoint = (ledger.inserted, list(inserted))
        elif action == "restart":
            ledger, held, inserted = Ledger(1, checkpoint[0]), [], list(checkpoint[1])
        assert sorted(inserted + held) == list(range(1, ledger.received + 1))
        assert ledger.held == set(held)


@pytest.mark.parametrize(("lockstep", "room"), [(False, 0), (True, WINDOW - 1)])
def test_a_round_in_lockstep_has_room_whatever_its_size(
    monkeypatch: pytest.MonkeyPatch, lockstep: bool, room: int
) -> None:
    monkeypatch.setattr("master.record.delivery.MAX_BYTES", 1)
    waiting, batch = Waiting(WINDOW, lockstep), cast(EpisodeBatch, None)
    waiting.add(EpisodesArrived("player", 0, 1, batch, [b"xx"]))
    assert waiting.room(("player", 0), Ledger(1, 0), 1) == room


def test_evaluators_of_one_key_leave_those_of_others_their_scores() -> None:
    exams = Exams()
    exams.published(7)
    told = [exams.take(7, index, "guest") for index in range(MAX_EVALUATORS + 1)]
    assert told[:-1] == [""] * MAX_EVALUATORS
    assert told[-1].endswith("which is the limit")
    assert exams.take(7, 0, "evaluator") == ""
    assert exams.take(7, 0, "evaluator") == "it has scored weights 7 before"
