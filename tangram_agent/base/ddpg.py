"""Deep deterministic policy gradient, Eqs. 3-6, with hindsight.

Legend: M views. A view is what networks see at once: a whole scene, or a pair of token and piece.
"""

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from tangram_agent.base.config import ActorCriticConfig
from tangram_agent.base.learning import Loss, Rates, TokenLearner
from tangram_agent.base.relabelling import learnable, with_relabelled
from tangram_agent.base.replay import ReplayBuffer
from tangram_agent.base.types import Transitions
from tangram_core.agent import Streams
from tangram_core.spec import Episodes
from tangram_tasks.place import Place


@dataclass(frozen=True, eq=False)
class Steps:
    """A batch for both losses; the type of its views depends on the agent.

    Attributes:
        view: the views in which the actions were taken.
        velocity: (M, 3) velocities of the actions, in the arena's axes.
        reward: (M,) the critic's target without the value of the next view.
        done: (M,) 1 where the target does not count the next view.
        start: the views for which the actor proposes velocities, mostly equal to `view`.
        follow: the next views; None if `done` is 1 everywhere.
        seen_after: the views after the actions, for a critic of afterstates; None: that critic
            computes the exact motion.
        acts: whether the update changes the actor.
    """

    view: Any
    velocity: Tensor
    reward: Tensor
    done: Tensor
    start: Any
    follow: Any
    seen_after: Any = None
    acts: bool = True


class Ddpg(TokenLearner):
    """DDPG learner of an actor and a critic; a subclass turns transitions into views.

    Attributes:
        bootstraps: whether the critic's target counts the next view (Eq. 5). Only then target
            networks exist.
        relabels: kinds of hindsight goals with which transitions enter the replay buffer.
    """

    advice = "lower agent.actor_lr and agent.critic_lr"
    limit = 0.0  # pre-activations beyond it cost a penalty
    replay: ReplayBuffer

    def __init__(
        self,
        task: Place,
        config: ActorCriticConfig,
        networks: tuple[nn.Module, nn.Module, nn.Module],
        seed: int,
        device: str,
        compiled: bool,
    ) -> None:
        """Initialise the networks from a seed and make an empty replay buffer.

        Args:
            task: the task.
            config: the agent's settings.
            networks: the actor, the critic, and the network that plays.
            seed: seed of the weights.
            device: torch device for learning.
            compiled: whether an update is compiled as a whole, see `Whole`.
        """
        self.task, self.config, self.polyak = task, config, config.polyak
        self.bootstraps = config.gamma > 0.0 and task.spec.horizon > 1
        self.relabels = config.hindsight
        self.actor, self.critic, playing = networks
        learned = {"actor": self.actor, "critic": self.critic}
        targets = tuple(learned) if self.bootstraps else ()
        given = config, learned, playing, seed, device
        super().__init__(*given, targets=targets, compiled=compiled)
        layout = task.layout
        size = layout.corner_count, layout.tokens, task.spec.action_size
        self.replay = ReplayBuffer(config.replay_capacity, *size)

    @abstractmethod
    def steps(self, batch: Transitions, generator: np.random.Generator) -> Steps:
        """Turn a batch into views for the losses; `generator` draws new hindsight goals."""

    def rates(self, share: float) -> Rates:
        """Rates of the next update, at a used share of the budget."""
        actor = self.config.actor_lr * self.rate_factor(share)
        return super().rates(share)._replace(actor=actor)

    def insert(self, episodes: Episodes, rng: Streams) -> int:
        """Add the played and the relabelled transitions; see `Learner.insert`."""
        self.put_back()
        seen, task = learnable(episodes), self.task
        if seen.count:
            relabelled = self.relabels, task.layout, task.reward_of, rng["hindsight"]
            self.replay.add(with_relabelled(seen, *relabelled))
        return seen.transitions

    def drawn(self, rng: Streams) -> Steps:
        """Draw a batch from the replay buffer and turn it into views."""
        self.batch = self.replay.sample(self.config.batch_size, rng["replay"])
        return self.steps(self.batch, rng["hindsight"])

    def losses(self, seen: Steps) -> Iterator[Loss]:
        """Yield the critic's loss, Eq. 3, and if the batch acts, the actor's.

        That is minus the value of its actions, Eq. 6, and a penalty for saturated ones.
        """
        features = self.features(seen)
        with torch.no_grad():
            y = self._target(seen)
        q = self.critic(seen.view, seen.velocity, seen.seen_after, features)
        yield Loss("critic", (q - y).square().mean(), {"q": q.mean()})
        if not seen.acts:
            return
        velocity, raw = self.actor(seen.start, features)
        value = -self.critic(seen.start, velocity, None, features).mean()
        # Keeps tanh or clamp out of their flat ranges.
        saturation = torch.relu(raw.abs() - self.limit).square().mean()
        total = value + self.config.saturation_penalty * saturation
        yield Loss("actor", total, {"actor_loss": value, "saturation": saturation})

    def features(self, steps: Steps) -> Tensor | None:  # noqa: ARG002
        """Network inputs that actor and critic share; None if their inputs differ."""
        return None

    def _target(self, steps: Steps) -> Tensor:
        """Targets (M,), y of Eq. 5; without next views the target networks are not evaluated.

        The paper's equation lacks the factor (1 - d), but a terminal state has no value.
        """
        if steps.follow is None:
            return steps.reward
        velocity, _ = self.targets["actor"](steps.follow)
        following: Tensor = self.targets["critic"](steps.follow, velocity)
        return steps.reward + self.config.gamma * (1.0 - steps.done) * following

    def blanks(self) -> Iterator[Steps]:
        """Example batches to compile for; they have next views if the learner bootstraps."""
        size = self.config.batch_size
        columns = {name: array[:size] for name, array in self.replay.arrays.items()}
        columns["done"] = np.full(size, not self.bootstraps, np.uint8)
        seen = self.steps(Transitions(**columns), np.random.default_rng(0))
        for acts in (True, False)[: self.delay]:
            yield replace(seen, acts=acts)

    def if_any_follows(self, done: npt.NDArray[Any], follow: Any) -> Any:
        """The views after the steps; None if no value of the batch counts what follows."""
        return follow if self.bootstraps and not done.all() else None
