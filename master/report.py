"""What goes on in the loop, told to the user and to TensorBoard at bounded rates."""

import time
from collections import OrderedDict
from collections.abc import Mapping

import numpy as np
from PIL import Image

from master.arrivals import EpisodesArrived
from master.budget import Rates
from master.console import Progress
from master.metrics import Curve, Means, Metrics
from master.parts import Parts
from master.rundir import Record
from master.standing import run_status
from master.status import Status
from master.trainer import Trainer
from tangram_agent.config import ServiceConfig
from tangram_agent.messages import Scores
from tangram_agent.process import Every
from tangram_agent.setup import Setup
from tangram_sim.drawing import episode_sheet

REMEMBERED_VERSIONS = 4096
PICTURE_COLUMNS = 4
CURVE_PIXELS = 120
PICTURE_S = 30.0
TICK_S = 0.1
STAND_S = 1.0


class Sent:
    """The state of the run when weights were sent.

    Attributes:
        at_s: monotonic time.
        episodes: taken in by then.
        loop_s, train_s: see `Record`.
    """

    def __init__(self, at_s: float, episodes: int, record: Record) -> None:
        self.at_s, self.episodes = at_s, episodes
        self.loop_s, self.train_s = record.loop_s, record.train_s


class Reporter:
    """Collects what happens between two reports."""

    def __init__(
        self, progress: Progress, metrics: Metrics, curve: Curve, service: ServiceConfig
    ) -> None:
        self.progress, self.metrics, self._curve = progress, metrics, curve
        self._losses, self._play = Means(), Means()
        self._rates = Rates()
        self._tick, self._stand = Every(TICK_S, at_once=True), Every(STAND_S, at_once=True)
        self._log, self._picture = Every(service.log_seconds), Every(PICTURE_S, at_once=True)
        self._published: OrderedDict[int, Sent] = OrderedDict()

    def published(self, version: int, parts: Parts) -> None:
        """Note when weights were sent, and which episodes they had learned from."""
        sent = Sent(time.monotonic(), parts.trainer.episodes, parts.record)
        self._published.setdefault(version, sent)
        while len(self._published) > REMEMBERED_VERSIONS:
            self._published.popitem(last=False)

    def updated(self, losses: Mapping[str, float]) -> None:
        """Note one update."""
        self._losses.add(losses)

    def inserted(self, arrival: EpisodesArrived, updates: int) -> None:
        """Note a batch that went into the replay."""
        episodes = arrival.episodes
        values = {
            "play/reward": float(np.mean(episodes.rewards[:, -1])),
            "weights/age_updates": float(updates - arrival.weights_version),
        }
        sent = self._published.get(arrival.weights_version)
        if sent is not None:
            values["weights/age_seconds"] = time.monotonic() - sent.at_s
        self._play.add(values, episodes.count)

    def scored(self, scores: Scores, parts: Parts) -> None:
        """Curves and a picture of an evaluation of weights that were sent a while ago."""
        values = {name: value for name, value in scores.scalars.items() if name != "episodes"}
        updates = scores.weights_version
        now = Sent(time.monotonic(), parts.trainer.episodes, parts.record)
        sent = self._published.get(updates, now)
        self.metrics.scores(values, updates, sent.episodes, sent.loop_s)
        self._curve.add(values, updates, sent.episodes, sent.train_s)
        # Drawing takes time from learning.
        if len(scores.ends) and self._picture.due():
            picture = scores_picture(scores, parts.setup, CURVE_PIXELS)
            self.metrics.picture(np.asarray(picture), updates)

    def tick(self, parts: Parts, more: Mapping[str, float]) -> None:
        """Show the state of the run, and write the curves when it is time.

        Args:
            parts: of the run.
            more: numbers that only the loop knows, for `standing`.
        """
        if not self._tick.due():
            return
        trainer = parts.trainer
        self._rates.mark(time.monotonic(), trainer.transitions, trainer.updates, parts.share)
        if self._stand.due():
            standing = run_status(self._status(parts), parts, more)
            parts.hub.tell(standing)
            if parts.health is not None:
                parts.health.update(standing)
        if self._log.due():
            self.flush(parts)
        else:
            self.progress.show(self._status(parts))

    def flush(self, parts: Parts) -> None:
        """Write the curves now, and show what they say."""
        self.progress.show(self._status(parts))
        trainer, rates = parts.trainer, self._rates
        values = {f"train/{name}": value for name, value in self._losses.take().items()}
        values |= self._play.take()
        values |= {
            "run/episodes": trainer.episodes,
            "run/seconds": parts.record.loop_s,
            "run/budget_share": parts.share,
            "run/workers": parts.count("player"),
            "replay/fill": len(trainer.replay) / trainer.replay.capacity,
            "rates/transitions_per_s": rates.transitions_per_s(),
            "rates/updates_per_s": rates.updates_per_s(),
            "rate_limiter/lag": trainer.rate_limiter.lag,
            "train/undone_updates": parts.guard.undone,
        }
        values |= {f"hub/{name}": value for name, value in parts.hub.counters.items()}
        self.metrics.scalars(values, trainer.updates)

    def _status(self, parts: Parts) -> Status:
        trainer, rates, bounded = parts.trainer, self._rates, parts.budget.bounded
        return Status(
            episodes=trainer.episodes,
            transitions=trainer.transitions,
            updates=trainer.updates,
            elapsed_s=parts.record.loop_s,
            share=parts.share if bounded else None,
            left_s=rates.left_s() if bounded else None,
            transitions_per_s=rates.transitions_per_s(),
            updates_per_s=rates.updates_per_s(),
            players=parts.count("player"),
            evaluators=parts.count("evaluator"),
            activity=activity(trainer, parts.count("player")),
            scores=parts.record.scores,
        )


def activity(trainer: Trainer, players: int) -> str:
    """What happens, or what is waited for."""
    limiter, starts = trainer.rate_limiter, trainer.setup.agent.learning_starts
    if limiter.may_update():
        return "learning, workers wait" if players and not limiter.may_insert() else "learning"
    if not players:
        return "waiting for workers to join"
    if limiter.transitions < starts:
        return f"filling the replay, {limiter.transitions:,} of {starts:,}"
    return "waiting for episodes"


def scores_picture(scores: Scores, setup: Setup, pixels: int) -> Image.Image:
    """The test episodes of an evaluation, each `pixels` wide, with its overlap."""
    corners = (scores.starts, scores.ends, scores.goals)
    return episode_sheet(setup.layout, setup.sim.arena, *corners, PICTURE_COLUMNS, pixels)
