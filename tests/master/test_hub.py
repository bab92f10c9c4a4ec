"""The hub with peers that keep the rules and peers that do not, on real sockets."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from master.delivery import ScoresArrived
from tangram_agent.messages import (
    Ack,
    Alive,
    Bye,
    Greet,
    Heartbeat,
    Refused,
    Reject,
    Stop,
    WantWeights,
    WeightsMessage,
    Welcome,
    decode_from_master,
    decode_weights,
)
from tangram_agent.schema import PROTOCOL
from tangram_sim.errors import WireError
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
from tests.master.dealers import WINDOW, Dealer, staged

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
    monkeypatch.setattr("master.registry.MAX_PEERS", 1)
    with staged() as stage:
        stage.dealer().join()
        late = stage.dealer()
        late.say(hello(process="late").encode())
        assert late.hear() == Refused("1 processes take part already, the most there can be")
        assert stage.hub.counters["refused_full"] == 1


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
