"""The hub with peers that keep the rules and peers that do not, on real sockets."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from master.hub.gate import HANDSHAKES, RESERVE, Room
from master.hub.registry import STATUS_AGAIN_S
from tangram_core.agent import Weights
from tangram_core.errors import WireError
from tangram_core.wire.messages import (
    WORKER_COLUMNS,
    Ack,
    Alive,
    AskStatus,
    Bye,
    Greet,
    Heartbeat,
    Refused,
    Reject,
    RunStatus,
    Stop,
    WantWeights,
    WeightsMessage,
    Welcome,
)
from tangram_core.wire.schema import PROTOCOL
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
from tests.master.hub.dealers import WINDOW, Dealer, Stage, staged

pytestmark = pytest.mark.cluster


def test_hello_is_answered_with_all_that_a_worker_needs(stage: Stage) -> None:
    welcome, hub = stage.dealer().join(index=4), stage.hub
    assert welcome == Welcome(hub.epoch, "run", 7, 4, 1, hub.weights_endpoint, WINDOW, False)
    [peer] = hub.peers
    assert (peer.role, peer.index, peer.incarnation) == ("player", 4, 1)
    assert hub.counters["welcomed"] == 1


def test_broadcasts_take_so_long_as_their_bytes_for_all_who_take_part(stage: Stage) -> None:
    """At half a gigabit: 1,000 workers with 290 kB each, 290 MB in all, take 4.8 s."""
    assert stage.hub.broadcast_s == 0.0
    tensors = {"a": np.zeros(72_500, np.float32)}
    stage.hub.publish(Weights(1, tensors))
    assert stage.hub.broadcast_s == 0.0
    for i, role in enumerate(("player", "player", "evaluator"), 1):
        stage.dealer().join(process=f"p{i}", role=role)
        assert stage.hub.broadcast_s == pytest.approx(i * 290e3 / 60e6, rel=1e-3)
    stage.hub.publish(Weights(2, {}))
    assert stage.hub.broadcast_s < 1e-4


NO_ROOM = Room(RESERVE + HANDSHAKES)
DIFFERS = (
    "its settings of {0} differ from the master's ({1}): leave them out, since connect=RUN_DIR "
    "loads the master's, or start both with the same overrides of {0}"
)


@pytest.mark.parametrize(
    ("changes", "counter", "reason"),
    [
        (
            {"fingerprints": FINGERPRINTS | {"tokens": "other"}},
            "refused_settings",
            DIFFERS.format(
                "tokens", f"tokens: the worker has other, the master {FINGERPRINTS['tokens']}"
            ),
        ),
        (
            {"fingerprints": {"tokens": FINGERPRINTS["tokens"], "net": "more"}},
            "refused_settings",
            DIFFERS.format(
                "net, sim",
                "net: the worker has more, the master none; "
                f"sim: the worker has none, the master {FINGERPRINTS['sim']}",
            ),
        ),
        (
            {"v": PROTOCOL + 1},
            "refused_protocol",
            f"the other side speaks protocol {PROTOCOL + 1}, this one {PROTOCOL}: install the "
            "same version of tangram on both",
        ),
        (
            {"run_id": "another"},
            "refused_run",
            "this master runs 'run', not 'another': the connection file is stale, use the file of "
            "a running master",
        ),
        (
            {},
            "refused_full",
            f"0 processes take part, the most that {NO_ROOM.files} open files allow: raise "
            "ulimit -Hn and start the master again",
        ),
    ],
)
def test_who_does_not_fit_is_told_why(changes: dict[str, Any], counter: str, reason: str) -> None:
    with staged(room=NO_ROOM) as stage:
        answer = stage.dealer().ask(with_header(hello().encode(), **changes))
        assert answer == Refused(reason, later=counter in ("refused_full", "refused_run"))
        assert (stage.hub.counters[counter], stage.hub.peers) == (1, [])


def test_what_a_peer_sends_forges_no_line_of_the_log(
    stage: Stage, caplog: pytest.LogCaptureFixture
) -> None:
    assert isinstance(stage.dealer().ask(hello(run_id="x\nFORGED \x1b[2J")), Refused)
    [line] = caplog.messages
    assert line.isprintable()
    assert "x\\nFORGED \\x1b[2J" in line


def test_the_newest_process_of_an_index_wins(stage: Stage) -> None:
    old, new = stage.dealer(), stage.dealer()
    old.join(index=0, process="old")
    old.send(1)
    stage.counted("batches")
    assert new.join(index=0, process="new").incarnation == 2
    assert old.hear() == Stop("player 0 was taken over by a newer process")
    # What the old one still sends is answered, in the end, with STOP.
    assert old.ask(batch(2).encode(SPEC)) == Greet()
    answer = old.ask(hello(index=0, process="old", incarnation=1, first=1))
    assert isinstance(answer, Stop)
    assert answer.reason.startswith("player 0 was taken over by a newer process (incarnation 2")
    assert stage.hub.counters["superseded"] == 2
    # The insert of the old one's batch is nobody's any more.
    stage.hub.acknowledge(stage.batches()[0])
    assert stage.hub.peers[0].batches == 0
    new.send(1)
    stage.counted("batches", 2)
    assert stage.batches()[1].incarnation == 2


def test_who_said_no_hello_is_greeted(stage: Stage) -> None:
    dealer = stage.dealer()
    broken = with_header(batch().encode(SPEC), count=0)
    for message in (Heartbeat({}), batch().encode(SPEC), broken):
        assert dealer.ask(message) == Greet()
    assert (stage.hub.counters["strangers"], stage.arrivals) == (3, [])


def test_the_current_weights_are_sent_to_those_who_lack_them(stage: Stage, player: Dealer) -> None:
    player.say(WantWeights("", -1))
    assert player.beat() == [Alive(-1)]  # there are none yet
    with pytest.raises(WireError, match="is not finite"):
        stage.hub.publish(weights(value=float("nan")))
    player.say(WantWeights("", -1))
    assert player.beat() == [Alive(-1)]
    assert stage.hub.counters["published"] == 0
    stage.hub.publish(weights(version=1))
    stage.hub.publish(weights(version=2))
    player.say(WantWeights(stage.hub.epoch, 2))
    assert player.beat() == [Alive(2)]
    for number, (epoch, version) in enumerate([("", -1), (stage.hub.epoch, 1), ("old life", 2)]):
        dealer = stage.dealer()
        dealer.join(process=f"late {number}")
        dealer.say(WantWeights(epoch, version))
        answer = dealer.hear(SHAPES)
        assert isinstance(answer, WeightsMessage)
        assert (answer.epoch, answer.weights.version) == (stage.hub.epoch, 2)


def test_weights_come_again_for_those_who_got_them_and_late_for_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Who asks a hundred times and never reads would keep a hundred copies in memory here."""
    now = 0.0
    monkeypatch.setattr("master.hub.hub.time", SimpleNamespace(monotonic=lambda: now))
    with staged(silence_s=1e6) as stage:
        dealer, hub = stage.dealer(), stage.hub
        dealer.join()
        hub.publish(weights(version=1))

        def asked(shown: int) -> list[int]:
            """Versions that come when it asks five times."""
            for _ in range(5):
                dealer.say(WantWeights(hub.epoch, shown))
            found = [a for a in dealer.beat() if isinstance(a, WeightsMessage)]
            return [answer.weights.version for answer in found]

        assert [asked(-1), asked(-1)] == [[1], []]
        hub.publish(weights(version=2))
        assert asked(1) == [2]  # it shows that the first ones came
        assert hub.counters["weights_asked_again"] == 4 + 5 + 4
        for later, found in ((9.9, []), (10.0, [2]), (29.9, []), (30.0, [2]), (69.9, [])):
            now = later
            assert asked(1) == found, later
        dealer = stage.dealer()
        dealer.join()  # the same process: HELLO does not make it sooner
        assert asked(1) == []
        now = 70.0
        assert asked(1) == [2]


@pytest.mark.parametrize(
    ("role", "number", "frames", "reason"),
    [
        ("player", 0, scores().encode(SPEC), "player 2: scores come from evaluators only"),
        ("evaluator", 1, batch(1).encode(SPEC), "evaluator 2: episodes come from players only"),
    ],
)
def test_each_role_sends_its_own_kind_only(
    stage: Stage, role: str, number: int, frames: list[bytes], reason: str
) -> None:
    dealer = stage.dealer()
    dealer.join(role=role, index=2)
    assert dealer.ask(frames) == Reject(reason=reason, sequence=number, final=True)
    assert (stage.arrivals, stage.hub.counters["rejected"]) == ([], 1)


def test_scores_that_the_task_does_not_declare_are_refused(stage: Stage) -> None:
    """Each name is a curve of its own: whoever made up names would fill the disk."""
    dealer = stage.dealer()
    dealer.join(role="evaluator")
    stage.hub.publish(weights(7))
    sent = replace(scores(), weights_version=7, scalars={"mean_reward": 0.5, "made_up": 1.0})
    told = "evaluator 0: scores: the task has no score named made_up"
    assert dealer.ask(sent.encode(SPEC)) == Reject(told, sequence=0, final=True)
    assert stage.arrivals == []


def test_scores_are_taken_once_for_each_of_the_published_weights(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An evaluator that sent as many as it liked filled the disk."""
    monkeypatch.setattr("master.record.delivery.MAX_EVALUATORS", 2)
    monkeypatch.setattr("master.record.delivery.REMEMBERED_VERSIONS", 2)
    dealers = [stage.dealer() for _ in range(3)]
    for number, dealer in enumerate(dealers):
        dealer.join(role="evaluator", process=f"p{number}")
    unknown = "weights {} are not among the last 2 of this master"
    for published, index, version, reason in (
        (6, 0, 7, unknown.format(7)),
        (7, 0, 7, ""),
        (7, 0, 7, "it has scored weights 7 before"),
        (7, 1, 7, ""),
        (7, 2, 7, "2 evaluators have scored weights 7, which is the limit"),
        (8, 0, 8, ""),
        (8, 0, 6, unknown.format(6)),
    ):
        stage.hub.publish(weights(published))
        dealers[index].say(replace(scores(), weights_version=version).encode(SPEC))
        answer = dealers[index].ask(Heartbeat({}))
        if reason:
            assert answer == Reject(f"evaluator {index}: {reason}", sequence=0, final=True)
            answer = dealers[index].hear()
        assert answer == Alive(published)
    assert len(stage.arrivals) == stage.hub.counters["scores"] == 3
    assert stage.hub.counters["excess_scores"] == 4


def test_how_the_run_stands_is_told_at_a_bounded_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever asked without an end and read nothing kept all the answers in memory here."""
    now = 0.0
    monkeypatch.setattr("master.hub.hub.time", SimpleNamespace(monotonic=lambda: now))
    monkeypatch.setattr("master.hub.registry.STATUS_ANSWERS", 2)
    with staged() as stage:
        stage.hub.tell(RunStatus({}, {"run_id": "run"}, np.zeros((0, len(WORKER_COLUMNS)))))
        dealers = [stage.dealer() for _ in range(3)]
        for later, found in (
            (0.0, [1, 1, 0]),
            (STATUS_AGAIN_S - 0.01, [0, 0, 0]),
            (STATUS_AGAIN_S, [1, 1, 0]),
        ):
            now = later
            for dealer, answers in zip(dealers, found, strict=True):
                for _ in range(3):
                    dealer.say(AskStatus())
                heard = [dealer.ask(Heartbeat({}))]
                while heard[-1] != Greet():  # who asks need not take part
                    heard.append(dealer.hear())
                assert len(heard) == answers + 1, later
        assert stage.hub.counters["status_asked_again"] == 27 - 4


def test_silence_and_bye_free_the_index_and_whoever_says_something_is_not_silent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = 0.0
    monkeypatch.setattr("master.hub.hub.time", SimpleNamespace(monotonic=lambda: now))
    with staged(silence_s=30.0) as stage:
        first, second = stage.dealer(), stage.dealer()
        first.join(process="a")
        for later in (20.0, 40.0, 60.0):
            now = later
            assert first.beat() == [Alive(-1)]
        now = 90.1
        stage.counted("lost_peers")
        assert stage.hub.peers == []
        assert second.join(process="b").index == 0
        second.say(Bye("done"))
        stage.counted("byes")
        assert stage.hub.peers == []


def test_stop_reaches_those_who_are_there_and_those_who_come_later(
    stage: Stage, player: Dealer
) -> None:
    player.send(1)
    stage.counted("batches")
    stage.hub.stop("max_hours=1")
    assert player.hear() == Stop("max_hours=1")
    assert stage.dealer().ask(hello(process="late")) == Stop("max_hours=1")
    # Right or wrong, a batch that is not inserted is not refused for good: its worker would forget
    # it. Found by the relay's test.
    for frames in (batch(2).encode(SPEC), with_header(batch(2).encode(SPEC), count=0)):
        assert player.ask(frames) == Stop("max_hours=1")
    # What arrived before may still be inserted.
    stage.hub.acknowledge(stage.batches()[0])
    assert player.hear() == Ack(1, duplicate=False)
    assert stage.hub.state()["player/0"]["sequence"] == 1
    player.say(Bye("stopped"))
    stage.until(lambda: not stage.hub.peers)
    assert len(stage.batches()) == 1
