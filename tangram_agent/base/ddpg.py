"""Deep deterministic policy gradient, Eqs. 3-6, with hindsight.

Legend: M views.
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from tangram_agent.base.compiling import Compiled
from tangram_agent.base.config import ActorCriticConfig
from tangram_agent.base.learning import NetworkLearner, Rates, frozen, polyak_update
from tangram_agent.base.relabelling import learnable, with_relabelled
from tangram_agent.base.replay import ReplayBuffer
from tangram_agent.base.types import Transitions
from tangram_core.agent import Streams
from tangram_core.arrays import Ints
from tangram_core.spec import Array, Arrays, Episodes
from tangram_tasks.place import Place

NUMBERS = ("critic_loss", "q", "critic_gradient", "actor_loss", "saturation", "actor_gradient")


@dataclass(frozen=True, eq=False)
class Steps:
    """A batch as both losses see it; what a view is, the agent's own networks know.

    Attributes:
        view: where the action was taken.
        velocity: (M, 3) of the action, in the arena's axes.
        reward: (M,) what the critic learns, less what follows.
        done: (M,) 1 where nothing follows.
        start: where the actor is asked from: mostly the same view.
        follow: what the action came to.
            None where nothing follows on any of them.
        seen_after: that too where an afterstate critic is to see it as it was, else it sees the
            exact motion.
    """

    view: Any
    velocity: Tensor
    reward: Tensor
    done: Tensor
    start: Any
    follow: Any
    seen_after: Any = None


class Ddpg(NetworkLearner):
    """Actor and critic on views of tokens; an agent says what these are.

    Attributes:
        bootstraps: whether the critic's target counts what follows (Eq. 5): only then are there
            target networks.
        replay: transitions played, and relabelled ones.
        batch: of the last update.
    """

    compiles = True
    advice = "lower agent.actor_lr and agent.critic_lr"
    limit = 0.0  # of pre-activations, beyond which they pay a penalty

    def __init__(
        self,
        task: Place,
        config: ActorCriticConfig,
        networks: tuple[nn.Module, nn.Module, nn.Module],
        seed: int,
        device: str,
        compiled: bool,
    ) -> None:
        """Networks with the weights of a seed.

        Args:
            task: what is played.
            config: the agent's.
            networks: actor, critic, and what is played with.
            seed: of the weights.
            device: where it learns.
            compiled: whether an update is compiled as a whole, see `Compiled`.
        """
        self.task, self.config = task, config
        self.bootstraps = config.gamma > 0.0 and task.horizon > 1
        self.actor, self.critic, playing = networks
        learned = {"actor": self.actor, "critic": self.critic}
        super().__init__(config, learned, playing, seed, device)
        layout = task.layout
        size = layout.corner_count, layout.tokens, task.action_size
        self.replay = ReplayBuffer(config.replay_capacity, *size)
        self.capacity = config.replay_capacity
        self.batch: Transitions | None = None
        self._step_all = self._all_steps
        if compiled:
            self._step_all = Compiled(self._all_steps, self.changed_by_update())

    def _more_parts(self) -> dict[str, nn.Module]:
        if not self.bootstraps:
            return {}
        self.target_actor, self.target_critic = frozen(self.actor), frozen(self.critic)
        return {"target_actor": self.target_actor, "target_critic": self.target_critic}

    @abstractmethod
    def steps(self, batch: Transitions, generator: np.random.Generator) -> Steps:
        """What the losses see of a batch; what hindsight draws anew, it draws here."""

    def rates(self, share: float) -> Rates:
        """Of the next update, at a used share of the budget."""
        actor = self.config.actor_lr * self.rate_factor(share)
        return super().rates(share)._replace(actor=actor)

    # Experience

    def insert(self, episodes: Episodes, rng: Streams) -> int:
        """Keep transitions as they were played, and relabelled."""
        seen = learnable(episodes)
        if seen.count:
            self.replay.add(
                with_relabelled(
                    seen, self.relabels, self.task.layout, self.task.reward_of, rng["hindsight"]
                )
            )
        return seen.transitions

    @property
    def relabels(self) -> tuple[Any, ...]:
        """The goals of hindsight that transitions are kept with."""
        return self.config.hindsight

    @property
    def kept(self) -> int:
        """Transitions in the replay."""
        return len(self.replay)

    def memory(self) -> dict[str, Array]:
        """The replay."""
        return self.replay.state()

    def load_memory(self, memory: Mapping[str, Array]) -> None:
        """Take over a replay."""
        self.replay.load_state(dict(memory))

    def evidence(self) -> Arrays:
        """The batch of the last update."""
        return {} if self.batch is None else self.batch.arrays

    # Updates

    def update(self, share: float, rng: Streams) -> dict[str, float]:
        """See `Learner.update`; its numbers are those of `learn`."""
        self.batch = self.replay.sample(self.config.batch_size, rng["replay"])
        return self.learn(self.steps(self.batch, rng["hindsight"]), share)

    def learn(self, steps: Steps, share: float = 0.0) -> dict[str, float]:
        """One step of all networks.

        Args:
            steps: what the losses see.
            share: of the run's budget that is used, in [0, 1]; decides the learning rate.

        Returns:
            critic_loss, actor_loss, q (mean value of the batch's actions), saturation, and the
            norms of the gradients, critic_gradient and actor_gradient.

        Raises:
            NotFiniteError: one of these is not finite.
        """
        found = self._step_all(steps, self.rates(share))
        return self._counted(dict(zip(NUMBERS, found.unbind(), strict=True)))

    def _all_steps(self, steps: Steps, rates: Rates) -> Tensor:
        """All steps of one update, on the device alone; its `NUMBERS`."""
        features = self.features(steps)
        loss, q = self.critic_loss(steps, features)
        norm = self._step("critic", loss, rates.critic)
        value_loss, penalty = self.actor_loss(steps, features)
        total = value_loss + self.config.saturation_penalty * penalty
        actor_norm = self._step("actor", total, rates.actor)
        self._follow(rates.kept)
        every = loss, q.mean(), norm, value_loss, penalty, actor_norm
        return torch.stack([one.detach() for one in every])

    def features(self, steps: Steps) -> Tensor | None:  # noqa: ARG002
        """What actor and critic both see, made once; None where they see different things."""
        return None

    def critic_loss(self, steps: Steps, features: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Mean squared Bellman error of Eq. 3, and the values (M,)."""
        with torch.no_grad():
            y = self._target(steps)
        q = self.critic(steps.view, steps.velocity, steps.seen_after, features)
        return (q - y).square().mean(), q

    def actor_loss(self, steps: Steps, features: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Minus the value of the actor's own actions (Eq. 6), and the saturation penalty."""
        velocity, raw = self.actor(steps.start, features)
        q = self.critic(steps.start, velocity, None, features)
        return -q.mean(), saturation(raw, self.limit)

    def _target(self, steps: Steps) -> Tensor:
        """Eq. 5; the target networks are not asked where no transition goes on."""
        if steps.follow is None:
            return steps.reward
        velocity, _ = self.target_actor(steps.follow)
        following = self.target_critic(steps.follow, velocity)
        return critic_target(steps.reward, steps.done, following, self.config.gamma)

    def _follow(self, kept: float | Tensor) -> None:
        """Move target networks and the acting average a little towards the networks."""
        lists, config = self._lists, self.config
        if self.bootstraps:
            polyak_update(lists["target_critic"], lists["critic"], config.polyak)
            polyak_update(lists["target_actor"], lists["actor"], config.polyak)
        polyak_update(lists["acting"], lists["playing"], kept)

    def prepare(self) -> None:
        """Compile updates that are to be compiled: else the first ones take a minute."""
        if not isinstance(self._step_all, Compiled):
            return
        # Some go on in nearly every batch of those that bootstrap; none elsewhere.
        blank = _blank(self.task, self.config.batch_size, done=0 if self.bootstraps else 1)
        self._step_all.prepare(self.steps(blank, np.random.default_rng(0)), self.rates(0.0))

    # Tensors

    def if_any_follows(self, done: npt.NDArray[Any], follow: Any) -> Any:
        """What follows, where a target network is to be asked of it; else None."""
        return follow if self.bootstraps and not done.all() else None

    def tensor(self, column: npt.NDArray[Any]) -> Tensor:
        """In single precision, on the device."""
        return torch.from_numpy(np.asarray(column, np.float32)).to(self.place)

    def index(self, column: Ints) -> Tensor:
        """Of whole numbers, on the device."""
        return torch.from_numpy(np.asarray(column, np.int64)).to(self.place)


def critic_target(reward: Tensor, done: Tensor, next_value: Tensor, gamma: float) -> Tensor:
    """The target y of Eq. 5, (B,).

    The paper's equation lacks (1 - d), but after the end of an episode nothing can follow.
    """
    return reward + gamma * (1.0 - done) * next_value


def saturation(raw: Tensor, limit: float) -> Tensor:
    """Mean of relu(|z| - limit)^2 over pre-activations z: keeps tanh or clamp from going flat."""
    return torch.relu(raw.abs() - limit).square().mean()


def _blank(task: Place, count: int, done: int) -> Transitions:
    """A batch in which nothing moves, of tokens that lie in the middle."""
    layout = task.layout
    corners = layout.corners(np.zeros((count, layout.tokens, 3))).astype(np.float32, order="C")
    return Transitions(
        state=corners,
        placed=np.zeros((count, layout.tokens), np.uint8),
        action=np.zeros((count, task.action_size), np.float32),
        reward=np.zeros(count, np.float32),
        next_state=corners,
        next_placed=np.zeros((count, layout.tokens), np.uint8),
        done=np.full(count, done, np.uint8),
        goal=corners,
    )
