"""Deep deterministic policy gradient, Eqs. 3-6, with the parts that make it learn the angle.

One learner for whole scenes and for pairs of a token and a piece: it sees a batch as `Steps`. With
several tokens what an action is worth falls apart into what it covers of each piece, and hindsight
knows the geometry: so a pair's value is known at once, and nothing is bootstrapped. What tokens
that slide push away is learned beside it, for each pair of tokens (see `planning`).

Legend: M views, K tokens.
"""

import copy
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from tangram_agent.adam import Adam
from tangram_agent.config import AgentConfig
from tangram_agent.motion import Fit, MotionModel, Motions
from tangram_agent.networks import VELOCITY, Networks, View, initialise, parameter_count
from tangram_agent.pairs import Pairs
from tangram_agent.relabelling import (
    ContactBatch,
    PairBatch,
    SceneBatch,
    make_pairs,
    with_contacts,
    with_scenes,
)
from tangram_agent.scenes import Scenes, next_token
from tangram_agent.setup import Setup
from tangram_agent.types import Transitions, Weights
from tangram_agent.weights import load_arrays, to_arrays, under
from tangram_sim.actions import chosen_tokens
from tangram_sim.arrays import Bools, Floats, Ints
from tangram_sim.errors import RunError

Array = npt.NDArray[Any]
Batch = Transitions | PairBatch
_COUNTER = "updates"


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
    """Rho of a running average after `updates` updates: smaller at first, to forget the start.

    A constant 0.99 holds the random weights of the start for hundreds of updates.
    """
    return min(rho, updates / (updates + 9.0))


class NotFiniteError(RunError):
    """Numbers of an update, or weights, that are not finite."""


@dataclass(frozen=True, eq=False)
class Steps:
    """A batch as both losses see it.

    Attributes:
        view: where the action was taken.
        velocity: (M, 3) of the action, in the arena's axes.
        reward: (M,) what the critic learns, less what follows.
        done: (M,) 1 where nothing follows.
        start: where the actor is asked from: mostly the same view.
        follow: what the action came to.
        seen_after: that too where an afterstate critic is to see it as it was, else it sees the
            exact motion.
    """

    view: View
    velocity: Tensor
    reward: Tensor
    done: Tensor
    start: View
    follow: View
    seen_after: View | None = None


class Learner:
    """Actor, critic, their targets and optimisers.

    Attributes:
        updates: number of updates made.
        bootstraps: whether the critic's target counts what follows (Eq. 5): only then are there
            target networks.
        parts: networks by the names under which a checkpoint has them.
        playing: what a worker plays with: the actor, or both networks where both play.
        acting: its running average, which is what workers get.
    """

    def __init__(self, setup: Setup, seed: int, device: str = "cpu") -> None:
        self.config: AgentConfig = setup.agent
        self.device = torch.device(device)
        self.updates = 0
        self.bootstraps = setup.bootstraps
        self._setup, self._layout, self._tokens = setup, setup.layout, setup.layout.tokens
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
        self.actor_optimiser = Adam(self._lists["actor"], self.config.actor_lr)
        self.critic_optimiser = Adam(self._lists["critic"], self.config.critic_lr)
        self._fit = None if self.motion is None else Fit(self.motion)

    def parameter_lists(self) -> dict[str, list[Tensor]]:
        """Parameters by the names of `parts`, and those of `playing`."""
        modules = self.parts | {"playing": self.playing}
        return {name: list(module.parameters()) for name, module in modules.items()}

    def prepared(self, batch: Transitions, generator: np.random.Generator) -> Batch:
        """What `update` takes, from a batch of transitions: pairs, where the agent sees such."""
        if not self._setup.pairs:
            return batch
        pairs = make_pairs(batch, self._setup, generator)
        if self._setup.credits_scenes:
            return with_scenes(pairs, batch, self._layout, generator)
        return (
            with_contacts(pairs, batch, self._layout, generator) if self._setup.contacts else pairs
        )

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
        self._set_learning_rate(progress)
        steps = self.steps(batch)
        # Made once where critic and actor see the same: as it stands, from the same token.
        features = None
        if not self.config.afterstate and steps.start is steps.view:
            features = self.actor.head.see(steps.view)
        if isinstance(batch, SceneBatch):
            loss, q = self.scene_loss(batch)
        else:
            loss, q = self.critic_loss(steps, features)
        if isinstance(batch, ContactBatch):
            loss = loss + self.push_loss(batch)
        values = self._critic_step(loss, q) | self._actor_step(steps, features)
        if self._fit is not None and motions is not None:
            values |= self._fit.step(motions.to(self.device))
        self._follow()
        # One wait for the device, after everything has been asked of it.
        numbers = dict(zip(values, torch.stack(list(values.values())).tolist(), strict=True))
        check_finite(self.updates + 1, numbers)
        self.updates += 1
        return numbers

    def steps(self, batch: Batch) -> Steps:
        """A batch as tensors on the device."""
        return self._of_pairs(batch) if isinstance(batch, PairBatch) else self._of_scenes(batch)

    def _of_scenes(self, batch: Transitions) -> Steps:
        state, placed = self._tensor(batch.state), self._tensor(batch.placed)
        goal, action = self._tensor(batch.goal), self._tensor(batch.action)
        taken = Scenes(
            state,
            placed,
            goal,
            self._index(chosen_tokens(batch.action.astype(np.float64), self._tokens)),
        )
        start = taken if self._tokens == 1 else Scenes(state, placed, goal, next_token(placed))
        following, flags = self._tensor(batch.next_state), self._tensor(batch.next_placed)
        return Steps(
            view=taken,
            velocity=action[:, -VELOCITY:],
            reward=self._tensor(batch.reward),
            done=self._tensor(batch.done),
            start=start,
            follow=Scenes(following, flags, goal, next_token(flags)),
        )

    def _of_pairs(self, batch: PairBatch) -> Steps:
        after = self._pairs(batch, batch.after, batch.after_flipped)
        return Steps(
            view=self._pairs(batch, batch.before, batch.before_flipped),
            velocity=self._tensor(batch.velocity),
            reward=self._tensor(batch.reward),
            done=self._tensor(batch.done),
            start=self._pairs(batch, batch.start, batch.start_flipped),
            follow=after,
            seen_after=after,
        )

    def _pairs(self, batch: PairBatch, pose: Floats, flipped: Bools) -> Pairs:
        """The pairs (M,) with their tokens where they lay at some time."""
        return Pairs(
            pose=self._tensor(pose),
            flipped=self._tensor(flipped),
            token=self._index(batch.token),
            goal=self._tensor(batch.goal),
            goal_flipped=self._tensor(batch.goal_flipped),
            piece=self._index(batch.piece),
            covered=self._tensor(batch.covered),
        )

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
        return -q.mean(), saturation(raw, self.config.saturation_limit)

    def push_loss(self, batch: ContactBatch) -> Tensor:
        """Mean squared error of what tokens that slide push away."""
        before = self._pairs(batch, batch.before, batch.before_flipped)
        # Where tokens meet, the other one has the place of a piece that nothing covers.
        meeting = replace(
            before,
            goal=self._tensor(batch.other_pose),
            goal_flipped=self._tensor(batch.other_flipped),
            piece=self._index(batch.other),
            covered=torch.zeros_like(before.covered),
        )
        share = self.critic.pushed(meeting, self._tensor(batch.after))
        return (share - self._tensor(batch.pushed)).square().mean()

    def scene_loss(self, batch: SceneBatch) -> tuple[Tensor, Tensor]:
        """Mean squared error of the reward as a sum over all pairs of a scene, and the sums (B,).

        As in value decomposition networks (Sunehag et al. 2018): nobody says which pair earned it.
        """
        count, tokens = batch.poses.shape[:2]
        token, piece = (part.reshape(-1) for part in np.indices((tokens, tokens)))
        pairs = Pairs(
            pose=self._tensor(batch.poses[:, token].reshape(-1, 3)),
            flipped=self._tensor(batch.flips[:, token].reshape(-1)),
            token=self._index(np.tile(token, count)),
            goal=self._tensor(batch.goals[:, piece].reshape(-1, 3)),
            goal_flipped=self._tensor(batch.goal_flips[:, piece].reshape(-1)),
            piece=self._index(np.tile(piece, count)),
            covered=torch.zeros(count * tokens * tokens, device=self.device),
        )
        still = torch.zeros(len(pairs.pose), VELOCITY, device=self.device)
        values = self.critic(pairs, still, pairs).view(count, -1)
        areas = self._layout.areas
        weights = self._tensor(np.maximum(areas[token], areas[piece]) / areas.sum())
        share = values @ weights
        error = 2.0 * share - 1.0 - self._tensor(batch.returned)
        return error.square().mean(), share

    def _target(self, steps: Steps) -> Tensor:
        """Eq. 5; the target networks are not asked where no transition goes on."""
        if not self.bootstraps or bool(steps.done.all()):
            return steps.reward
        velocity, _ = self.target_actor(steps.follow)
        following = self.target_critic(steps.follow, velocity)
        return critic_target(steps.reward, steps.done, following, self.config.gamma)

    def _follow(self) -> None:
        """Move target networks and the acting average a little towards the networks."""
        lists, config = self._lists, self.config
        if self.bootstraps:
            polyak_update(lists["target_critic"], lists["critic"], config.polyak)
            polyak_update(lists["target_actor"], lists["actor"], config.polyak)
        rho = average_so_far(config.acting_average, self.updates)
        polyak_update(lists["acting"], lists["playing"], rho)

    def _critic_step(self, loss: Tensor, q: Tensor) -> dict[str, Tensor]:
        norm = self._step("critic", loss)
        return {"critic_loss": loss.detach(), "q": q.detach().mean(), "critic_gradient": norm}

    def _actor_step(self, steps: Steps, features: Tensor | None) -> dict[str, Tensor]:
        value_loss, penalty = self.actor_loss(steps, features)
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
        clip = self.config.grad_clip
        if clip > 0.0:
            nn.utils.clip_grads_with_norm_(parameters, clip, norm)
        (self.actor_optimiser if part == "actor" else self.critic_optimiser).step()
        return norm

    def rate_factor(self, progress: float) -> float:
        """By which learning rates have fallen at a used share of the budget: along a cosine."""
        share, low = min(max(progress, 0.0), 1.0), self.config.lr_final
        return low + (1.0 - low) * 0.5 * (1.0 + math.cos(math.pi * share))

    def _set_learning_rate(self, progress: float) -> None:
        factor = self.rate_factor(progress)
        self.actor_optimiser.rate = self.config.actor_lr * factor
        self.critic_optimiser.rate = self.config.critic_lr * factor

    def _tensor(self, column: Array) -> Tensor:
        return torch.from_numpy(np.asarray(column, np.float32)).to(self.device)

    def _index(self, column: Ints) -> Tensor:
        return torch.from_numpy(np.asarray(column, np.int64)).to(self.device)

    def acting_weights(self, version: int) -> Weights:
        """A copy of the weights that workers play with."""
        return Weights(version, to_arrays(self.acting))

    def state(self) -> dict[str, Array]:
        """Everything that the next update depends on, as arrays for a checkpoint."""
        state: dict[str, Array] = {_COUNTER: np.array([self.updates], np.int64)}
        for part, module in self.parts.items():
            for name, value in to_arrays(module).items():
                state[f"{part}.{name}"] = value
        for part, optimiser in self._optimisers().items():
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
        for part, optimiser in self._optimisers().items():
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

    def _optimisers(self) -> dict[str, Adam | Fit]:
        fit = {} if self._fit is None else {"motion": self._fit}
        return {"actor": self.actor_optimiser, "critic": self.critic_optimiser, **fit}


def frozen(module: nn.Module) -> nn.Module:
    """A copy that no gradient reaches."""
    return copy.deepcopy(module).requires_grad_(False)


def check_finite(updates: int, numbers: dict[str, float]) -> None:
    """Raise NotFiniteError unless all numbers of an update are finite."""
    if not all(map(math.isfinite, numbers.values())):
        listed = ", ".join(f"{name}={value:g}" for name, value in numbers.items())
        raise NotFiniteError(f"update {updates} is not finite ({listed})")
