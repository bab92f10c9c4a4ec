"""Encrypted sockets: who has the run's connection file is let in, and nobody else."""

import json
import os
import socket
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from zmq.utils.monitor import recv_monitor_message

from master.hub.hub import Hub
from master.hub.security import (
    Given,
    Holder,
    Keys,
    Pair,
    make_keys,
    make_pair,
    read_keys,
    write_keys,
)
from master.hub.sockets import Received
from master.loop import Loop
from master.record.audit import Audit
from master.record.rundir import RunFolder
from tangram_core.agent import Weights
from tangram_core.errors import RunError, TangramError, UnavailableError
from tangram_core.wire.messages import (
    PICTURE_WIDTH,
    Alive,
    Greet,
    Heartbeat,
    Refused,
    Reject,
    Scores,
    Stop,
    Welcome,
    decode_from_master,
)
from tangram_lab.benchmarks.trials.intruder import NOBODY, knock
from tests.agent.builders import random_episodes
from tests.agent.messages import SPEC, episodes, hello, scores, weights
from tests.master.builders import arrival
from tests.master.hub.dealers import Stage, staged
from tests.master.test_run import MADE, opened_run
from tests.ports import free_ports
from tests.worker.talk.conversation import (
    QUICK,
    both,
    make_client,
    served,
    standing_in,
    write_connection,
)
from worker.talk.client import Client
from worker.talk.connection import Sockets
from worker.talk.discovery import MasterAddress, find_master

pytestmark = pytest.mark.cluster

HASTY = replace(QUICK, join_s=0.1, retry_s=0.1)


@pytest.fixture(autouse=True)
def unlingering(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody waits for a BYE to those who took no key."""
    monkeypatch.setattr("worker.talk.connection.LINGER_MS", 0)


def write_file(folder: Path, hub: Hub, keys: Keys | None, run_id: str = "run") -> Path:
    """What a master with these keys would write."""
    content: dict[str, Any] = {"endpoint": hub.endpoint, "run_id": run_id}
    if keys is not None:
        own = {role: asdict(pair) for role, pair in keys.own().items()}
        content |= {"server_key": keys.server.public, "keys": own}
    path = folder / "connection.json"
    path.write_text(json.dumps(content))
    return path


def turned_away(stage: Stage, connect: object) -> str:
    """Why a client that got no further than the handshake is given up."""
    with make_client(connect, HASTY) as client:
        both(stage, client, lambda: client.counters["handshakes_failed"] >= 2)
        with pytest.raises(TangramError) as caught:
            served(stage, client.join)
    assert not isinstance(caught.value, UnavailableError)  # another file helps, and no waiting
    return str(caught.value)


def test_the_file_lets_a_worker_in_and_everything_works(tmp_path: Path) -> None:
    """Without heartbeats nothing tells of weights but the broadcast, of which none was missed."""
    keys, silent = make_keys(), replace(QUICK, heartbeat_s=3600.0)
    with (
        staged(keys=keys) as stage,
        make_client(write_file(tmp_path, stage.hub, keys), silent) as client,
    ):
        assert served(stage, client.join)
        client.send(episodes(), 0)
        stage.until(stage.batches)
        stage.hub.acknowledge(stage.batches()[0])
        got: list[Weights | None] = []

        def heard() -> bool:
            stage.hub.publish(weights(version=len(got) + 1))
            got.append(client.newest_weights())
            return got[-1] is not None and client.outbox.first == 2

        both(stage, client, heard)
        assert stage.hub.counters["refused_keys"] == 0


@pytest.mark.parametrize("wrong", ["server", "worker", "both", "none", "of a plain master"])
def test_other_keys_are_turned_away_and_the_worker_names_its_file(
    tmp_path: Path, wrong: str, caplog: pytest.LogCaptureFixture
) -> None:
    keys, other = make_keys(), make_keys()
    given: Keys | None = {
        "server": replace(keys, server=other.server),
        "worker": replace(keys, player=other.player),
        "none": None,
    }.get(wrong, other)
    log = Audit(tmp_path / "audit.jsonl")
    with staged(keys=None if wrong == "of a plain master" else keys, audit=log) as stage:
        path = write_file(tmp_path, stage.hub, given)
        reason = turned_away(stage, path)
        assert reason == (
            f"wrong or stale connection file: the master at {stage.hub.endpoint} refuses the keys "
            f"in {path}, which are of another run or revoked, or it has no connection free; use "
            "the file of a master that is running"
        )
        assert stage.hub.counters["refused_keys"] >= (wrong == "worker")
        if wrong == "worker":
            unknown = {"event": "refused", "key": "", "public": other.player.public}
            where = {"address": "127.0.0.1", "reason": "no key of this run"}
            assert (unknown | where).items() <= lines(tmp_path / "audit.jsonl")[0].items()
        assert stage.hub.peers == []
    # It was told at once, too, not only when the patience was over.
    assert [r.message for r in caplog.records if r.name == "worker.talk.connection"] == [reason]


def test_a_file_of_another_role_says_what_to_add() -> None:
    key = "k" * 40
    given = MasterAddress("tcp://h:1", "r", key, {"evaluator": (key, key)})
    with zmq.Context() as context, pytest.raises(RunError, match="only: add role=evaluator"):
        Sockets(context, given, "player")


def test_an_address_alone_is_not_enough() -> None:
    with staged(keys=make_keys()) as stage:
        reason = turned_away(stage, stage.hub.endpoint)
    assert "wants keys, or is no master: set connect to its connection file" in reason


def test_a_file_that_becomes_right_is_read_again(tmp_path: Path) -> None:
    """A worker may be there before its master, whose file of another life still lies there."""
    keys = make_keys()
    with staged(keys=keys) as stage:
        path = write_file(tmp_path, stage.hub, make_keys())
        with make_client(path) as client:
            both(stage, client, lambda: client.counters["handshakes_failed"])
            write_file(tmp_path, stage.hub, keys)
            both(stage, client, lambda: client.joined)


def test_a_master_that_gets_the_right_keys_is_joined_without_waiting_for_silence(
    tmp_path: Path,
) -> None:
    """ZeroMQ itself never connects again after it was refused."""
    keys, other, port = make_keys(), make_keys(), free_ports(1)
    others = replace(keys, player=other.player)
    with staged(port=port, keys=others) as stage:
        path = write_file(tmp_path, stage.hub, keys)
        with make_client(path) as client:
            both(stage, client, lambda: client.counters["handshakes_failed"])
            stage.hub.close()
            with staged(port=port, keys=keys) as again:
                both(again, client, lambda: client.joined)


def test_a_connection_that_is_lost_in_the_handshake_is_no_wrong_key(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A network that fails at the wrong moment, twice, before it works."""
    keys = make_keys()
    with staged(keys=keys) as stage, socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        path = write_file(tmp_path, stage.hub, keys)
        content = json.loads(path.read_text())
        path.write_text(json.dumps(content | {"endpoint": f"tcp://127.0.0.1:{port}"}))
        with make_client(path) as client, ThreadPoolExecutor(1) as pool:
            future = pool.submit(client.join)
            for _ in range(2):
                near, _ = listener.accept()
                near.recv(10)
                near.close()
            write_file(tmp_path, stage.hub, keys)
            stage.until(future.done)
            assert future.result()
            assert client.counters["handshakes_failed"] == 0
    assert "wrong or stale" not in caplog.text


# Strangers: another user of this machine, and one without a key; on the default settings, too

BINDS = [{}, {"bind": "127.0.0.1"}]


@pytest.fixture
def open_tmp(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A TMPDIR that everybody may enter and write to, as /tmp is; pytest's own is closed."""
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        Path(folder).chmod(0o1777)
        monkeypatch.setattr("tempfile.tempdir", folder)
        yield Path(folder)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
@pytest.mark.parametrize("service", BINDS, ids=str)
@pytest.mark.parametrize("role", ["player", "evaluator"])
def test_another_user_takes_no_index_and_forges_no_scores(
    open_tmp: Path, service: dict[str, str], role: str
) -> None:
    """It knows all that a worker says, and where."""
    with opened_run(open_tmp / "run", **service) as (loop, connection):
        hub, fingerprints, spec = loop.hub, MADE.fingerprints(), MADE.spec
        none = np.zeros((0, PICTURE_WIDTH, 3), np.uint8)
        question = hello(role=role, process="nobody", fingerprints=fingerprints, index=0)
        forged = Scores(7, {"mean_reward": 0.999}, none).encode(spec)
        stranger, arrivals = knock(connection["endpoint"], [question.encode(), forged]), list[Any]()
        while stranger.is_alive():
            arrivals += hub.poll(0.05)
        assert (stranger.exitcode, hub.peers, arrivals) == (0, [], [])


def test_an_impostor_on_a_dead_masters_port_gets_no_batch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has heard the run's id, and says what the master would say."""
    monkeypatch.setattr(Loop, "dismiss", lambda *_: None)  # who was killed says nothing
    folder, port = RunFolder(tmp_path / "run"), free_ports(1)
    with opened_run(folder.path, bind="127.0.0.1", port=port) as (loop, connection):
        folder.connection.write_text(json.dumps(connection))
        spec = MADE.spec
        given = (str(folder.path), "player", 0, MADE.fingerprints(), spec, None, 4, QUICK)
        with closing(Stage(loop.hub)) as stage, Client(*given) as client:
            assert served(stage, client.join)
            loop.hub.close()
            with standing_in(port) as impostor:
                client.send(random_episodes(MADE, 3), 0)
                deadline = time.monotonic() + 3.0
                while time.monotonic() < deadline:
                    client.poll(0.005)
                    impostor.listen()
                    if impostor.heard:
                        impostor.say(impostor.welcome_message(run_id=connection["run_id"]))
                assert (impostor.heard, client.acknowledged) == ([], 0)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_another_user_cannot_stand_where_the_sockets_were(open_tmp: Path) -> None:
    """Not in the folder, which stays when the master has ended, and not in its place."""
    with opened_run(open_tmp / "run") as (_, connection):
        place = Path(connection["endpoint"].removeprefix("ipc://"))
    path = write_connection(open_tmp, f"ipc://{place}")
    assert place.parent.stat().st_mode & 0o777 == 0o700
    place.parent.rmdir()
    place.parent.mkdir(mode=0o755)
    os.chown(place.parent, NOBODY, NOBODY)
    with pytest.raises(RunError, match=r"only this user may enter, it is drwxr-xr-x of user 65534"):
        find_master(str(path))


def test_a_worker_on_another_machine_is_told_where_the_master_listens(tmp_path: Path) -> None:
    path = write_connection(tmp_path, f"ipc://{tmp_path}/t/hub", machine="learner")
    with pytest.raises(RunError) as caught:
        find_master(str(path))
    assert str(caught.value) == (
        f"{path}: this master listens only on its own machine, learner: start the master with "
        "service.bind=0.0.0.0, or start this command on learner"
    )
    assert not (tmp_path / "t").exists()


# Keys of one role, of one person, and for a while


NEWS = zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_DISCONNECTED


def raw(stage: Stage, keys: Keys, pair: Pair, name: bytes = b"", kind: int = zmq.DEALER) -> Any:
    """A connection with a key, and perhaps with a name of its own; or a subscription."""
    end, hub = stage._open(kind), stage.hub
    end.get_monitor_socket(NEWS)  # before it connects: the first news may be out by the next line
    end.setsockopt(zmq.LINGER, 0)
    if name:
        end.setsockopt(zmq.IDENTITY, name)
    if kind == zmq.SUB:
        end.setsockopt(zmq.SUBSCRIBE, b"")
    end.setsockopt(zmq.CURVE_SERVERKEY, keys.server.public.encode())
    end.setsockopt(zmq.CURVE_PUBLICKEY, pair.public.encode())
    end.setsockopt(zmq.CURVE_SECRETKEY, pair.secret.encode())
    end.connect(hub.endpoint if kind == zmq.DEALER else hub.weights_endpoint)
    return end


def asked(stage: Stage, end: Any, message: Any) -> Any:
    end.send_multipart(message.encode())
    stage.until(lambda: end.poll(0))
    return decode_from_master(end.recv_multipart(), None)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Of the keys of a run."""
    path = tmp_path / "keys.json"
    write_keys(path, make_keys())
    return path


def give(file: Path, name: str, role: str = "player") -> Pair:
    pair, keys = make_pair(), read_keys(file)
    write_keys(file, replace(keys, given={**keys.given, name: Given(role, pair.public)}))
    return pair


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_a_key_is_for_one_role_and_for_its_own_indices(tmp_path: Path, file: Path) -> None:
    alice, bob, log = give(file, "alice"), give(file, "bob"), tmp_path / "audit.jsonl"
    keys = read_keys(file)
    with staged(keys=keys, audit=Audit(log)) as stage:
        one, other = raw(stage, keys, alice, b"the same"), raw(stage, keys, bob)
        answer = asked(stage, one, hello(role="evaluator"))
        assert answer == Refused("the key 'alice' is for role=player, not for role=evaluator")
        assert isinstance(asked(stage, one, hello(index=3)), Welcome)
        answer = asked(stage, other, hello(index=3, process="p2"))
        assert isinstance(answer, Refused)
        assert answer.reason.startswith("player 3 takes part with another key: leave index out")
        assert isinstance(asked(stage, other, hello(process="p1")), Refused)  # nor its process
        assert isinstance(asked(stage, other, hello(process="p2")), Welcome)
        # The name of a connection is free once it is gone; what it had joined as is not.
        one.close()
        stage.until(
            lambda: (
                stage.hub._sockets.answer(b"the same", Greet()) or stage.hub.counters["unreachable"]
            )
        )
        heir = raw(stage, keys, bob, b"the same")
        heir.send_multipart(Heartbeat({}).encode())
        # A ROUTER that has not yet forgotten the name never hears the heir.
        with suppress(TimeoutError):
            stage.until_within(5.0, lambda: heir.poll(0))
        if heir.poll(0):
            assert decode_from_master(heir.recv_multipart(), None) == Greet()
        # The run's own workers have their places.
        mine = raw(stage, keys, keys.player)
        assert isinstance(asked(stage, mine, hello(index=3, process="p3")), Welcome)
    found = lines(log)
    assert [(line["event"], line["key"]) for line in found] == [
        ("refused", "alice"),
        ("joined", "alice"),
        ("refused", "bob"),
        ("refused", "bob"),
        ("joined", "bob"),
        ("superseded", "alice"),
        ("joined", "player"),
    ]
    assert log.stat().st_mode & 0o077 == 0
    assert found[1] == {
        "time": found[1]["time"],
        "event": "joined",
        "role": "player",
        "index": 3,
        "incarnation": 1,
        "process": "p1",
        "key": "alice",
        "address": "127.0.0.1",
    }


def test_connections_of_a_revoked_key_end_also_those_that_say_nothing(
    tmp_path: Path, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One key could have had them all. A worker with a valid key connects again by itself."""
    monkeypatch.setattr("master.hub.security.LOOK_S", 0.05)
    keys, bob = read_keys(file), give(file, "bob")
    with staged(keys=read_keys(file)) as stage:
        silent = raw(stage, keys, bob)
        news = silent.get_monitor_socket()
        with make_client(write_file(tmp_path, stage.hub, keys)) as client:
            assert served(stage, client.join)
            stage.until(lambda: news.poll(0))
            assert recv_monitor_message(news)["event"] == zmq.EVENT_HANDSHAKE_SUCCEEDED
            waits = replace(arrival(MADE, 1), index=5, owner="bob")
            assert not stage.hub.discards(waits)
            write_keys(file, keys)
            both(stage, client, lambda: news.poll(0))
            assert recv_monitor_message(news)["event"] == zmq.EVENT_DISCONNECTED
            stage.hub._registry.recover(("player", 5), 1, 1, 0.0, "bob", "bob")
            assert stage.hub.discards(waits)
            assert stage.hub.state()["player/5"] == {"incarnation": 2, "sequence": 0}
            read = Holder("bob", "player")
            before = Received(b"bob", hello(process="bob").encode(), read, "", bob.public)
            assert stage.hub._heard(before) is None  # it was in the inbox by then
            assert [peer.holder for peer in stage.hub.peers] == ["player"]
            client.send(episodes(), 0)
            both(stage, client, stage.batches)
            assert client.counters["reconnects"] == 0


def test_a_key_that_is_revoked_while_the_master_starts_is_not_valid(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("master.hub.security.LOOK_S", 0.05)
    after, _ = read_keys(file), give(file, "bob")
    before, content = read_keys(file), file.read_bytes()
    write_keys(file, after)

    def fail(_: Path) -> Keys:
        raise RunError("Too many open files")

    with staged(keys=before) as stage:
        with monkeypatch.context() as patch:  # what cannot be read now is read at a later look
            patch.setattr("master.hub.security.read_keys", fail)
            stage.until(lambda: stage.hub.counters["unread_keys"])
            assert stage.hub.keys == before
        stage.until(lambda: stage.hub.keys == after)
        was = file.stat()
        file.write_bytes(content)  # as an editor that sets the time of before
        os.utime(file, ns=(was.st_atime_ns, was.st_mtime_ns))
        stage.until(lambda: stage.hub.keys == before)


def test_an_evaluator_of_the_run_itself_is_believed_before_others(file: Path) -> None:
    """Each key has its own share of the scores of one version."""
    guest = give(file, "guest", "evaluator")
    keys = read_keys(file)
    with staged(keys=keys) as stage:
        theirs, ours = raw(stage, keys, guest), raw(stage, keys, keys.evaluator)

        def scored(end: Any, version: int, reward: float) -> Any:
            stage.hub.publish(weights(version))
            sent = replace(scores(), weights_version=version, scalars={"mean_reward": reward})
            end.send_multipart(sent.encode(SPEC))
            return asked(stage, end, Heartbeat({}))

        assert isinstance(asked(stage, theirs, hello(role="evaluator", process="a")), Welcome)
        assert scored(theirs, 1, 0.25) == Alive(1)
        assert isinstance(asked(stage, ours, hello(role="evaluator", process="b")), Welcome)
        told = "evaluator 0: the run's own evaluator scores the weights"
        assert scored(theirs, 2, 0.5) == Reject(told, sequence=0, final=True)
        assert scored(ours, 2, 0.75) == Alive(2)
        assert [one.scalars["mean_reward"] for one in stage.arrivals] == [0.25, 0.75]


def test_a_revoked_key_ends_its_process_at_once_and_the_others_lose_nothing(
    tmp_path: Path, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("master.hub.security.LOOK_S", 0.05)
    monkeypatch.setattr("master.hub.sockets.LAST_ANSWER_S", float("inf"))
    bob = give(file, "bob")
    keys = read_keys(file)
    with staged(keys=keys, audit=Audit(tmp_path / "audit.jsonl")) as stage:
        path = write_file(tmp_path, stage.hub, keys)
        beside, end = raw(stage, keys, bob, kind=zmq.SUB), raw(stage, keys, bob)
        with make_client(path) as client:
            assert served(stage, client.join)
            assert isinstance(asked(stage, end, hello(process="bob")), Welcome)
            stage.hub._registry.recover(("player", 7), 1, 1, 0.0, "before", "bob")

            def publish() -> None:
                stage.hub.publish(weights(version=stage.hub.counters["published"] + 1))

            stage.until(lambda: publish() or beside.poll(10))
            write_keys(file, replace(keys, given={}))
            # While somebody says more than one poll takes.
            loud = raw(stage, keys, keys.player)
            assert asked(stage, loud, Heartbeat({})) == Greet()
            with monkeypatch.context() as flooded:
                flooded.setattr("master.hub.hub.READ_S", 0.0)

                def shouted() -> int:
                    with suppress(zmq.Again):
                        for _ in range(5):
                            loud.send_multipart(Heartbeat({}).encode(), zmq.NOBLOCK)
                    return int(end.poll(0))

                stage.until(shouted)
            told = decode_from_master(end.recv_multipart(), None)
            assert told == Stop("the key bob was revoked")
            assert [peer.holder for peer in stage.hub.peers] == ["player"]
            assert "owner" not in stage.hub.state()["player/7"]  # bob's index is free again
            assert asked(stage, end, Heartbeat({})) == told
            while beside.poll(100):  # what was on its way
                beside.recv()
            client.newest_weights()
            client.send(episodes(), 0)
            both(stage, client, lambda: publish() or client.newest_weights())
            stage.until(stage.batches)
            assert client.counters["reconnects"] == 0
            assert not beside.poll(500)
    again = {"event": "refused", "key": "bob", "address": "127.0.0.1", "reason": "revoked"}
    assert again.items() <= lines(tmp_path / "audit.jsonl")[-1].items()
