"""Deep deterministic policy gradient, Eqs. 3-6, with the parts that make it learn the angle.

One learner for whole scenes and for pairs of a token and a piece: it sees a batch as `Steps`. With
several tokens what an action is worth falls apart into what it covers of each piece, and hindsight
knows the geometry: so a pair's value is known at once, and nothing is bootstrapped.

Legend: M views, K tokens.
"""

import copy
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from tangram_agent.agents.pair.motion import Fit, MotionModel, Motions
from tangram_agent.base.adam import Adam
from tangram_agent.base.compiling import Compiled
from tangram_agent.base.weights import load_arrays, to_arrays, under
from tangram_agent.config import AgentConfig
from tangram_agent.networks import Networks, initialise, parameter_count
from tangram_agent.relabelling import make_pairs
from tangram_agent.setup import Setup
from tangram_agent.steps import Batch, Stepping, Steps
from tangram_agent.types import Transitions, Weights
from tangram_core.errors import RunError

Array = npt.NDArray[Any]
_COUNTER = "updates"


def critic_target(reward: Tensor, done: Tensor, next_value: Tensor, gamma: float) -> Tensor:
    """The target y of Eq. 5, (B,).

    The paper's equation lacks (1 - d), but after the end of an episode nothing can follow.
    """
    return reward + gamma * (1.0 - done) * next_value


def saturation(raw: Tensor, limit: float) -> Tensor:
    """Mean of relu(|z| - limit)^2 over pre-activations z: keeps tanh or clamp from going flat."""
    return torch.relu(raw.abs() - limit).square().mean()


def polyak_update(targets: list[Tensor], sources: list[Tensor], rho: float | Tensor) -> None:
    """Eq. 4: target <- rho * target + (1 - rho) * source, parameter by parameter."""
    with torch.no_grad():
        if isinstance(rho, Tensor):  # the update is traced
            for target, source in zip(targets, sources, strict=True):
                target.lerp_(source, 1.0 - rho)
        else:
            torch._foreach_lerp_(targets, sources, 1.0 - rho)


def gradient_norm(gradients: Sequence[Tensor], traced: bool) -> Tensor:
    """The norm of all gradients together, ().

    torch's own is one kernel for all of them, which compiled code cannot call directly: what is
    traced is told in single operations.
    """
    if not traced:
        return nn.utils.get_total_norm(gradients)
    return torch.stack([one.square().sum() for one in gradients]).sum().sqrt()


def average_so_far(rho: float, updates: int) -> float:
    """Rho of a running average after `updates` updates: smaller at first, to forget the start.

    A constant 0.99 holds the random weights of the start for hundreds of updates.
    """
    return min(rho, updates / (updates + 9.0))


class NotFiniteError(RunError):
    """Numbers of an update, or weights, that are not finite."""


class Rates(NamedTuple):
    """Learning rates of an update, and how much the running average keeps; tensors where traced."""

    actor: float | Tensor
    critic: float | Tensor
    kept: float | Tensor


BOUND = 1.0  # of an agent of pairs: pre-activations beyond it are clamped, and pay a penalty
NUMBERS = ("critic_loss", "q", "critic_gradient", "actor_loss", "saturation", "actor_gradient")


class Learner:
    """Actor, critic, their targets and optimisers.

    Attributes:
        updates: number of updates made.
        bootstraps: whether the critic's target counts what follows (Eq. 5): only then are there
            target networks.
        parts: networks by the names under which a checkpoint has them.
        playing: what is played with: the actor, or both networks where both may play.
        optimisers: of the networks that learn, by their names in `parts`.
        acting: its running average, of which workers get what they need.
        steps: makes what the losses see of a batch.
    """

    def __init__(
        self, setup: Setup, seed: int, device: str = "cpu", compiled: bool = False
    ) -> None:
        """Networks with the weights of a seed.

        Args:
            setup: the task and the agent.
            seed: of the weights.
            device: where it learns.
            compiled: whether an update is compiled as a whole, see `Compiled`.
        """
        self.config: AgentConfig = setup.agent
        self.device = torch.device(device)
        self.updates = 0
        self.bootstraps = setup.bootstraps
        self._setup, self._layout = setup, setup.layout
        self.steps = Stepping(setup, self.device)
        networks = Networks(setup)
        self.actor, self.critic = networks.actor, networks.critic
        generator = torch.Generator().manual_seed(seed)
        initialise(self.actor, generator)
        initialise(self.critic, generator)
        self.parameters = parameter_count(self.actor, self.critic)
        self.motion = networks.motion
        networks.to(self.device)
        self.acting = frozen(networks.playing)
        self.parts: dict[str, nn.Module] = {"actor": self.actor, "critic": self.critic}
        if self.bootstraps:
            self.target_actor, self.target_critic = frozen(self.actor), frozen(self.critic)
            self.parts |= {"target_actor": self.target_actor, "target_critic": self.target_critic}
        if self.motion is not None:
            self.parts["motion"] = self.motion
        self.parts["acting"] = self.acting
        self.playing = networks.playing
        # Kept as lists: walking the modules takes a fifth of a small network's update.
        self._lists = self.parameter_lists()
        self.optimisers = {part: Adam(self._lists[part]) for part in ("actor", "critic")}
        self._fit = None if self.motion is None else Fit(self.motion, setup.screens_motions)
        self._step_all = self._all_steps
        if compiled:
            self._step_all = Compiled(self._all_steps, self._changed_by_update())

    def parameter_lists(self) -> dict[str, list[Tensor]]:
        """Parameters by the names of `parts`, and those of `playing`."""
        modules = self.parts | {"playing": self.playing}
        return {name: list(module.parameters()) for name, module in modules.items()}

    def prepared(self, batch: Transitions, generator: np.random.Generator) -> Batch:
        """What `update` takes, from a batch of transitions: pairs, where the agent sees such."""
        if not self._setup.pairs:
            return batch
        return make_pairs(batch, self._setup, generator)

    def update(
        self, batch: Batch, progress: float = 0.0, motions: Motions | None = None
    ) -> dict[str, float]:
        """One step of all networks on a batch.

        Args:
            batch: B transitions; see `prepared`.
            progress: used share of the run's budget, in [0, 1]; decides the learning rate.
            motions: of whole episodes, where the agent learns what a command comes to.

        Returns:
            critic_loss, actor_loss, q (mean value of the batch's actions), saturation, and the
            norms of the gradients, critic_gradient and actor_gradient; with motions also
            motion_error and motion_noise (shares of full scale).

        Raises:
            NotFiniteError: one of these is not finite. The update does not count, and the networks
                may be spoilt: load a state from before.
        """
        values: dict[str, Tensor] = {}
        if self._fit is not None and motions is not None:
            values = self._fit.step(motions.to(self.device))
        found = self._step_all(self.steps(batch), self.rates(progress))
        return self._counted(dict(zip(NUMBERS, found.unbind(), strict=True)) | values)

    def _counted(self, values: dict[str, Tensor]) -> dict[str, float]:
        """The numbers of an update, which now counts: the one wait for the device, at its end.

        Raises:
            NotFiniteError: one is not finite.
        """
        numbers = dict(zip(values, torch.stack(list(values.values())).tolist(), strict=True))
        check_finite(self.updates + 1, numbers)
        self.updates += 1
        return numbers

    def _all_steps(self, steps: Steps, rates: Rates) -> Tensor:
        """All steps of one update, on the device alone; its `NUMBERS`."""
        # Made once where critic and actor see the same: a whole scene as it stands.
        once = not self._setup.pairs and steps.start is steps.view
        features = self.actor.head.see(steps.view) if once else None
        loss, q = self.critic_loss(steps, features)
        norm = self._step("critic", loss, rates.critic)
        value_loss, penalty = self.actor_loss(steps, features)
        total = value_loss + self.config.saturation_penalty * penalty
        actor_norm = self._step("actor", total, rates.actor)
        self._follow(rates.kept)
        every = loss, q.mean(), norm, value_loss, penalty, actor_norm
        return torch.stack([one.detach() for one in every])

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
        return -q.mean(), saturation(raw, BOUND if self._setup.pairs else 0.0)

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

    def _step(self, part: str, loss: Tensor, rate: float | Tensor) -> Tensor:
        """One step of one network, whatever else the loss depends on; its gradient's norm."""
        gradients = torch.autograd.grad(loss, self._lists[part])
        norm = gradient_norm(gradients, traced=isinstance(rate, Tensor))
        self.optimisers[part].step(gradients, rate)
        return norm

    def compile_ahead(self) -> None:
        """Compile updates that are to be compiled: else the first ones take a minute."""
        if not isinstance(self._step_all, Compiled):
            return
        # Some go on in nearly every batch of those that bootstrap; none elsewhere.
        blank = _blank(self._setup, done=0 if self.bootstraps else 1)
        batch = self.prepared(blank, np.random.default_rng(0))
        self._step_all.prepare(self.steps(batch), self.rates(0.0))

    def rate_factor(self, progress: float) -> float:
        """By which learning rates have fallen at a used share of the budget: along a cosine."""
        share, low = min(max(progress, 0.0), 1.0), self.config.lr_final
        return low + (1.0 - low) * 0.5 * (1.0 + math.cos(math.pi * share))

    def _changed_by_update(self) -> list[Tensor]:
        """All that `_all_steps` changes."""
        parameters = [one for own in self.parts.values() for one in own.parameters()]
        every = self.optimisers.values()
        kept = [one for each in every for own in each.slots.values() for one in own]
        return parameters + kept

    def rates(self, progress: float) -> Rates:
        """Of the next update, at a used share of the budget."""
        factor, config = self.rate_factor(progress), self.config
        kept = average_so_far(config.acting_average, self.updates)
        return Rates(config.actor_lr * factor, config.critic_lr * factor, kept)

    def acting_weights(self, version: int) -> Weights:
        """A copy of the weights to play with, as a checkpoint keeps them."""
        return Weights(version, to_arrays(self.acting))

    def state(self) -> dict[str, Array]:
        """Everything that the next update depends on, as arrays for a checkpoint."""
        state: dict[str, Array] = {_COUNTER: np.array([self.updates], np.int64)}
        for part, module in self.parts.items():
            for name, value in to_arrays(module).items():
                state[f"{part}.{name}"] = value
        for part, optimiser in self._stateful().items():
            for name, tensors in optimiser.slots.items():
                for i, tensor in enumerate(tensors):
                    state[f"{part}_optimiser.{i}.{name}"] = tensor.cpu().numpy().copy()
        return state

    def load_state(self, state: dict[str, Array]) -> None:
        """Take over a state from `state()`.

        Raises:
            RunError: tensors are missing or have other shapes: another layout or another net.
        """
        if _COUNTER not in state:
            raise RunError("learner state: no counter of updates: not a learner's checkpoint")
        self.load_networks(state)
        for part, optimiser in self._stateful().items():
            content: dict[str, dict[int, Tensor]] = {}
            for key, value in under(f"{part}_optimiser.", state).items():
                i, name = key.split(".", 1)
                tensor = torch.from_numpy(np.array(value)).to(self.device)
                content.setdefault(name, {})[int(i)] = tensor
            optimiser.load({n: [one[i] for i in sorted(one)] for n, one in content.items()})
        self.updates = int(state[_COUNTER][0])

    def load_networks(self, state: dict[str, Array]) -> None:
        """Take over the networks of a state, and nothing else.

        Raises:
            RunError: tensors are missing or have other shapes.
        """
        if self.motion is not None and not under("motion.", state):
            raise RunError(
                "the checkpoint has no model of motion: set agent.motion=exact, as it was trained"
            )
        for part, module in self.parts.items():
            load_arrays(module, under(f"{part}.", state))

    def begin_with(self, state: dict[str, Array]) -> None:
        """Take over the networks of a state; the motion is learned anew: its world may be another.

        Raises:
            RunError: tensors are missing or have other shapes.
        """
        self.load_networks(state)
        if self.motion is not None:
            for model in (self.motion, self.acting.get_submodule("motion")):
                model.load_state_dict(MotionModel().state_dict())

    def _stateful(self) -> dict[str, Adam | Fit]:
        """What steps, by the names under which a checkpoint has it."""
        fit = {} if self._fit is None else {"motion": self._fit}
        return {**self.optimisers, **fit}


def _blank(setup: Setup, done: int) -> Transitions:
    """A batch in which nothing moves, of tokens that lie in the middle."""
    count, layout = setup.agent.batch_size, setup.layout
    corners = layout.corners(np.zeros((count, layout.tokens, 3))).astype(np.float32, order="C")
    return Transitions(
        state=corners,
        placed=np.zeros((count, layout.tokens), np.uint8),
        action=np.zeros((count, setup.action_size), np.float32),
        reward=np.zeros(count, np.float32),
        next_state=corners,
        next_placed=np.zeros((count, layout.tokens), np.uint8),
        done=np.full(count, done, np.uint8),
        goal=corners,
    )


def frozen(module: nn.Module) -> nn.Module:
    """A copy that no gradient reaches."""
    return copy.deepcopy(module).requires_grad_(False)


def check_finite(updates: int, numbers: dict[str, float]) -> None:
    """Raise NotFiniteError unless all numbers of an update are finite."""
    if not all(map(math.isfinite, numbers.values())):
        listed = ", ".join(f"{name}={value:g}" for name, value in numbers.items())
        raise NotFiniteError(f"update {updates} is not finite ({listed})")
