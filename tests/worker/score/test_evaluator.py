"""The evaluator with a real hub on real sockets, and the schedule of its evaluations."""

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from master.hub.hub import Hub
from master.record.delivery import Arrival
from tangram_core.run.service import ServiceConfig
from tangram_core.wire.messages import PICTURE_WIDTH, Scores
from tests.agent.builders import PAIR, SQUARE, setup
from tests.worker.builders import policy, sent, weights
from tests.worker.talk.conversation import QUICK, collect, open_hub, with_master
from worker.config import WorkerConfig
from worker.play.rollout import greedy
from worker.score.evaluator import Schedule, run_evaluator
from worker.score.test_set import FixedTests


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Heartbeats come often."""
    monkeypatch.setattr("worker.talk.client.Timing", lambda: QUICK)


SERVICE = ServiceConfig(envs=6, eval_episodes=20, eval_seconds=3600.0, publish_seconds=0.1)


def config(hub: Hub, service: ServiceConfig = SERVICE) -> WorkerConfig:
    return WorkerConfig(hub.endpoint, role="evaluator", service=service)


@pytest.mark.cluster
@pytest.mark.parametrize("tokens", [SQUARE, PAIR])
def test_the_newest_weights_are_scored_on_the_fixed_tests(tokens: dict) -> None:
    made = setup(tokens, pixels=32)

    def script(hub: Hub) -> list[Scores]:
        hub.publish(sent(made, 5))
        first = collect(hub, bool)
        # The interval of an hour does not hold up the last version: no other follows it.
        for version in (6, 7, 8):
            hub.publish(sent(made, version))
        return first + collect(hub, lambda found: found and found[-1].weights_version == 8)

    hub = open_hub(made)
    arrived, status = with_master(hub, script, lambda: run_evaluator(config(hub), made))
    assert status == 0
    versions = [one.weights_version for one in arrived]
    assert versions[0] == 5
    assert versions == sorted(set(versions))
    with closing(FixedTests(made.task, 20, 6)) as tests:
        for found in arrived:
            expected = tests.play(greedy(policy(made, found.weights_version).actor))
            scalars = dict(found.scalars)
            assert scalars.pop("seconds") >= 0.0
            assert scalars.pop("episodes") == 20.0
            assert scalars == pytest.approx(made.task.score(expected), abs=1e-4)
            assert "mean_reward_camera" in scalars
            assert found.picture.shape[1:] == (PICTURE_WIDTH, 3)
            assert len(np.unique(found.picture)) > 9  # something is drawn


@pytest.mark.cluster
def test_a_long_evaluation_keeps_in_touch_and_can_be_stopped() -> None:
    """Alone it would take longer than any wait here."""
    made = setup(pixels=16)
    service = replace(SERVICE, envs=1, eval_episodes=100_000)

    def script(hub: Hub) -> list[Arrival]:
        hub.publish(sent(made, 1))
        return collect(hub, lambda _: hub.counters["heartbeats"] >= 3)

    hub = open_hub(made)
    arrived, status = with_master(hub, script, lambda: run_evaluator(config(hub, service), made))
    assert (arrived, status) == ([], 0)
    assert hub.counters["scores"] == 0


# (time, version that arrives or 0, version that must be given or 0); interval 10, still 2
TIMELINES = {
    "the first at once": [(0.0, 0, 0), (1.0, 1, 1), (1.5, 0, 0)],
    "the newest after the interval": [
        (0.0, 1, 1),
        *[(0.5 * i, i + 1, 0) for i in range(1, 20)],
        (10.0, 21, 21),
    ],
    "one that stands still does not wait": [(0.0, 1, 1), (1.0, 2, 0), (2.9, 0, 0), (3.0, 0, 2)],
    "each version once": [(0.0, 1, 1), (2.5, 0, 0), (20.0, 0, 0), (30.0, 2, 2)],
    "each newer one begins the wait anew": [
        (0.0, 1, 1),
        (1.0, 2, 0),
        (2.5, 3, 0),
        (4.0, 0, 0),
        (4.5, 0, 3),
    ],
    "the interval begins with an evaluation": [(0.0, 1, 1), (12.0, 2, 2), (13.0, 3, 0)],
}


@pytest.mark.fast
@pytest.mark.parametrize("timeline", TIMELINES.values(), ids=TIMELINES)
def test_schedule(timeline: list[tuple[float, int, int]]) -> None:
    schedule = Schedule(interval=10.0, still=2.0)
    some = weights(setup(), 1)
    for now, arrives, expected in timeline:
        schedule.offer(replace(some, version=arrives) if arrives else None, now)
        due = schedule.due(now)
        assert (due.version if due else 0) == expected, f"at {now} s"


@pytest.mark.fast
def test_weights_that_come_in_bursts_wait_for_as_long_as_scoring_takes() -> None:
    schedule = Schedule(interval=60.0, still=2.0)
    some = weights(setup(), 1)
    versions = [replace(some, version=version) for version in (1, 2, 3)]
    schedule.offer(versions[0], 0.0)
    assert schedule.due(0.0) is versions[0]
    schedule.scored(20.0)
    schedule.offer(versions[1], 21.0)
    assert schedule.due(40.9) is None
    assert schedule.due(41.0) is versions[1]
    schedule.scored(42.0)
    schedule.offer(versions[2], 43.0)
    assert schedule.due(44.9) is None
    assert schedule.due(45.0) is versions[2]
