"""The evaluator: plays the fixed test set with the newest weights, without exploration."""

import logging
import time
from contextlib import closing

import numpy as np
from PIL import Image

from tangram_core.agent import Weights
from tangram_core.arrays import Pixels
from tangram_core.scores import SHOWN, told
from tangram_core.setup import Setup
from tangram_core.wire.messages import PICTURE_HEIGHT, PICTURE_WIDTH, Scores
from worker.config import WorkerConfig
from worker.play.rollout import greedy
from worker.play.session import Acting, joined
from worker.score.test_set import FixedTests
from worker.talk.client import Client

POLL_S = 0.2
# Weights are scored at once if no newer ones follow for so long: they are probably the last.
STILL_S = 2.0

_log = logging.getLogger(__name__)


class Schedule:
    """Decides which weights are scored and when: normally once every `interval` seconds.

    If no newer weights arrive for `still` seconds, the newest are scored at once. So the last
    weights of a training are always scored. The wait is never shorter than the last evaluation:
    otherwise an agent that learns in bursts would be scored all the time, and the evaluator would
    take a core that the players need.
    """

    def __init__(self, interval: float, still: float) -> None:
        self._interval, self._still, self._least_still = interval, still, still
        self._newest: Weights | None = None
        self._arrived = self._began = -np.inf

    def offer(self, weights: Weights | None, now: float) -> None:
        """Store newer weights, the next candidate; None if none arrived."""
        if weights is not None:
            self._newest, self._arrived = weights, now

    def due(self, now: float) -> Weights | None:
        """The weights to score now, or None; every version is returned at most once."""
        waited, stood = now - self._began, now - self._arrived
        if self._newest is None or (waited < self._interval and stood < self._still):
            return None
        weights, self._newest, self._began = self._newest, None, now
        return weights

    def scored(self, now: float) -> None:
        """Record that the weights from `due` have been scored."""
        self._still = max(self._least_still, now - self._began)


def run_evaluator(config: WorkerConfig, setup: Setup) -> int:
    """Score the newest weights until the master or a signal stops this process.

    Exit status and errors are those of `run_player`.
    """
    acting, service = Acting(setup.agent.actor(setup.task)), config.service
    schedule = Schedule(service.eval_seconds, max(STILL_S, 4.0 * service.publish_seconds))
    at_once = service.envs_for(setup.spec.horizon)
    tests = FixedTests(setup.task, service.eval_episodes, at_once)
    with closing(tests), joined(config, setup, acting.actor) as client:
        while not client.stopped:
            client.poll(POLL_S)
            schedule.offer(client.newest_weights(), time.monotonic())
            weights = schedule.due(time.monotonic())
            if weights is not None:
                acting.follow(weights)
                scores = _evaluate(tests, acting, client)
                if scores is not None:
                    client.send_scores(scores)
                schedule.scored(time.monotonic())
    return 0


def _evaluate(tests: FixedTests, acting: Acting, client: Client) -> Scores | None:
    """Scores of the loaded weights; None if the client was stopped during the test."""
    began, task = time.monotonic(), tests.task

    def go_on() -> bool:
        client.poll()
        return not client.stopped

    played = tests.play(greedy(acting.actor), go_on)
    client.poll()
    if client.stopped:
        return None
    count = {"episodes": float(played.episodes.count), "seconds": time.monotonic() - began}
    scalars = {**task.score(played), **count}
    _log.info(
        "weights %d: %s (%.1f s)",
        acting.version,
        told(task.scores[:SHOWN], scalars),
        scalars["seconds"],
        extra={"event": "scored", "weights_version": acting.version} | scalars,
    )
    picture = task.draw(played)
    none = np.zeros((0, PICTURE_WIDTH, 3), np.uint8)
    return Scores(acting.version, scalars, none if picture is None else framed(picture))


def framed(picture: Pixels) -> Pixels:
    """A picture (H, W, 3) fitted to a message: shrunk if too large, padded to the full width."""
    image = Image.fromarray(picture)
    image.thumbnail((PICTURE_WIDTH, PICTURE_HEIGHT))
    canvas = Image.new("RGB", (PICTURE_WIDTH, image.height), image.getpixel((0, 0)))
    canvas.paste(image)
    return np.asarray(canvas)
