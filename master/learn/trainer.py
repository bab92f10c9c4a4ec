"""What learns, without sockets: networks, replay, hindsight, rate limiter, and their state."""

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import torch

from master.learn.rate_limiter import LAG_UPDATES, RateLimiter
from master.record.resumable import check_same_task
from tangram_agent.agents.outline.filling_learner import FillLearner
from tangram_agent.agents.outline.filling_replay import FillReplay
from tangram_agent.agents.pair.motion import Motions, motions_of
from tangram_agent.checkpoints import ACTING, SETUP
from tangram_agent.learner import Learner
from tangram_agent.networks import travelling
from tangram_agent.relabelling import learnable, with_relabelled
from tangram_agent.replay import ReplayBuffer
from tangram_agent.setup import Setup
from tangram_agent.types import Transitions, Weights
from tangram_core.errors import ConfigError, RunError
from tangram_core.spec import Episodes
from tangram_sim.rewards import make_reward

STREAMS = ("replay", "hindsight", "motion")
SEEN_MOTIONS = 256  # transitions of whole episodes that the motion model sees in an update
COMPILED = "compiled"  # of a checkpoint's values: how its updates were made
LEARNER = "learner"  # the checkpoint's file of networks and optimisers

Arrays = dict[str, dict[str, npt.NDArray[Any]]]


class Trainer:
    """The learner and everything that its next update depends on.

    Attributes:
        setup: the task and the agent.
        compiled: whether updates are compiled; a run stays with what it began with.
        learner: networks and optimisers.
        replay: transitions played, and relabelled ones.
        rate_limiter: decides whether to learn or to take in episodes.
        episodes: taken in since the run began.
        batch: of the last update.
    """

    def __init__(
        self,
        setup: Setup,
        seed: int,
        device: str,
        lag_updates: int = LAG_UPDATES,
        compiled: bool = False,
    ) -> None:
        agent, layout = setup.agent, setup.layout
        self.setup, self.compiled = setup, compiled
        self.reward = make_reward(setup.reward, layout, setup.sim)
        self.learner: Learner | FillLearner
        self.replay: ReplayBuffer | FillReplay
        if setup.fills:
            self.learner, self.replay = FillLearner(setup, seed, device), FillReplay(setup)
        else:
            self.learner = Learner(setup, seed, device, compiled)
            self.replay = ReplayBuffer(
                agent.replay_capacity,
                layout.corner_count,
                layout.tokens,
                setup.action_size,
            )
        self.rate_limiter = RateLimiter(
            agent.updates_per_transition, agent.learning_starts, lag_updates
        )
        self.episodes = 0
        self.batch: Transitions | None = None
        self._generators = {
            name: np.random.default_rng([seed, stream])
            for stream, name in enumerate(STREAMS)
            if name != "motion" or setup.learns_motion
        }

    @property
    def updates(self) -> int:
        """Updates since the run began."""
        return self.learner.updates

    @property
    def transitions(self) -> int:
        """Transitions played that were taken in, without relabelled ones."""
        return self.episodes * self.setup.horizon

    def facts(self) -> dict[str, Any]:
        """What a result tells of the task and the agent."""
        setup = self.setup
        return {
            "agent": setup.agent.name,
            "net": setup.net.kind,
            "tokens": [shape.name for shape in setup.layout.shapes],
            "actions_per_token": setup.sim.actions_per_token,
            "reward": setup.reward.name,
            "backend": setup.sim.backend,
            "device": str(self.learner.device),
            "parameters": self.learner.parameters,
        }

    def insert(self, episodes: Episodes) -> None:
        """Take in episodes as they were played, and relabelled."""
        generator = self._generators["hindsight"]
        seen = learnable(episodes)
        learned_from = seen.transitions
        if isinstance(self.replay, FillReplay):
            learned_from = self.replay.insert(seen, generator)
        elif seen.count:
            # What is credited piece by piece is relabelled anew for every update.
            relabels = () if self.setup.credits_pieces else self.setup.agent.hindsight
            self.replay.add(
                with_relabelled(seen, relabels, self.setup.layout, self.reward, generator)
            )
        # The pace is that of what can be learned from.
        self.rate_limiter.inserted(learned_from)
        self.episodes += episodes.count

    def update(self, share: float) -> dict[str, float]:
        """One update, at the used share of the budget; returns its losses."""
        losses = self._learned(share)
        self.rate_limiter.updated()
        return losses

    def _learned(self, share: float) -> dict[str, float]:
        size, generator = self.setup.agent.batch_size, self._generators["replay"]
        if isinstance(self.learner, FillLearner) and isinstance(self.replay, FillReplay):
            return self.learner.learn(self.replay.sample(size, generator), share)
        self.batch = cast("ReplayBuffer", self.replay).sample(size, generator)
        prepared = self.learner.prepared(self.batch, self._generators["hindsight"])
        return self.learner.update(prepared, share, self._motions())

    def _motions(self) -> Motions | None:
        """What whole episodes of the replay tell of the motion, where it is learned."""
        if not self.setup.learns_motion:
            return None
        steps = self.setup.horizon
        count = max(1, SEEN_MOTIONS // steps)
        buffer = cast("ReplayBuffer", self.replay)
        past, ends = buffer.sample_episodes(count, steps, self._generators["motion"])
        return motions_of(past, ends.astype(np.float64), self.setup.layout, self.setup.sim)

    def go_back(self, state: dict[str, npt.NDArray[Any]]) -> None:
        """Take the learner back to a state of its own; the updates since are due again."""
        before = self.updates
        self.learner.load_state(state)
        self.rate_limiter.updated(self.updates - before)

    def weights(self) -> Weights:
        """What workers need to play; its version is the number of updates."""
        return travelling(self.learner.acting_weights(self.updates), self.setup)

    def state(self) -> tuple[Arrays, dict[str, Any]]:
        """Arrays by file, and JSON values, for a checkpoint.

        The caller sees to it that they are finite, see `divergence`.
        """
        arrays = {
            ACTING: dict(self.learner.acting_weights(self.updates).tensors),
            LEARNER: self.learner.state(),
            "replay": self.replay.state(),
        }
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
        self.replay.load_state(arrays["replay"])
        self.rate_limiter.load_state(counters["rate_limiter"])
        self.episodes = int(counters["episodes"])
        for name, generator in self._generators.items():
            generator.bit_generator.state = counters["generators"][name]


def choose_device(wanted: str) -> str:
    """`auto` is a GPU where there is one.

    Raises:
        ConfigError: a GPU is wanted and there is none.
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
