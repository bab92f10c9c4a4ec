"""The player with a real hub on real sockets."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zmq

from master.hub.hub import Hub
from master.record.delivery import EpisodesArrived
from tangram_core.errors import TangramError
from tangram_core.run.process import Lifeline
from tangram_core.run.service import ServiceConfig
from tangram_core.seeding import episode_generator
from tangram_core.setup import Setup
from tangram_core.wire.messages import Go
from tests.agent.builders import setup
from tests.sim.builders import sample_poses
from tests.worker.builders import policy, sent, write_run
from tests.worker.talk.conversation import LIMIT_S, QUICK, collect, open_hub, with_master
from worker.config import WorkerConfig
from worker.play.player import run_player
from worker.play.session import keep_part
from worker.talk.client import Client

pytestmark = pytest.mark.cluster


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Heartbeats come often."""
    monkeypatch.setattr("worker.talk.client.Timing", lambda: QUICK)


SERVICE = ServiceConfig(envs=4)


def config(hub: Hub, service: ServiceConfig = SERVICE, **more: object) -> WorkerConfig:
    return WorkerConfig(hub.endpoint, service=service, **more)


def greedy_setup(**sim: object) -> Setup:
    """No noise at all: actions follow from corners and weights."""
    return setup(agent={"noise": 0.0, "uniform_share": 0.0}, **sim)


def assert_episodes(
    made: Setup,
    arrived: list[EpisodesArrived],
    identity: tuple[int, str, int, int],
    numbers: Sequence[int],
) -> None:
    """The batches are these episodes, by their targets."""
    goals = np.concatenate([batch.episodes["goals"] for batch in arrived])
    for number, goal in zip(numbers, goals, strict=True):
        rng = episode_generator(*identity, number)
        expected = made.task.layout.corners(sample_poses(made.task.layout, made.task.sim, rng))
        np.testing.assert_allclose(goal, expected, atol=1e-6)


def test_weights_change_between_batches_only_and_batches_tell_which() -> None:
    made = greedy_setup(actions_per_token=3)

    # New weights come all the time, also in the middle of a batch.
    service = replace(SERVICE, envs=8)
    sets = [sent(made, i) for i in range(5)]

    def script(hub: Hub) -> list[EpisodesArrived]:
        arrived: list[EpisodesArrived] = []
        version = 0
        deadline = time.monotonic() + LIMIT_S
        while len({batch.weights_version for batch in arrived}) < 6:
            assert time.monotonic() < deadline
            hub.publish(replace(sets[version % 5], version=version))
            version += 1
            for batch in hub.poll(0.002):
                arrived.append(batch)
                hub.acknowledge(batch)
        return arrived

    hub = open_hub(made, window=2)
    arrived, status = with_master(hub, script, lambda: run_player(config(hub, service), made))
    assert status == 0
    versions = [batch.weights_version for batch in arrived]
    assert versions == sorted(versions)
    for batch in arrived:
        acting = policy(made, batch.weights_version % 5)
        # Copies: what arrives is read-only, and torch warns of that.
        played = {name: column.copy() for name, column in batch.episodes.arrays.items()}
        for t in range(3):
            expected = acting.act(played["corners"][:, t], played["placed"][:, t], played["goals"])
            np.testing.assert_allclose(played["actions"][:, t], expected, atol=1e-4)


def test_messages_hold_the_episodes_of_this_worker_in_order(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two groups of 4 fill a message of 6; the rest follows at once, with the same weights."""
    monkeypatch.setattr("tangram_core.wire.arrays.MAX_EPISODES", 6)
    made = greedy_setup()

    def script(hub: Hub) -> list[EpisodesArrived]:
        hub.publish(sent(made, 1))
        arrived = []
        while len(arrived) < 5:
            batch = collect(hub, bool)
            arrived += batch
            for one in batch:
                hub.acknowledge(one)
        return arrived

    hub = open_hub(made, seed=3)
    arrived, _ = with_master(hub, script, lambda: run_player(config(hub, index=7), made))
    assert [batch.episodes.count for batch in arrived[:5]] == [6, 2, 6, 2, 6]
    assert {(batch.index, batch.incarnation) for batch in arrived} == {(7, 1)}
    assert_episodes(made, arrived[:5], (3, "player", 7, 1), range(22))


def test_nothing_is_played_ahead_while_the_window_is_full() -> None:
    """After a pause play goes on with the weights of now, not with those from before it."""
    made = greedy_setup()
    service = replace(SERVICE, envs=2)

    def script(hub: Hub) -> list[EpisodesArrived]:
        hub.publish(sent(made, 1))
        first = collect(hub, lambda batches: len(batches) == 2)
        hub.publish(sent(made, 2))
        # The first heartbeat from now on tells the worker of version 2 and makes it ask if it has
        # none; that answer goes out before the one to the second.
        heard = hub.counters["heartbeats"]
        late = collect(hub, lambda _: hub.counters["heartbeats"] >= heard + 2)
        assert late == []
        assert hub.peers[0].stats["episodes"] == 8.0
        hub.acknowledge(first[0])
        return collect(hub, bool)

    hub = open_hub(made, window=2)
    after, _ = with_master(hub, script, lambda: run_player(config(hub, service), made))
    assert [(batch.sequence, batch.weights_version) for batch in after] == [(3, 2)]


def test_in_lockstep_what_is_ordered_is_played_and_nothing_else() -> None:
    made = greedy_setup()

    def script(hub: Hub) -> list[EpisodesArrived]:
        arrived = []
        for number in range(3):
            hub.publish(sent(made, number))
            hub.order({0: Go(number, number, 16 * number, 8)})  # every other eight
            arrived += collect(hub, bool)
            hub.acknowledge(arrived[-1])
        return arrived

    hub = open_hub(made, seed=3, lockstep=True)
    arrived, status = with_master(hub, script, lambda: run_player(config(hub), made))
    assert status == 0
    told = [(batch.sequence, batch.weights_version, batch.episodes.count) for batch in arrived]
    assert told == [(1, 0, 8), (2, 1, 8), (3, 2, 8)]
    numbers = [16 * batch + i for batch in range(3) for i in range(8)]
    assert_episodes(made, arrived, (3, "player", 0, 0), numbers)  # 0 in every incarnation


def test_in_lockstep_a_player_with_other_environments_says_so() -> None:
    made, hub = greedy_setup(), open_hub(greedy_setup(), lockstep=True)

    def script(hub: Hub) -> None:
        hub.publish(sent(made, 0))
        hub.order({0: Go(0, 0, 0, 6)})
        collect(hub, lambda _: hub.counters["byes"] == 1)

    refusal = r"asks for 6 episodes, not a multiple of service\.envs=4"
    with pytest.raises(TangramError, match=refusal):
        with_master(hub, script, lambda: run_player(config(hub), made))


@pytest.fixture
def survivable_signals() -> Iterator[dict[int, object]]:
    """What the handlers were; without the worker's own a signal does nothing."""
    numbers = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)
    before = {number: signal.signal(number, lambda *_: None) for number in numbers}
    yield {number: signal.getsignal(number) for number in numbers}
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGUSR1])
def test_a_signal_ends_a_player_with_a_goodbye(
    number: signal.Signals, survivable_signals: dict[int, object], capfd: pytest.CaptureFixture[str]
) -> None:
    made = greedy_setup()

    def script(hub: Hub) -> None:
        hub.publish(sent(made, 1))
        for batch in collect(hub, bool):
            hub.acknowledge(batch)
        os.kill(os.getpid(), number)
        collect(hub, lambda _: hub.counters["byes"] == 1)

    hub = open_hub(made)
    _, status = with_master(hub, script, lambda: run_player(config(hub), made))
    assert status == 0
    assert {n: signal.getsignal(n) for n in survivable_signals} == survivable_signals
    lines = [line.partition(" ")[2] for line in capfd.readouterr().err.splitlines()]
    assert [line for line in lines if "is behind" not in line] == [
        f"player: joins {hub.endpoint}, waits at most 3600 s for its master",
        "player 0: joined run run",
        "player 0: waits: no weights yet",
        f"player 0: ends: {number.name}",
    ]


@pytest.mark.parametrize("index", [-1, 0], ids=["given", "asked for"])
def test_a_player_whose_index_is_taken_goes_on_if_it_asked_for_none(
    capfd: pytest.CaptureFixture[str], index: int
) -> None:
    """One that is started by hand may be there before the run's own workers, which ask for 0."""
    made = greedy_setup()

    def script(hub: Hub) -> list[int]:
        hub.publish(sent(made, 1))
        [first, *_] = collect(hub, bool)
        with Client(hub.endpoint, "player", 0, made.fingerprints(), made.spec) as taker:
            collect(hub, lambda _: taker.poll() or taker.joined)
            if index >= 0:
                return [first.index]
            [again, *_] = collect(hub, bool)
        return [first.index, again.index]

    hub = open_hub(made)
    found, status = with_master(
        hub, script, lambda: keep_part(run_player, config(hub, index=index), made)
    )
    assert (found, status) == ([0] if index >= 0 else [0, 1], 0)
    # It may be told before its connection is gone, or when it comes again.
    taken = (
        r"player 0 was taken over by a newer process( \(.*\))?: this process joins again, with a"
    )
    assert bool(re.search(taken, capfd.readouterr().err)) == (index < 0)


def test_a_signal_ends_a_player_that_no_master_answers(
    survivable_signals: dict[int, object], capfd: pytest.CaptureFixture[str]
) -> None:
    made = greedy_setup()
    with (
        zmq.Context() as context,
        context.socket(zmq.ROUTER) as mute,
        ThreadPoolExecutor(1) as pool,
    ):
        endpoint = f"tcp://127.0.0.1:{mute.bind_to_random_port('tcp://127.0.0.1')}"

        def wait_for_hello() -> bool:
            heard = mute.poll(LIMIT_S * 1000)
            os.kill(os.getpid(), signal.SIGTERM)
            return bool(heard)

        heard = pool.submit(wait_for_hello)
        assert run_player(WorkerConfig(endpoint, service=SERVICE), made) == 0
        assert "no weights yet" not in capfd.readouterr().err
        assert heard.result(LIMIT_S)


def test_a_process_whose_parent_is_gone_takes_its_leave(tmp_path: Path) -> None:
    """As tangram-train starts a worker; the master lives on and asks for nothing."""
    made = write_run(tmp_path)
    lifeline = Lifeline()
    with open_hub(made) as hub:
        given = (f"connect={hub.endpoint}", f"from_config={tmp_path / 'config.yaml'}")
        command = [sys.executable, "-m", "tangram_cli", "worker", *given, "service.envs=2"]
        with subprocess.Popen(
            command, env=lifeline.environment(os.environ), pass_fds=(lifeline.read_end,)
        ) as process:
            try:
                lifeline.started()
                hub.publish(sent(made, 1))
                assert collect(hub, lambda found: found or process.poll() is not None)
                lifeline.cut()
                collect(hub, lambda _: hub.counters["byes"] == 1)
                assert process.wait(LIMIT_S) == 0
            finally:
                process.kill()
