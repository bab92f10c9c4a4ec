"""The hub with peers that keep the rules and peers that do not, on real sockets."""

import os
import socket
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from master.arrivals import ScoresArrived
from master.hub import Hub
from tangram_agent.decoding import decode_from_master
from tangram_agent.frames import PROTOCOL
from tangram_agent.payloads import decode_weights
from tangram_agent.types import Episodes
from tangram_agent.wire import (
    Ack,
    Alive,
    Bye,
    Go,
    Greet,
    Heartbeat,
    Refused,
    Reject,
    Stop,
    ToWorker,
    WantWeights,
    WeightsMessage,
    Welcome,
)
from tangram_sim.errors import ConfigError, RunError, WireError
from tests.agent.messages import (
    FINGERPRINTS,
    SHAPES,
    SPEC,
    batch,
    hello,
    scores,
    weights,
    with_header,
)
from tests.master.dealers import INFO, WINDOW, Dealer, staged

pytestmark = pytest.mark.cluster


def test_hello_is_answered_with_all_that_a_worker_needs() -> None:
    with staged() as stage:
        welcome = stage.dealer().join(index=4)
        hub = stage.hub
        assert welcome == Welcome(hub.epoch, "run", 7, 4, 1, hub.weights_endpoint, WINDOW, False)
        [peer] = hub.peers
        assert (peer.role, peer.index, peer.incarnation) == ("player", 4, 1)
        assert hub.counters["welcomed"] == 1


@pytest.mark.parametrize(
    ("changes", "counter", "reason"),
    [
        (
            {"fingerprints": FINGERPRINTS | {"tokens": "other"}},
            "refused_tokens",
            "its settings of tokens differ from the master's: start both with the same overrides "
            "of tokens",
        ),
        (
            {"fingerprints": FINGERPRINTS | {"sim": "other", "net": "more"}},
            "refused_settings",
            "its settings of net, sim differ from the master's: start both with the same overrides "
            "of net, sim",
        ),
        (
            {"v": PROTOCOL + 1},
            "refused_protocol",
            f"the other side speaks protocol {PROTOCOL + 1}, this one {PROTOCOL}: install the "
            "same version of tangram on both",
        ),
    ],
)
def test_who_does_not_fit_is_told_why(changes: dict[str, Any], counter: str, reason: str) -> None:
    with staged() as stage:
        dealer = stage.dealer()
        dealer.say(with_header(hello().encode(), **changes))
        assert dealer.hear() == Refused(reason)
        assert (stage.hub.counters[counter], stage.hub.peers) == (1, [])


def test_a_full_house_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("master.peers.MAX_PEERS", 1)
    with staged() as stage:
        stage.dealer().join()
        late = stage.dealer()
        late.say(hello(process="late").encode())
        assert late.hear() == Refused("1 processes take part already, the most there can be")
        assert stage.hub.counters["refused_full"] == 1


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


def test_the_newest_process_of_an_index_wins() -> None:
    with staged() as stage:
        old, new = stage.dealer(), stage.dealer()
        old.join(index=0, process="old")
        old.send(1)
        stage.counted("batches")
        assert new.join(index=0, process="new").incarnation == 2
        assert old.hear() == Stop("player 0 was taken over by a newer process")
        # What the old one still sends is answered, in the end, with STOP.
        old.send(2)
        assert old.hear() == Greet()
        old.say(hello(index=0, process="old", incarnation=1, first=1).encode())
        answer = old.hear()
        assert isinstance(answer, Stop)
        assert answer.reason.startswith("player 0 was taken over by a newer process (incarnation 2")
        assert stage.hub.counters["superseded"] == 2
        # The insert of the old one's batch is nobody's any more.
        stage.hub.acknowledge(stage.batches()[0])
        assert stage.hub.peers[0].batches == 0
        new.send(1)
        stage.counted("batches", 2)
        assert stage.batches()[1].incarnation == 2


def test_a_process_may_come_back_over_another_connection() -> None:
    with staged() as stage:
        first, second = stage.dealer(), stage.dealer()
        first.join(process="p")
        first.send(1)
        stage.counted("batches")
        welcome = second.join(process="p", index=0, incarnation=1, first=1)
        assert (welcome.index, welcome.incarnation) == (0, 1)
        second.send(1)
        stage.counted("held_duplicates")
        stage.hub.acknowledge(stage.batches()[0])
        assert second.hear() == Ack(1, duplicate=False)


def test_who_said_no_hello_is_greeted() -> None:
    with staged() as stage:
        dealer = stage.dealer()
        broken = with_header(batch().encode(SPEC), count=0)
        for message in (Heartbeat({}).encode(), batch().encode(SPEC), broken):
            dealer.say(message)
            assert dealer.hear() == Greet()
        assert stage.hub.counters["strangers"] == 3
        assert stage.arrivals == []


def test_a_wrong_batch_is_refused_for_good_and_those_after_it_are_taken() -> None:
    with staged() as stage:
        dealer = stage.dealer()
        dealer.join(index=5)
        frames = batch(1).encode(SPEC)
        rewards = np.frombuffer(frames[4], "<f4").copy()
        rewards[0] = np.nan
        dealer.say([*frames[:4], rewards.tobytes(), frames[5]])
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


GARBAGE = [
    [b""],
    [b"", b""],
    [os.urandom(100)],
    [b"\xc1"] * 3,
    [b"\x81\xa1a" * 3000],
    [bytes(1_000_000)],
    with_header(hello().encode(), role="spy"),
    with_header(hello().encode(), more=1),
    with_header(hello().encode(), kind="welcome"),
    with_header(batch().encode(SPEC), sequence=-1),
    with_header(scores().encode(SPEC), scalars={"a": float("nan")}),
]


def test_garbage_is_refused_with_a_reason_and_the_hub_lives_on() -> None:
    with staged() as stage:
        good, bad, unknown = stage.dealer(), stage.dealer(), stage.dealer()
        good.join(process="good")
        bad.join(process="bad")
        for frames in GARBAGE:
            for dealer in (bad, unknown):
                dealer.say(frames)
                answer = dealer.hear()
                assert isinstance(answer, Reject)
                assert (answer.sequence, answer.final) == (0, True)
                assert answer.reason
        assert stage.hub.counters["malformed"] == 2 * len(GARBAGE)
        good.send(1)
        bad.send(1)
        stage.counted("batches", 2)


def test_bytes_that_are_not_even_zeromq_hurt_nobody() -> None:
    with staged() as stage:
        dealer = stage.dealer()
        dealer.join()
        host, port = stage.hub.endpoint.removeprefix("tcp://").split(":")
        with socket.create_connection((host, int(port)), timeout=5) as raw:
            raw.sendall(os.urandom(4096))
            dealer.send(1)
            stage.counted("batches")


def test_a_frame_over_the_limit_never_arrives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("master.sockets.MAX_BATCH_BYTES", 10_000)
    with staged() as stage:
        large, small = stage.dealer(), stage.dealer()
        large.say([bytes(10_001)])
        large.say(Heartbeat({}).encode())
        small.say([bytes(10_000)])
        assert isinstance(small.hear(), Reject)
        # The connection of the large one was cut; it comes again, without its message.
        large.say(Heartbeat({}).encode())
        assert large.hear() == Greet()
        assert stage.hub.counters["malformed"] == 1


def test_who_vanished_is_unreachable_and_nobody_waits() -> None:
    with staged() as stage:
        gone, here = stage.dealer(), stage.dealer()
        gone.join(process="gone")
        here.join(process="here")
        gone.send(*range(1, WINDOW + 1))
        stage.counted("batches", WINDOW)
        [identity] = [p.identity for p in stage.hub.peers if p.process == "gone"]
        gone.socket.close(0)

        def unreachable() -> int:
            # The ROUTER learns of it some time; until then it accepts answers.
            stage.hub._post.send(identity, Greet())
            return stage.hub.counters["unreachable"]

        stage.until(unreachable)
        for arrival in stage.batches():
            stage.hub.acknowledge(arrival)
        here.send(1)
        stage.counted("batches", WINDOW + 1)


def test_who_does_not_read_loses_answers_and_nobody_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("master.sockets.HIGH_WATER", 2)
    with staged() as stage:
        deaf = stage.dealer()
        deaf.join()
        big = weights()
        big.tensors["actor.weight"] = np.zeros(2**20, np.float32)
        stage.hub.publish(big)
        wanted = 0
        while not stage.hub.counters["congested"] and wanted < 200:
            deaf.say(WantWeights("", -1).encode())
            deaf.say(Heartbeat({}).encode())
            wanted += 1
            stage.counted("heartbeats", wanted)
        assert stage.hub.counters["congested"] > 0


def test_a_joiner_gets_the_current_weights() -> None:
    with staged() as stage:
        dealer = stage.dealer()
        dealer.join()
        dealer.say(WantWeights("", -1).encode())
        dealer.say(Heartbeat({}).encode())
        assert dealer.hear() == Alive(-1)  # there are none yet
        stage.hub.publish(weights(version=1))
        stage.hub.publish(weights(version=2))
        dealer.say(WantWeights("", -1).encode())
        answer = dealer.hear()
        assert isinstance(answer, WeightsMessage)
        assert (answer.epoch, answer.weights.version) == (stage.hub.epoch, 2)


def test_weights_are_not_sent_to_those_who_have_them() -> None:
    with staged() as stage:
        dealer = stage.dealer()
        dealer.join()
        stage.hub.publish(weights(version=2))
        dealer.say(WantWeights(stage.hub.epoch, 2).encode())
        dealer.say(Heartbeat({}).encode())
        assert dealer.hear() == Alive(2)
        dealer.say(WantWeights("another life", 2).encode())
        assert isinstance(dealer.hear(), WeightsMessage)


def test_weights_are_broadcast_as_one_frame() -> None:
    with staged() as stage:
        subscriber = stage.subscriber()
        version = 0

        def heard() -> int:
            nonlocal version
            version += 1
            stage.hub.publish(weights(version))
            return subscriber.poll(10)

        stage.until(heard)
        [frame] = subscriber.recv_multipart()
        epoch, received = decode_weights(frame, SHAPES)
        assert epoch == stage.hub.epoch
        assert 1 <= received.version <= version
        assert stage.hub.counters["published"] == version


def test_weights_that_are_not_finite_are_never_sent() -> None:
    with staged() as stage:
        subscriber, dealer = stage.subscriber(), stage.dealer()
        dealer.join()
        with pytest.raises(WireError, match="is not finite"):
            stage.hub.publish(weights(value=float("nan")))
        dealer.say(WantWeights("", -1).encode())
        dealer.say(Heartbeat({}).encode())
        assert dealer.hear() == Alive(-1)
        assert subscriber.poll(0) == 0
        assert stage.hub.counters["published"] == 0


def test_scores_and_heartbeats() -> None:
    with staged() as stage:
        dealer = stage.dealer()
        dealer.join(role="evaluator", index=2)
        dealer.say(Heartbeat({"episodes": 12.0}).encode())
        assert dealer.hear() == Alive(-1)
        assert stage.hub.peers[0].stats == {"episodes": 12.0}
        dealer.say(scores().encode(SPEC))
        stage.counted("scores")
        [arrival] = stage.arrivals
        assert isinstance(arrival, ScoresArrived)
        assert (arrival.index, arrival.incarnation) == (2, 1)
        assert arrival.scores.scalars == scores().scalars
        np.testing.assert_array_equal(arrival.scores.ends, scores().ends)


@pytest.mark.parametrize(
    ("role", "number", "frames", "reason"),
    [
        ("player", 0, scores().encode(SPEC), "player 2: scores come from evaluators only"),
        ("evaluator", 1, batch(1).encode(SPEC), "evaluator 2: episodes come from players only"),
    ],
)
def test_each_role_sends_its_own_kind_only(
    role: str, number: int, frames: list[bytes], reason: str
) -> None:
    with staged() as stage:
        dealer = stage.dealer()
        dealer.join(role=role, index=2)
        dealer.say(frames)
        assert dealer.hear() == Reject(reason=reason, sequence=number, final=True)
        assert stage.arrivals == []
        assert stage.hub.counters["rejected"] == 1


def test_whoever_says_something_is_not_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr("master.hub.time", SimpleNamespace(monotonic=lambda: now))
    with staged(silence_s=30.0) as stage:
        dealer = stage.dealer()
        dealer.join()
        for later in (20.0, 40.0, 60.0):
            now = later
            dealer.say(Heartbeat({}).encode())
            assert dealer.hear() == Alive(-1)
        now = 90.1
        stage.counted("lost_peers")
        assert stage.hub.peers == []


def test_bye_and_silence_free_the_index() -> None:
    with staged(silence_s=0.2) as stage:
        first, second = stage.dealer(), stage.dealer()
        assert first.join(process="a").index == 0
        first.say(Bye("done").encode())
        stage.counted("byes")
        assert stage.hub.peers == []
        assert second.join(process="b").index == 0
        stage.counted("lost_peers")
        assert stage.hub.peers == []


def test_stop_reaches_those_who_are_there_and_those_who_come_later() -> None:
    with staged() as stage:
        peer, late = stage.dealer(), stage.dealer()
        peer.join()
        peer.send(1)
        stage.counted("batches")
        stage.hub.stop("max_hours=1")
        assert peer.hear() == Stop("max_hours=1")
        late.say(hello(process="late").encode())
        assert late.hear() == Stop("max_hours=1")
        peer.send(2)
        assert peer.hear() == Stop("max_hours=1")
        # What arrived before may still be inserted.
        stage.hub.acknowledge(stage.batches()[0])
        assert peer.hear() == Ack(1, duplicate=False)
        peer.say(Bye("stopped").encode())
        stage.until(lambda: not stage.hub.peers)
        assert len(stage.batches()) == 1


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


def test_one_poll_takes_a_bounded_number_of_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("master.hub.MAX_DRAIN", 2)
    with staged() as stage:
        dealer = stage.dealer()
        dealer.join()
        dealer.send(1, 2, 3)
        sizes: list[int] = []
        stage.until(lambda: sizes.append(len(stage.arrivals)) or len(stage.arrivals) == 3)
        assert max(np.diff(sizes)) <= 2


def test_a_port_in_use_says_what_to_do() -> None:
    with staged() as stage:
        port = int(stage.hub.endpoint.rpartition(":")[2])
        with pytest.raises(ConfigError) as caught:
            Hub("127.0.0.1", port, INFO)
        assert str(caught.value) == (
            f"port {port} of 127.0.0.1 is in use: choose another with service.port=..., "
            "or 0 for any free one"
        )


@pytest.mark.parametrize("bind", ["nowhere", "203.0.113.7", "1.2.3", "::zz"])
def test_a_wrong_address_says_what_to_do(bind: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Hub(bind, 0, INFO)
    assert str(caught.value).startswith(f"cannot listen on {bind}, port 0 (")
    assert str(caught.value).endswith(
        "set service.bind to an address of this machine, such as 127.0.0.1, and service.port to "
        "one you may use"
    )


def test_all_addresses_and_a_given_port() -> None:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    with staged("0.0.0.0", port) as stage:  # noqa: S104
        assert stage.hub.endpoint == f"tcp://0.0.0.0:{port}"
        assert isinstance(stage.dealer().join(), Welcome)


def test_answers_are_read_by_the_decoder_of_workers() -> None:
    """Welcome and weights with the shapes that a worker expects."""
    with staged() as stage:
        dealer: Dealer = stage.dealer()
        dealer.join()
        stage.hub.publish(weights())
        dealer.say(WantWeights("", -1).encode())
        stage.until(lambda: dealer.socket.poll(0))
        message = decode_from_master(dealer.socket.recv_multipart(), SHAPES)
        assert isinstance(message, WeightsMessage)
