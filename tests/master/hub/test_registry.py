"""Indices and incarnations: who gets which, who wins, and what a checkpoint keeps."""

import json
from typing import Any

import pytest

from master.hub.gate import DESCRIPTORS, HANDSHAKES, RESERVE, Room
from master.hub.registry import Peer, RefusedError, Registry
from tangram_core.errors import RunError
from tangram_core.wire.messages import TAKEN_OVER, Refused, Stop
from tangram_core.wire.schema import MAX_COUNT
from tests.agent.messages import FINGERPRINTS, hello

pytestmark = pytest.mark.fast

GRACE_S = 30.0
WINDOW = 4


def admitted(registry: Registry, name: str, now: float = 0.0, **fields: Any) -> Peer:
    """Admit a process whose connection has its own name."""
    return registry.admit(name.encode(), hello(process=name, **fields), now)[0]


def restored(registry: Registry, now: float = 0.0) -> Registry:
    """The registry of a master that was restarted from its checkpoint."""
    fresh = Registry(FINGERPRINTS, GRACE_S)
    fresh.load_state(json.loads(json.dumps(registry.state())), now)
    return fresh


@pytest.fixture
def registry() -> Registry:
    return Registry(FINGERPRINTS, GRACE_S)


def test_any_index_is_the_lowest_that_is_free_within_the_role(registry: Registry) -> None:
    asked = [("a", -1), ("b", 2), ("c", -1), ("d", -1)]
    assert [admitted(registry, n, index=i).index for n, i in asked] == [0, 2, 1, 3]
    assert admitted(registry, "e", role="evaluator").index == 0
    registry.peers[2].ledger.take(1, WINDOW)
    registry.leave(registry.peers[2])  # player 1
    fresh = admitted(registry, "f")
    assert (fresh.index, fresh.incarnation) == (1, 2)
    names = ["evaluator 0", "player 0", "player 1", "player 2", "player 3"]
    assert [p.name for p in registry.peers] == names
    counts = [registry.count(role) for role in ("player", "evaluator", "other")]
    assert (len(registry), counts) == (5, [4, 1, 0])


def test_the_newest_process_of_an_index_wins_also_after_a_restart(registry: Registry) -> None:
    old = admitted(registry, "a", index=3)
    assert registry.ledger(old.key, 1) is old.ledger
    new, taken_from = registry.admit(b"b", hello(index=3, process="b"), 0.0)
    assert taken_from is old
    assert (new.incarnation, registry.peers) == (2, [new])
    assert registry.find(b"a") is None
    assert registry.ledger(old.key, 1) is None
    assert registry.ledger(("player", 9), 1) is None
    for one in (registry, restored(registry)):
        with pytest.raises(RefusedError) as caught:
            admitted(one, "a", index=3, incarnation=1)
        assert str(caught.value) == (
            "player 3 was taken over by a newer process (incarnation 2, this is 1)"
        )
    assert registry.peers == [new]
    assert admitted(restored(registry), "b", index=3, incarnation=2).incarnation == 2
    assert admitted(restored(registry), "c", index=3).incarnation == 3  # none is repeated


def test_an_index_without_batches_leaves_nothing(registry: Registry) -> None:
    """A stranger who says HELLO and BYE for each index would fill the memory."""
    for index in range(9):
        stranger = admitted(registry, f"a{index}", index=index)
        stranger.ledger.consume(1)  # a batch that is refused for good
        registry.leave(stranger)
    assert registry.state() == {}
    assert admitted(registry, "b", index=3).incarnation == 1
    # Where there was one in an earlier incarnation the number must not come again.
    used = admitted(registry, "c", index=5)
    used.ledger.take(1, WINDOW)
    for name, incarnation in (("d", 2), ("e", 3)):
        registry.leave(used)
        used = admitted(registry, name, index=5)
        assert used.incarnation == incarnation


def test_a_hello_again_changes_nothing_but_the_connection(registry: Registry) -> None:
    first = admitted(registry, "a")
    first.ledger.take(1, WINDOW)
    again, taken_from = registry.admit(b"other", hello(process="a"), 9.0)
    assert (again, taken_from, again.identity, again.last_seen) == (first, None, b"other", 9.0)
    assert (registry.find(b"a"), registry.find(b"other")) == (None, first)
    assert first.ledger.held == {1}
    # A connection belongs to one process.
    second, _ = registry.admit(b"other", hello(process="b"), 9.0)
    assert (registry.peers, registry.find(b"other")) == ([second], second)


def test_a_hello_again_of_an_incarnation_that_the_checkpoint_had_not_changes_nothing(
    registry: Registry,
) -> None:
    """It was given two numbers, kept the first one, and was told that it was taken over."""
    admitted(registry, "a", index=0).ledger.take(1, WINDOW)
    after = restored(registry)
    first = admitted(after, "c", index=0, incarnation=3)
    assert admitted(after, "c", index=0, incarnation=3) is first
    assert admitted(after, "c", index=0, incarnation=first.incarnation) is first


def test_the_silent_are_forgotten_but_not_their_batches(registry: Registry) -> None:
    peer = admitted(registry, "a", now=0.0)
    peer.ledger.take(1, WINDOW)
    busy = admitted(registry, "b", now=5.0)
    assert registry.drop_silent(10.0, silence_s=10.0) == []
    assert registry.drop_silent(10.1, silence_s=10.0) == [peer]
    assert registry.peers == [busy]
    back = admitted(registry, "a", index=0, incarnation=1)
    assert (back.incarnation, back.ledger.held) == (1, {1})


def test_a_checkpoint_keeps_incarnations_and_inserted_batches(registry: Registry) -> None:
    peer = admitted(registry, "a", index=4)
    for sequence in (1, 2, 3):
        peer.ledger.take(sequence, WINDOW)
    peer.ledger.held -= {1, 3}
    admitted(registry, "e", role="evaluator")
    assert registry.state() == {
        "evaluator/0": {"incarnation": 1, "sequence": 0, "process": "e"},
        "player/4": {"incarnation": 1, "sequence": 1, "process": "a"},
    }
    # The worker comes back and sends again what the checkpoint has not; of what it has not either
    # nothing is waited for.
    for first, received, lost in ((2, 1, 0), (5, 4, 3)):
        after = restored(registry)
        back = admitted(after, "a", index=4, incarnation=1, first=first)
        assert (back.incarnation, back.ledger.received, back.ledger.held) == (1, received, set())
        assert after.lost_batches == lost


def test_after_a_restart_indices_wait_for_their_workers_for_a_while(registry: Registry) -> None:
    admitted(registry, "a")
    soon, late = restored(registry, now=100.0), restored(registry, now=100.0)
    assert admitted(soon, "new", now=100.0 + GRACE_S - 1).index == 1
    assert admitted(soon, "a", now=100.0 + GRACE_S - 1, index=0, incarnation=1).index == 0
    assert admitted(late, "new", now=100.0 + GRACE_S).index == 0


@pytest.mark.parametrize("named", [7, 2**31, MAX_COUNT])
def test_an_incarnation_that_was_never_given_becomes_the_next(
    registry: Registry, named: int
) -> None:
    """The disk lost it, or somebody made it up: it must not become the last one of its index."""
    back = admitted(registry, "a", index=2, incarnation=named, first=12)
    assert (back.incarnation, back.ledger.received, registry.lost_batches) == (1, 11, 0)
    back.ledger.take(12, WINDOW)
    assert admitted(registry, "b", index=2).incarnation == 2
    assert admitted(registry, "c", index=2, incarnation=named, first=MAX_COUNT).incarnation == 3
    assert admitted(registry, "d", index=2, first=MAX_COUNT).ledger.received == 0  # it sent none


def test_incarnations_end_where_messages_could_not_tell_them(registry: Registry) -> None:
    registry.load_state({"player/0": {"incarnation": MAX_COUNT - 1, "sequence": 0}}, -GRACE_S)
    assert admitted(registry, "b", index=0).incarnation == MAX_COUNT
    none_left = "player 0 has no incarnation left: start with another"
    with pytest.raises(RefusedError, match=none_left) as caught:
        admitted(registry, "c", index=0)
    assert caught.value.answer == Refused(str(caught.value), later=False)
    assert admitted(registry, "c").incarnation == 1


BAD = [(0, 0), (1, -1), ("1", 0), (MAX_COUNT + 1, 0), (1, MAX_COUNT + 1)]
KEY = "the checkpoint's table of workers has the unknown key '{}'"
ENTRY = "the checkpoint's entry of player/0 must hold an incarnation from 1 and a sequence from 0, "


@pytest.mark.parametrize(
    ("state", "reason"),
    [
        *(({key: {}}, KEY.format(key)) for key in ("player", "spy/1", "player/-1", "player/65536")),
        ({"player/0": {"incarnation": 1}}, ENTRY),
        ({"player/0": 3}, ENTRY),
        *(
            ({"player/0": {"incarnation": incarnation, "sequence": sequence}}, ENTRY)
            for incarnation, sequence in BAD
        ),
    ],
)
def test_malformed_tables_are_refused(registry: Registry, state: Any, reason: str) -> None:
    with pytest.raises(RunError) as caught:
        registry.load_state(state, 0.0)
    assert str(caught.value).startswith(reason)


def test_a_full_room_lets_the_successor_of_a_process_in(registry: Registry) -> None:
    """The dead one is not known to be dead yet."""
    full = Registry(FINGERPRINTS, GRACE_S, Room(RESERVE + HANDSHAKES + 2 * DESCRIPTORS))
    dead, other = admitted(full, "a"), admitted(full, "b")
    successor, older = full.admit(b"c", hello(process="c", index=0), 1.0)
    assert (older, successor.incarnation, full.peers) == (dead, 2, [successor, other])
    raised = "the most that 228 open files allow: raise ulimit -Hn and start the master again"
    for more in ({"index": 2}, {"index": 0, "role": "evaluator"}):  # theirs would be one more
        with pytest.raises(RefusedError, match=f"2 processes take part, {raised}") as caught:
            admitted(full, "d", **more)
        assert caught.value.answer == Refused(str(caught.value), later=True)


def test_who_finds_all_indices_taken_may_come_later(
    registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("master.hub.registry.MAX_INDEX", 0)
    admitted(registry, "a")
    with pytest.raises(RefusedError, match="all 1 indices of role player are taken") as caught:
        admitted(registry, "b")
    assert caught.value.answer == Refused(str(caught.value), later=True)


def test_batches_of_the_journal_are_new_once(registry: Registry) -> None:
    registry.load_state({"player/0": {"incarnation": 2, "sequence": 5}}, 0.0)
    known, new = ("player", 0), ("player", 1)
    found = [
        registry.recover(known, 1, 9, 0.0),  # of a process that was taken over: it waited then
        registry.recover(known, 1, 9, 0.0),
        registry.recover(known, 2, 5, 0.0),  # in the checkpoint
        registry.recover(known, 2, 6, 0.0),
        registry.recover(known, 2, 6, 0.0),
        registry.recover(known, 2, 8, 0.0),  # 7 was refused for good, so the journal has it not
        registry.recover(known, 3, 1, 0.0),
        registry.recover(new, 1, 1, 0.0),
    ]
    assert found == [True, False, False, True, False, True, True, True]
    assert registry.state() == {
        "player/0": {"incarnation": 3, "sequence": 1},
        "player/1": {"incarnation": 1, "sequence": 1},
    }
    # They wait for their workers like those of a checkpoint.
    assert admitted(registry, "a", now=1.0).index == 2
    again = admitted(registry, "b", now=1.0, index=1, incarnation=1, first=2)
    assert (again.incarnation, again.ledger.inserted) == (1, 1)


@pytest.mark.parametrize("kept", ["in the journal", "in a checkpoint"])
def test_after_a_restart_an_incarnation_belongs_to_the_process_that_used_it(
    registry: Registry, kept: str
) -> None:
    """It was given twice: before a kill to one that sent nothing yet, after it to another.

    The first one's batches would have been acknowledged as those of the second.
    """
    if kept == "in the journal":
        registry.recover(("player", 0), 1, 1, 0.0, "second")
    else:
        entry = {"incarnation": 1, "sequence": 1, "process": "second"}
        registry.load_state({"player/0": entry}, 0.0)
        assert registry.state() == {"player/0": entry}
    with pytest.raises(RefusedError, match="player 0 was taken over by a newer process"):
        admitted(registry, "first", index=0, incarnation=1)
    again = admitted(registry, "second", index=0, incarnation=1)
    assert (again.incarnation, again.ledger.inserted) == (1, 1)


def test_the_indices_of_a_revoked_key_are_free_again(registry: Registry) -> None:
    """Their incarnations go on: the journal holds batches of both, and all were acknowledged."""
    for owner, index in (("alice", 0), ("mallory", 1)):
        registry.recover(("player", index), 1, 1, 0.0, owner, owner)
    registry.free_all_but(["alice"])
    later = 2.0 * GRACE_S
    with pytest.raises(RefusedError, match="player 0 takes part with another key"):
        registry.admit(b"bob", hello(process="bob", index=0), later, "bob")
    peer, _ = registry.admit(b"bob", hello(process="bob"), later, "bob")
    assert (peer.index, peer.incarnation) == (1, 2)
    restarted = Registry(FINGERPRINTS, GRACE_S)
    assert restarted.recover(("player", 1), 1, 1, 0.0, "mallory", "mallory")
    assert restarted.recover(("player", 1), 2, 1, 0.0, "bob", "bob")


def test_a_number_that_was_given_again_is_of_the_process_whose_batches_are_journalled(
    registry: Registry,
) -> None:
    """The checkpoint knows the first, which left without a batch: it may claim any number."""
    state = {"player/0": {"incarnation": 1, "sequence": 999, "process": "left", "owner": "mallory"}}
    registry.load_state(state, 0.0)
    found = [registry.recover(("player", 0), 1, n, 0.0, "second", "player") for n in (1, 2, 2)]
    assert found == [True, True, False]
    again = {"process": "second", "index": 0, "incarnation": 1, "first": 3}
    peer, _ = registry.admit(b"b", hello(**again), 0.0, "player")
    assert (peer.incarnation, peer.ledger.inserted) == (1, 2)


def test_nobody_goes_on_with_an_incarnation_whose_batches_were_dropped(registry: Registry) -> None:
    for index, present in ((0, False), (1, True)):
        peer = admitted(registry, "a", index=index)
        peer.ledger.take(1, WINDOW)
        if not present:
            registry.leave(peer)
        registry.retire(peer.key, 1)
        registry.retire(peer.key, 1)
        assert (registry.peers, registry.ledger(peer.key, 1)) == ([], None)
        with pytest.raises(RefusedError, match="was taken over by a newer process"):
            admitted(registry, "a", index=index, incarnation=1)
    assert [one["incarnation"] for one in registry.state().values()] == [2, 2]


def test_a_process_that_goes_on_with_an_older_incarnation_is_not_the_newer_one(
    registry: Registry,
) -> None:
    """Its first HELLO came late, when it had been dropped and had been given another."""
    first = admitted(registry, "a", index=4)
    first.ledger.take(1, WINDOW)
    registry.leave(first)
    assert admitted(registry, "a", index=4).incarnation == 2
    with pytest.raises(RefusedError, match="player 4 was taken over by a newer process"):
        admitted(registry, "a", index=4, incarnation=1, first=2)
    assert registry.peers == []


def test_a_process_on_the_connection_of_another_sends_that_one_away(registry: Registry) -> None:
    first, second = admitted(registry, "a"), admitted(registry, "b")
    assert registry.admit(b"b", hello(process="a"), 0.0) == (first, None)
    assert (registry.peers, registry.find(b"b")) == ([first], first)
    assert second.index == 1


@pytest.mark.parametrize("kept", ["in the journal", "in a checkpoint", "live"])
def test_an_index_stays_with_the_key_that_had_it_first(registry: Registry, kept: str) -> None:
    """Process, index and incarnation can be read in the run's folder; they prove nothing."""
    entry = {"incarnation": 1, "sequence": 1, "process": "hers", "owner": "alice"}
    if kept == "in the journal":
        registry.recover(("player", 0), 1, 1, 0.0, "hers", "alice")
    elif kept == "in a checkpoint":
        registry.load_state({"player/0": entry}, 0.0)
    else:
        registry.admit(b"hers", hello(process="hers"), 0.0, "alice")[0].ledger.take(1, WINDOW)
        registry.peers[0].ledger.release(1)
        registry.leave(registry.peers[0])
    assert registry.state() == {"player/0": entry}
    stolen = {"index": 0, "incarnation": 1, "process": "hers", "first": 1000}
    refused = "player 0 takes part with another key: leave index out, or choose another"
    gone = Stop(f"player 0 {TAKEN_OVER}")  # it may have had the index; it joins again without it
    for claim, answer in (
        (stolen, gone),
        (stolen | {"incarnation": 9}, gone),
        ({"index": 0, "process": "mine"}, Refused(refused)),
    ):
        with pytest.raises(RefusedError) as told:
            registry.admit(b"mallory", hello(**claim), 1.0, "mallory")
        assert told.value.answer == answer
    later = 2.0 * GRACE_S
    for owner in ("mallory", "player"):  # the lowest that is free is none of hers
        peer, _ = registry.admit(owner.encode(), hello(process=owner), later, owner)
        assert peer.index > 0
    again, _ = registry.admit(
        b"back", hello(process="hers", index=0, incarnation=1, first=2), later, "alice"
    )
    assert (again.incarnation, again.ledger.inserted, registry.lost_batches) == (1, 1, 0)
    # The run's own workers have their places.
    own, older = registry.admit(b"own", hello(process="own", index=0), later, "player")
    assert (own.incarnation, older) == (2, again)
