"""Deep deterministic policy gradient, Eqs. 3-6, with hindsight.

Legend: M views.
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
        acts: whether the actor moves.
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
    """Actor and critic on views of tokens; an agent says what these are.

    Attributes:
        bootstraps: whether the critic's target counts what follows (Eq. 5): only then are there
            target networks.
        relabels: the goals of hindsight that transitions are kept with.
    """

    advice = "lower agent.actor_lr and agent.critic_lr"
    limit = 0.0  # of pre-activations, beyond which they pay a penalty
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
        """Networks with the weights of a seed.

        Args:
            task: what is played.
            config: the agent's.
            networks: actor, critic, and what is played with.
            seed: of the weights.
            device: where it learns.
            compiled: whether an update is compiled as a whole, see `Whole`.
        """
        self.task, self.config, self.polyak = task, config, config.polyak
        self.bootstraps = config.gamma > 0.0 and task.horizon > 1
        self.relabels = config.hindsight
        self.actor, self.critic, playing = networks
        learned = {"actor": self.actor, "critic": self.critic}
        targets = tuple(learned) if self.bootstraps else ()
        given = config, learned, playing, seed, device
        super().__init__(*given, targets=targets, compiled=compiled)
        layout = task.layout
        size = layout.corner_count, layout.tokens, task.action_size
        self.replay = ReplayBuffer(config.replay_capacity, *size)

    @abstractmethod
    def steps(self, batch: Transitions, generator: np.random.Generator) -> Steps:
        """What the losses see of a batch; what hindsight draws anew, it draws here."""

    def rates(self, share: float) -> Rates:
        """Of the next update, at a used share of the budget."""
        actor = self.config.actor_lr * self.rate_factor(share)
        return super().rates(share)._replace(actor=actor)

    def insert(self, episodes: Episodes, rng: Streams) -> int:
        """Keep transitions as they were played, and relabelled."""
        seen, task = learnable(episodes), self.task
        if seen.count:
            relabelled = self.relabels, task.layout, task.reward_of, rng["hindsight"]
            self.replay.add(with_relabelled(seen, *relabelled))
        return seen.transitions

    def drawn(self, rng: Streams) -> Steps:
        """What the losses see of transitions of the replay."""
        self.batch = self.replay.sample(self.config.batch_size, rng["replay"])
        return self.steps(self.batch, rng["hindsight"])

    def losses(self, seen: Steps) -> Iterator[Loss]:
        """The critic's, Eq. 3, then the actor's, Eq. 6: minus the value of its own actions."""
        features = self.features(seen)
        with torch.no_grad():
            y = self._target(seen)
        q = self.critic(seen.view, seen.velocity, seen.seen_after, features)
        yield Loss("critic", (q - y).square().mean(), {"q": q.mean()})
        if not seen.acts:
            return
        velocity, raw = self.actor(seen.start, features)
        value = -self.critic(seen.start, velocity, None, features).mean()
        # Keeps tanh or clamp from going flat.
        saturation = torch.relu(raw.abs() - self.limit).square().mean()
        total = value + self.config.saturation_penalty * saturation
        yield Loss("actor", total, {"actor_loss": value, "saturation": saturation})

    def features(self, steps: Steps) -> Tensor | None:  # noqa: ARG002
        """What actor and critic both see, made once; None where they see different things."""
        return None

    def _target(self, steps: Steps) -> Tensor:
        """Y of Eq. 5, (M,); the target networks are not asked where no transition goes on.

        The paper's equation lacks (1 - d), but after the end of an episode nothing can follow.
        """
        if steps.follow is None:
            return steps.reward
        velocity, _ = self.targets["actor"](steps.follow)
        following: Tensor = self.targets["critic"](steps.follow, velocity)
        return steps.reward + self.config.gamma * (1.0 - steps.done) * following

    def blanks(self) -> Iterator[Steps]:
        """Some go on in nearly every batch of those that bootstrap; none elsewhere."""
        size = self.config.batch_size
        columns = {name: array[:size] for name, array in self.replay.arrays.items()}
        columns["done"] = np.full(size, not self.bootstraps, np.uint8)
        seen = self.steps(Transitions(**columns), np.random.default_rng(0))
        for acts in (True, False)[: self.delay]:
            yield replace(seen, acts=acts)

    def if_any_follows(self, done: npt.NDArray[Any], follow: Any) -> Any:
        """What follows, where a target network is to be asked of it; else None."""
        return follow if self.bootstraps and not done.all() else None
