"""The process that scores: plays the fixed test set with the newest weights, noise off."""

import logging
import time
from contextlib import closing

import numpy as np
from PIL import Image

from tangram_agent.config import ServiceConfig
from tangram_agent.messages import PICTURE_HEIGHT, PICTURE_WIDTH, Scores
from tangram_agent.policy import Policy
from tangram_agent.setup import Setup
from tangram_agent.types import Weights
from tangram_core.arrays import Pixels
from tangram_sim.drawing.scenes import episode_sheet
from worker.config import WorkerConfig
from worker.play.rollout import Played
from worker.play.session import joined
from worker.score.test_set import FixedTests, greedy
from worker.talk.client import Client

PICTURES, PICTURE_COLUMNS, PICTURE_PIXELS = 12, 4, 216
POLL_S = 0.2
# Weights that no newer ones follow for so long are probably the last: their score is waited for.
STILL_S = 2.0

_log = logging.getLogger(__name__)


class Schedule:
    """Which weights are scored, and when: at most one evaluation each `interval` seconds.

    A version that nothing newer follows is scored without waiting for the interval's end, and
    whatever happens the newest version is scored in the end. It stands still when nothing follows
    for `still` seconds, and for as long as scoring takes: an agent that learns in bursts, since it
    waits for pictures, would else be scored all the time, on a core that its players need.
    """

    def __init__(self, interval: float, still: float) -> None:
        self._interval, self._still, self._least_still = interval, still, still
        self._newest: Weights | None = None
        self._arrived = self._began = -np.inf

    def offer(self, weights: Weights | None, now: float) -> None:
        """Note newer weights; None if none arrived."""
        if weights is not None:
            self._newest, self._arrived = weights, now

    def due(self, now: float) -> Weights | None:
        """The weights to score now; each is given once."""
        waited, stood = now - self._began, now - self._arrived
        if self._newest is None or (waited < self._interval and stood < self._still):
            return None
        weights, self._newest, self._began = self._newest, None, now
        return weights

    def scored(self, now: float) -> None:
        """Note that what was due is scored."""
        self._still = max(self._least_still, now - self._began)


def run_evaluator(config: WorkerConfig, setup: Setup) -> int:
    """Score the newest weights until the master or a signal ends it.

    Returns:
        Exit status 0.

    Raises:
        TangramError: a setting that cannot work, or a master that refuses or is gone for long.
    """
    policy, schedule = Policy(setup), _schedule(config.service)
    tests = FixedTests(setup, config.service.eval_episodes, config.service.envs)
    with closing(tests), joined(config, setup, policy) as client:
        while not client.stopped:
            client.poll(POLL_S)
            schedule.offer(client.newest_weights(), time.monotonic())
            weights = schedule.due(time.monotonic())
            if weights is not None:
                policy.follow(weights)
                scores = _evaluate(tests, policy, client)
                if scores is not None:
                    client.send_scores(scores)
                schedule.scored(time.monotonic())
    return 0


def _schedule(service: ServiceConfig) -> Schedule:
    return Schedule(service.eval_seconds, max(STILL_S, 4.0 * service.publish_seconds))


def _evaluate(tests: FixedTests, policy: Policy, client: Client) -> Scores | None:
    """Scores of the policy; None if the client was stopped meanwhile."""
    began = time.monotonic()

    def go_on() -> bool:
        client.poll()
        return not client.stopped

    played = tests.play(greedy(policy), go_on)
    client.poll()
    if client.stopped:
        return None
    scalars = tests.scores(played) | {"seconds": time.monotonic() - began}
    _log.info(
        "weights %d: mean reward %.3f, raw overlap %.3f, median angle error %.2f degrees (%.1f s)",
        policy.version,
        *(scalars[name] for name in ("mean_reward", "raw_overlap", "angle_error_deg_median")),
        scalars["seconds"],
        extra={"event": "scored", "weights_version": policy.version} | scalars,
    )
    return _message(tests.setup, policy.version, scalars, played)


def _message(setup: Setup, version: int, scalars: dict[str, float], played: Played) -> Scores:
    shown = (played.starts, played.ends, played.goals)
    starts, ends, goals = (corners[:PICTURES] for corners in shown)
    layout, arena = setup.layout, setup.sim.arena
    sheet = episode_sheet(layout, arena, starts, ends, goals, PICTURE_COLUMNS, PICTURE_PIXELS)
    return Scores(version, scalars, framed(np.asarray(sheet.convert("RGB"))))


def framed(picture: Pixels) -> Pixels:
    """A picture (H, W, 3) as a message takes it: smaller if need be, on white of its width."""
    image = Image.fromarray(picture)
    image.thumbnail((PICTURE_WIDTH, PICTURE_HEIGHT))
    canvas = Image.new("RGB", (PICTURE_WIDTH, image.height), "white")
    canvas.paste(image)
    return np.asarray(canvas)
