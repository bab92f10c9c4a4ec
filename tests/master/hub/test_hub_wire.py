"""Garbage, floods, peers that vanish or do not read, and addresses."""

import json
import os
import socket
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from master.hub.hub import Hub
from master.hub.sockets import MAX_COMMAND
from master.record.delivery import EpisodesArrived
from master.watch.report import _workers
from tangram_core.errors import ConfigError
from tangram_core.wire.arrays import MAX_FRAMES
from tangram_core.wire.messages import (
    Alive,
    AskStatus,
    Bye,
    Greet,
    Heartbeat,
    Hello,
    Reject,
    RunStatus,
    WantWeights,
)
from tangram_core.wire.schema import Between, Bound, Flag, Numbers, Text
from tests.agent.messages import FINGERPRINTS, SPEC, batch, hello, scores, weights, with_header
from tests.master.hub.dealers import INFO, WINDOW, Dealer, Stage, staged

pytestmark = pytest.mark.cluster


GARBAGE = [
    [b""],
    [b"", b""],
    [os.urandom(100)],
    [b"\xc1"] * 3,
    [b"\x81\xa1a" * 3000],
    [bytes(32_000)],
    with_header(hello().encode(), role="spy"),
    with_header(hello().encode(), more=1),
    with_header(hello().encode(), kind="welcome"),
    with_header(batch().encode(SPEC), sequence=-1),
    with_header(scores().encode(SPEC), scalars={"a": float("nan")}),
]


def test_garbage_is_refused_with_a_reason_and_the_hub_lives_on(
    stage: Stage, player: Dealer
) -> None:
    bad, unknown = stage.dealer(), stage.dealer()
    bad.join(process="bad")
    for frames in GARBAGE:
        for dealer in (bad, unknown):
            answer = dealer.ask(frames)
            assert isinstance(answer, Reject)
            assert (answer.sequence, answer.final) == (0, True)
            assert answer.reason
    assert stage.hub.counters["malformed"] == 2 * len(GARBAGE)
    # Bytes that are not even ZeroMQ hurt nobody either.
    host, port = stage.hub.endpoint.removeprefix("tcp://").split(":")
    with socket.create_connection((host, int(port)), timeout=5) as raw:
        raw.sendall(os.urandom(4096))
        player.send(1)
        bad.send(1)
        stage.counted("batches", 2)


def test_a_frame_over_the_limit_never_arrives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("master.hub.sockets.MAX_FRAME_BYTES", 10_000)
    with staged() as stage:
        large, small = stage.dealer(), stage.dealer()
        large.say([bytes(10_001 + MAX_COMMAND)])
        large.say(Heartbeat({}))
        assert isinstance(small.ask([bytes(10_000)]), Reject)
        # The connection of the large one was cut; it comes again, without its message.
        assert large.ask(Heartbeat({})) == Greet()
        assert stage.hub.counters["malformed"] == 1


def test_a_message_of_too_many_frames_is_not_decoded(stage: Stage, player: Dealer) -> None:
    """Nor are their checksums found."""
    answer = player.ask([*hello().encode(), *[b""] * MAX_FRAMES, b""])
    assert isinstance(answer, Reject)
    assert answer.reason == f"the message has {MAX_FRAMES + 2} frames, at most {MAX_FRAMES + 1}"


def test_a_connection_that_takes_anothers_name_is_not_heard(stage: Stage) -> None:
    """ZeroMQ lets peers choose the name of their connection: the first one keeps it."""
    first = stage.dealer(b"the same")
    first.join()
    second = stage.dealer(b"the same")
    second.say(Heartbeat({}))
    with pytest.raises(TimeoutError):
        stage.until_within(0.5, lambda: second.socket.poll(0) or stage.hub.counters["strangers"])
    assert first.beat() == [Alive(-1)]


def test_who_vanished_is_unreachable_and_nobody_waits(stage: Stage, player: Dealer) -> None:
    gone = stage.dealer()
    gone.join(process="gone")
    gone.send(*range(1, WINDOW + 1))
    stage.counted("batches", WINDOW)
    [identity] = [p.identity for p in stage.hub.peers if p.process == "gone"]
    gone.socket.close(0)

    def unreachable() -> int:
        # The ROUTER learns of it some time; until then it accepts answers.
        stage.hub._sockets.answer(identity, Greet())
        return stage.hub.counters["unreachable"]

    stage.until(unreachable)
    for arrival in stage.batches():
        stage.hub.acknowledge(arrival)
    player.send(1)
    stage.counted("batches", WINDOW + 1)


def test_who_does_not_read_loses_answers_and_nobody_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("master.hub.sockets.HIGH_WATER", 2)
    monkeypatch.setattr("master.hub.registry.Peer.may_have", lambda *_: True)
    with staged() as stage:
        deaf = stage.dealer()
        deaf.join()
        big = weights()
        big.tensors["actor.weight"] = np.zeros(2**20, np.float32)
        stage.hub.publish(big)
        wanted = 0
        while not stage.hub.counters["congested"] and wanted < 200:
            deaf.say(WantWeights("", -1))
            deaf.say(Heartbeat({}))
            wanted += 1
            stage.counted("heartbeats", wanted)
        assert stage.hub.counters["congested"] > 0


# Every field of a peer as its bound allows, extremes first.
VALUES: dict[type[Bound], Callable[[Any], st.SearchStrategy[Any]]] = {
    Between: lambda b: st.sampled_from([b.low, b.high]) | st.integers(b.low, b.high),
    Flag: lambda _: st.booleans(),
    Text: lambda b: (
        st.sampled_from(b.choices)
        if b.choices
        else st.text(st.characters(codec="utf-8"), min_size=1, max_size=min(b.longest, 12))
    ),
    Numbers: lambda _: st.dictionaries(
        st.sampled_from("abc"), st.sampled_from([1e18, -1e18, 5e-324, 2.0**53])
    ),
}
KINDS = (Hello, Bye, Heartbeat, WantWeights, AskStatus)
PROCESSES = ("p0", "p1", "p2")


@st.composite
def said(draw: st.DrawFn) -> list[bytes]:
    """The frames of a message that a reader takes, of a process that may have joined."""
    cls = draw(st.sampled_from(KINDS))
    bounds = {n: b for n, b in cls.bounds.items() if n not in ("fingerprints", "run_id")}
    fields = {name: draw(VALUES[type(bound)](bound)) for name, bound in bounds.items()}
    if cls is Hello:
        fields |= {"fingerprints": FINGERPRINTS, "run_id": "run"}
        fields |= {"process": draw(st.sampled_from(PROCESSES)), "index": draw(st.integers(-1, 1))}
    return cls(**fields).encode()


@settings(max_examples=60)
@given(st.lists(st.tuples(st.sampled_from(PROCESSES), said() | st.integers(1, 3)), max_size=30))
def test_nothing_that_peers_may_say_makes_an_answer_or_a_checkpoint_that_cannot_be_told(
    heard: list[tuple[str, list[bytes] | int]],
) -> None:
    """A HELLO of 300 bytes with the incarnation 2^63-1 ended the master."""
    with Hub("127.0.0.1", 0, INFO) as hub:
        hub.publish(weights(version=2**53))
        for name, message in heard:
            frames = batch(message).encode(SPEC) if isinstance(message, int) else message
            arrived = hub._receive(name.encode(), frames)
            if isinstance(arrived, EpisodesArrived):
                hub.acknowledge(arrived)
            table = _workers(hub.peers, 2**53)
            RunStatus(dict(hub.counters), {}, table).encode()
        with Hub("127.0.0.1", 0, INFO) as again:
            again.load_state(json.loads(json.dumps(hub.state())))
            assert again.state() == hub.state()


@pytest.mark.parametrize("limited", ["READ_S", "SERVE_S"])
def test_one_poll_reads_and_answers_for_a_bounded_time(
    stage: Stage, player: Dealer, monkeypatch: pytest.MonkeyPatch, limited: str
) -> None:
    monkeypatch.setattr(f"master.hub.hub.{limited}", 0.0)
    player.send(1, 2, 3)
    sizes: list[int] = []
    stage.until(lambda: sizes.append(len(stage.arrivals)) or len(stage.arrivals) == 3)
    assert max(np.diff(sizes)) <= 1


@pytest.mark.parametrize("bind", ["nowhere", "203.0.113.7", "1.2.3", "::zz"])
def test_a_wrong_address_says_what_to_do(bind: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Hub(bind, 0, INFO)
    assert str(caught.value).startswith(f"cannot listen on {bind}, port 0 (")
    assert str(caught.value).endswith(
        "set service.bind to an address of this machine, such as 127.0.0.1, and service.port to "
        "one you may use"
    )
