"""Deep deterministic policy gradient, Eqs. 3-6, with the parts that make it learn the angle.

Legend: B batch, K tokens, A entries of an action.
"""

import copy
import math
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from tangram_agent.config import AgentConfig
from tangram_agent.graph import TokenGraph
from tangram_agent.networks import VELOCITY, Actor, Critic, initialise, parameter_count
from tangram_agent.pair_batch import PairBatch
from tangram_agent.setup import Setup
from tangram_agent.types import Transitions, Weights
from tangram_agent.weights import load_arrays, to_arrays, under
from tangram_sim.errors import RunError

Array = npt.NDArray[Any]
Batch = Transitions | PairBatch
PARTS = ("actor", "critic", "target_actor", "target_critic", "acting")
_COUNTER = "updates"


def next_token(placed: Tensor) -> Tensor:
    """Which token moves, (B,): the first that is not placed (B, K); 0 where all are."""
    return (placed == 0).int().argmax(dim=-1)


def split_action(action: Tensor, tokens: int) -> tuple[Tensor, Tensor]:
    """Token (B,) and velocity (B, 3) of an action (B, A) of the environment, see `actions`."""
    velocity = action[:, -VELOCITY:]
    if tokens == 1:
        return torch.zeros(len(action), dtype=torch.long, device=action.device), velocity
    token = ((action[:, 0] + 1.0) / 2.0 * tokens).long().clamp(0, tokens - 1)
    return token, velocity


def critic_target(reward: Tensor, done: Tensor, next_value: Tensor, gamma: float) -> Tensor:
    """The target y of Eq. 5, (B,).

    The paper's equation lacks (1 - d), but after the end of an episode nothing can follow.
    """
    return reward + gamma * (1.0 - done) * next_value


def saturation(raw: Tensor, limit: float) -> Tensor:
    """Mean of relu(|z| - limit)^2 over pre-activations z: keeps tanh or clamp from going flat."""
    return torch.relu(raw.abs() - limit).square().mean()


def polyak_update(targets: list[Tensor], sources: list[Tensor], rho: float) -> None:
    """Eq. 4: target <- rho * target + (1 - rho) * source, parameter by parameter."""
    with torch.no_grad():
        torch._foreach_lerp_(targets, sources, 1.0 - rho)


def average_so_far(rho: float, updates: int) -> float:
    """Rho of a running average after so many updates: less at first, while it is mostly its start.

    A constant 0.99 holds the random weights of the start for hundreds of updates.
    """
    return min(rho, updates / (updates + 9.0))


class NotFiniteError(RunError):
    """Numbers of an update, or weights, that are not finite."""


class Learner:
    """Actor, critic, their targets and optimisers.

    Attributes:
        updates: number of updates made.
        acting: the actor that plays: a running average of the actor's weights.
    """

    def __init__(self, setup: Setup, seed: int, device: str = "cpu") -> None:
        self.config: AgentConfig = setup.agent
        self.device = torch.device(device)
        self.tokens = setup.layout.tokens
        self.updates = 0
        self.actor, self.critic = self.make_networks(setup)
        generator = torch.Generator().manual_seed(seed)
        initialise(self.actor, generator)
        initialise(self.critic, generator)
        self.parameters = parameter_count(self.actor, self.critic)
        for module in (self.actor, self.critic):
            module.to(self.device)
        self.target_actor, self.target_critic = _frozen(self.actor), _frozen(self.critic)
        self.acting = _frozen(self.playing())
        # Kept as lists: walking the modules takes a fifth of a small network's update.
        self._lists = self.parameter_lists()
        self.actor_optimiser = _adam(self._lists["actor"], self.config.actor_lr)
        self.critic_optimiser = _adam(self._lists["critic"], self.config.critic_lr)

    def make_networks(self, setup: Setup) -> tuple[nn.Module, nn.Module]:
        """Actor and critic."""
        self.graph = TokenGraph(setup.layout, setup.sim.arena, setup.agent)
        actor = Actor(self.graph, setup.agent, setup.net)
        return actor, Critic(self.graph, setup.agent, setup.net)

    def playing(self) -> nn.Module:
        """What plays: its running average is what workers get."""
        return self.actor

    def parameter_lists(self) -> dict[str, list[Tensor]]:
        """Parameters by the names of PARTS, and those of `playing`."""
        parts = {part: getattr(self, part) for part in PARTS} | {"playing": self.playing()}
        return {name: list(part.parameters()) for name, part in parts.items()}

    def update(self, batch: Batch, progress: float = 0.0) -> dict[str, float]:
        """One step of both networks on a batch.

        Args:
            batch: B transitions; see `prepared`.
            progress: used share of the run's budget, in [0, 1]; decides the learning rate.

        Returns:
            critic_loss, actor_loss, q (mean value of the batch's actions), saturation, and the
            norms of the gradients, critic_gradient and actor_gradient.

        Raises:
            NotFiniteError: one of these is not finite. The update does not count, and the networks
                may be spoilt: load a state from before.
        """
        tensors = {name: self._tensor(column) for name, column in vars(batch).items()}
        self._set_learning_rate(progress)
        self.look(tensors)
        values = self._critic_step(tensors) | self._actor_step(tensors)
        self._follow()
        # One wait for the device, after everything has been asked of it.
        numbers = dict(zip(values, torch.stack(list(values.values())).tolist(), strict=True))
        _check_finite(self.updates + 1, numbers)
        self.updates += 1
        return numbers

    def prepared(self, batch: Transitions, generator: np.random.Generator) -> Batch:
        """What `update` takes, from a batch of transitions: the same here."""
        del generator
        return batch

    def look(self, t: dict[str, Tensor]) -> None:
        """Make the features once where critic and actor see the same: one token, as it stands."""
        if self.tokens == 1 and not self.config.afterstate:
            token = next_token(t["placed"])
            t["features"] = self.graph.node_features(t["state"], t["placed"], t["goal"], token)

    def _follow(self) -> None:
        """Targets and the acting average, a little of the way to the networks."""
        lists, config = self._lists, self.config
        if config.gamma > 0.0:
            polyak_update(lists["target_critic"], lists["critic"], config.polyak)
            polyak_update(lists["target_actor"], lists["actor"], config.polyak)
        rho = average_so_far(config.acting_average, self.updates)
        polyak_update(lists["acting"], lists["playing"], rho)

    def critic_loss(self, t: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Mean squared Bellman error of Eq. 3, and the values (B,)."""
        with torch.no_grad():
            y = self._target(t)
        token, velocity = split_action(t["action"], self.tokens)
        state = (t["state"], t["placed"], t["goal"], token)
        q = self.critic(*state, velocity, t.get("features"))
        return (q - y).square().mean(), q

    def actor_loss(self, t: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Minus the value of the actor's own actions (Eq. 6), and the saturation penalty."""
        token = next_token(t["placed"])
        state = (t["state"], t["placed"], t["goal"], token)
        velocity, raw = self.actor(*state, t.get("features"))
        q = self.critic(*state, velocity, t.get("features"))
        return -q.mean(), saturation(raw, self.config.saturation_limit)

    def _target(self, t: dict[str, Tensor]) -> Tensor:
        """Eq. 5; the target networks are not asked where no transition goes on."""
        if self.config.gamma == 0.0 or bool(t["done"].all()):
            return t["reward"]
        after = (t["next_state"], t["next_placed"], t["goal"], next_token(t["next_placed"]))
        velocity, _ = self.target_actor(*after)
        return critic_target(
            t["reward"], t["done"], self.target_critic(*after, velocity), self.config.gamma
        )

    def _critic_step(self, t: dict[str, Tensor]) -> dict[str, Tensor]:
        loss, q = self.critic_loss(t)
        norm = self._step("critic", loss)
        return {"critic_loss": loss.detach(), "q": q.detach().mean(), "critic_gradient": norm}

    def _actor_step(self, t: dict[str, Tensor]) -> dict[str, Tensor]:
        value_loss, penalty = self.actor_loss(t)
        loss = value_loss + self.config.saturation_penalty * penalty
        norm = self._step("actor", loss)
        return {
            "actor_loss": value_loss.detach(),
            "saturation": penalty.detach(),
            "actor_gradient": norm,
        }

    def _step(self, part: str, loss: Tensor) -> Tensor:
        """One step of one network, whatever else the loss depends on; its gradient's norm."""
        parameters = self._lists[part]
        gradients = torch.autograd.grad(loss, parameters)
        norm = nn.utils.get_total_norm(gradients)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        if self.config.grad_clip > 0.0:
            nn.utils.clip_grads_with_norm_(parameters, self.config.grad_clip, norm)
        self._optimisers()[part].step()
        return norm

    def _set_learning_rate(self, progress: float) -> None:
        factor = 1.0
        if self.config.lr_decay == "cosine":
            share = min(max(progress, 0.0), 1.0)
            low = self.config.lr_final
            factor = low + (1.0 - low) * 0.5 * (1.0 + math.cos(math.pi * share))
        self.actor_optimiser.param_groups[0]["lr"] = self.config.actor_lr * factor
        self.critic_optimiser.param_groups[0]["lr"] = self.config.critic_lr * factor

    def _tensor(self, column: Array) -> Tensor:
        return torch.from_numpy(np.asarray(column, np.float32)).to(self.device)

    def acting_weights(self, version: int) -> Weights:
        """A copy of the weights that workers play with."""
        return Weights(version, to_arrays(self.acting))

    def state(self) -> dict[str, Array]:
        """Everything that the next update depends on, as arrays for a checkpoint."""
        state: dict[str, Array] = {_COUNTER: np.array([self.updates], np.int64)}
        for part in PARTS:
            for name, value in to_arrays(getattr(self, part)).items():
                state[f"{part}.{name}"] = value
        for part, optimiser in self._optimisers().items():
            for i, slots in optimiser.state_dict()["state"].items():
                for name, value in slots.items():
                    state[f"{part}_optimiser.{i}.{name}"] = value.cpu().numpy().copy()
        return state

    def load_state(self, state: dict[str, Array]) -> None:
        """Take over a state from `state()`.

        Raises:
            RunError: tensors are missing or have other shapes: another layout or another net.
        """
        if _COUNTER not in state:
            raise RunError("learner state: no counter of updates: not a learner's checkpoint")
        self.load_networks(state)
        for part, optimiser in self._optimisers().items():
            slots = under(f"{part}_optimiser.", state)
            content: dict[int, dict[str, Tensor]] = {}
            for key, value in slots.items():
                i, name = key.split(".", 1)
                content.setdefault(int(i), {})[name] = torch.from_numpy(np.array(value))
            groups = optimiser.state_dict()["param_groups"]
            optimiser.load_state_dict({"state": content, "param_groups": groups})
        self.updates = int(state[_COUNTER][0])

    def load_networks(self, state: dict[str, Array]) -> None:
        """Take over the networks of a state, and nothing else.

        Raises:
            RunError: tensors are missing or have other shapes.
        """
        for part in PARTS:
            load_arrays(getattr(self, part), under(f"{part}.", state))

    def _optimisers(self) -> dict[str, torch.optim.Adam]:
        return {"actor": self.actor_optimiser, "critic": self.critic_optimiser}


def _frozen(module: nn.Module) -> nn.Module:
    return copy.deepcopy(module).requires_grad_(False)


def _adam(parameters: list[Tensor], rate: float) -> torch.optim.Adam:
    return torch.optim.Adam(parameters, lr=rate, fused=True)


def _check_finite(updates: int, numbers: dict[str, float]) -> None:
    if not all(map(math.isfinite, numbers.values())):
        listed = ", ".join(f"{name}={value:g}" for name, value in numbers.items())
        raise NotFiniteError(f"update {updates} is not finite ({listed})")
