"""What learns, without sockets: the agent's learner, the rate limiter, and their state."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from master.learn.rate_limiter import LAG_UPDATES, RateLimiter
from master.record.resumable import check_same_task
from tangram_core.agent import Weights
from tangram_core.errors import ConfigError, RunError
from tangram_core.setup import Setup
from tangram_core.spec import Episodes
from tangram_core.store.checkpoints import ACTING, SETUP

COMPILED = "compiled"  # of a checkpoint's values: how its updates were made
LEARNER, REPLAY = "learner", "replay"  # the checkpoint's files: networks and optimisers; experience

Arrays = dict[str, dict[str, npt.NDArray[Any]]]


class Trainer:
    """The learner and everything that its next update depends on.

    Attributes:
        compiled: whether updates are compiled; a run stays with what it began with.
        episodes: taken in since the run began.
    """

    def __init__(
        self,
        setup: Setup,
        seed: int,
        device: str,
        lag_updates: int = LAG_UPDATES,
        compiled: bool = False,
    ) -> None:
        self.setup, self.compiled = setup, compiled
        self.learner = setup.agent.learner(setup.task, seed, device, compiled=compiled)
        self.pace = setup.agent.pace
        self.rate_limiter = RateLimiter(
            self.pace.updates_per_transition, self.pace.learning_starts, lag_updates
        )
        self.episodes = 0
        self._generators = {
            name: np.random.default_rng([seed, stream])
            for stream, name in enumerate(self.learner.streams)
        }

    @property
    def updates(self) -> int:
        """Updates since the run began."""
        return self.learner.updates

    @property
    def transitions(self) -> int:
        """Transitions played that were taken in, without relabelled ones."""
        return self.episodes * self.setup.spec.horizon

    def facts(self) -> dict[str, Any]:
        """What a result tells of the task and the agent."""
        learner = self.learner
        own = {"device": learner.device, "parameters": learner.parameters}
        return {**self.setup.agent.facts(), **self.setup.task.facts(), **own}

    def insert(self, episodes: Episodes) -> None:
        """Take in episodes as they were played."""
        # The pace is that of what can be learned from.
        self.rate_limiter.inserted(self.learner.insert(episodes, self._generators))
        self.episodes += episodes.count

    def update(self, share: float) -> dict[str, float]:
        """One update, at the used share of the budget; returns its losses."""
        losses = self.learner.update(share, self._generators)
        self.rate_limiter.updated()
        return losses

    def go_back(self, state: dict[str, npt.NDArray[Any]]) -> None:
        """Take the learner back to a state of its own; the updates since are due again."""
        before = self.updates
        self.learner.load_state(state)
        self.rate_limiter.updated(self.updates - before)

    def weights(self) -> Weights:
        """What workers need to play; its version is the number of updates."""
        return Weights(self.updates, self.learner.broadcast())

    def state(self) -> tuple[Arrays, dict[str, Any]]:
        """Arrays by file, and JSON values, for a checkpoint.

        The caller sees to it that they are finite, see `divergence`.
        """
        learner = self.learner
        arrays = {ACTING: learner.export(), LEARNER: learner.state(), REPLAY: learner.memory()}
        generators = {name: g.bit_generator.state for name, g in self._generators.items()}
        counters = {
            "episodes": self.episodes,
            "rate_limiter": self.rate_limiter.state(),
            COMPILED: self.compiled,
            "generators": generators,
            SETUP: self.setup.contents(),
        }
        return arrays, counters

    def load_state(self, arrays: Mapping[str, Any], counters: Mapping[str, Any]) -> None:
        """Take over a state from `state()`; settings stay those of this process.

        Raises:
            RunError: the state belongs to another task or network, or its updates were compiled and
                these are not, or the reverse.
        """
        check_same_task(self.setup, counters[SETUP])
        before = bool(counters.get(COMPILED, False))
        if before != self.compiled:
            raise RunError(
                f"the run learned with service.compile={str(before).lower()} so far, and its "
                "numbers would not be the same otherwise: go on with that"
            )
        self.learner.load_state(arrays[LEARNER])
        self.learner.load_memory(arrays[REPLAY])
        self.rate_limiter.load_state(counters["rate_limiter"])
        self.episodes = int(counters["episodes"])
        for name, generator in self._generators.items():
            generator.bit_generator.state = counters["generators"][name]


def choose_device(wanted: str) -> str:
    """`auto` is a GPU where there is one; ConfigError where one is wanted and there is none."""
    if wanted == "cpu":
        return "cpu"
    if torch.cuda.is_available():
        return "cuda"
    if wanted == "cuda":
        raise ConfigError(
            "service.device=cuda needs a GPU, none is visible: set service.device=cpu"
        )
    return "cpu"
