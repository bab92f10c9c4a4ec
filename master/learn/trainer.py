"""The trainer: the agent's learner, the rate limiter, and their state; without sockets."""

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

COMPILED = "compiled"  # name of a checkpoint's value: whether its updates were compiled
LEARNER, REPLAY = "learner", "replay"  # files of a checkpoint: networks and optimisers; transitions

Arrays = dict[str, dict[str, npt.NDArray[Any]]]


class Trainer:
    """The learner with its rate limiter, its random generators and its counters.

    Attributes:
        setup: the task and the agent.
        compiled: whether updates are compiled; this cannot change during a run.
        learner: the agent's learner.
        pace: how many updates a transition is worth, and when learning starts.
        rate_limiter: tells when an update is due.
        episodes: number inserted since the run began.
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
        """Number of updates since the run began."""
        return self.learner.updates

    @property
    def transitions(self) -> int:
        """Number of inserted transitions as they were played, without relabelled ones."""
        return self.episodes * self.setup.spec.horizon

    def facts(self) -> dict[str, Any]:
        """Facts about the task and the agent for result.json, by name."""
        learner = self.learner
        own = {"device": learner.device, "parameters": learner.parameters}
        return {**self.setup.agent.facts(), **self.setup.task.facts(), **own}

    def insert(self, episodes: Episodes) -> None:
        """Insert episodes into the replay buffer."""
        # The learner says how many transitions it can learn from; only these make updates due.
        self.rate_limiter.inserted(self.learner.insert(episodes, self._generators))
        self.episodes += episodes.count

    def update(self, share: float) -> dict[str, float]:
        """Make one update, at this used share of the budget in [0, 1]; returns losses by name."""
        losses = self.learner.update(share, self._generators)
        self.rate_limiter.updated()
        return losses

    def go_back(self, state: dict[str, npt.NDArray[Any]]) -> None:
        """Restore an earlier state of the learner; the updates since then are due again."""
        before = self.updates
        self.learner.load_state(state)
        self.rate_limiter.updated(self.updates - before)

    def weights(self) -> Weights:
        """The weights that workers need to play; the version is the number of updates."""
        return Weights(self.updates, self.learner.broadcast())

    def state(self) -> tuple[Arrays, dict[str, Any]]:
        """Arrays by file, and JSON values, for a checkpoint.

        The caller makes sure that the arrays are finite, see `divergence`.
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
        """Restore what `state` returned; the settings stay those of this process.

        Raises:
            RunError: the state belongs to another task or network, or `compiled` differs.
        """
        check_same_task(self.setup, counters[SETUP])
        before = bool(counters.get(COMPILED, False))
        if before != self.compiled:
            raise RunError(
                f"the run began with service.compile={str(before).lower()}, and the other value "
                "would change its numbers: go on with that setting"
            )
        self.learner.load_state(arrays[LEARNER])
        self.learner.load_memory(arrays[REPLAY])
        self.rate_limiter.load_state(counters["rate_limiter"])
        self.episodes = int(counters["episodes"])
        for name, generator in self._generators.items():
            generator.bit_generator.state = counters["generators"][name]


def choose_device(wanted: str) -> str:
    """The device, `cpu` or `cuda`; `auto` takes a GPU if there is one.

    Raises:
        ConfigError: `cuda` is wanted, and there is no GPU.
    """
    if wanted == "cpu":
        return "cpu"
    if torch.cuda.is_available():
        return "cuda"
    if wanted == "cuda":
        raise ConfigError(
            "service.device=cuda needs a GPU, none is visible: set service.device=cpu"
        )
    return "cpu"
