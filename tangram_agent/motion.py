"""What a command comes to: a model of motion, learned from the replay and corrected in play.

A command c (x, y and turn, shares of full scale) moves a token by a way d, in the same units. The
model is a Bayesian linear regression on features, d = K phi(c) + noise. Features and prior are
learned from whole episodes (ALPaCA: Harrison, Sharma and Pavone 2018), so before the first action
of an episode it knows what is usual, and every action that is seen tells it more of the world at
hand. It starts as the exact rigid motion, d = c, and knows how sure it is.

Legend: B episodes, T actions of each, F features; a command and a way have 3 entries.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from tangram_agent.types import Past
from tangram_sim.actions import chosen_tokens, velocities_of
from tangram_sim.arrays import Floats
from tangram_sim.config import SimConfig
from tangram_sim.layout import Layout

_HIDDEN, _LEARNED = 64, 16
_GIVEN = 5  # features that are not learned: the command, its shift's length, and 1
_NOISE, _LEAST_NOISE = 0.02, 1e-4  # deviation of a way at the start, and at least
_SEARCH_STEPS, _NEAR_ENOUGH = 30, 1e-5
_SHORT = 0.01  # share of a half turn
_SLOPES = 0.1, 10.0  # of what a command comes to, as the search takes them
_STILL = 1e-6  # an action that moves no more was refused or blocked


@dataclass(frozen=True, eq=False)
class Belief:
    """What is believed of the motion in B worlds, in float64: it begins far from sure.

    Attributes:
        mean: (B, 3, F) of K.
        covariance: (B, 3, F, F) of the rows of K, in units of the noise's variance.
    """

    mean: Tensor
    covariance: Tensor

    def at(self, row: Tensor) -> "Belief":
        """The beliefs of these rows."""
        return Belief(self.mean[row], self.covariance[row])


@dataclass(frozen=True, eq=False)
class Motions:
    """What T actions of B episodes came to.

    Attributes:
        command: (B, T, 3).
        way: (B, T, 3) of the token that each action named, by the shorter turn.
        moved: (B, T) 1 where it moved; an action that was refused or blocked tells nothing.
    """

    command: Tensor
    way: Tensor
    moved: Tensor

    def to(self, device: torch.device) -> "Motions":
        """The same on a device."""
        return Motions(*(part.to(device) for part in vars(self).values()))


def motions_of(past: Past, now: Floats, layout: Layout, sim: SimConfig) -> Motions:
    """The motions that corners of the past, and those now (B, V, 2), show."""
    corners = np.concatenate([past.corners, now[:, None]], axis=1).astype(np.float64)
    poses = layout.poses(corners)
    count, steps, size = past.actions.shape
    actions = past.actions.reshape(count * steps, size).astype(np.float64)
    token = chosen_tokens(actions, layout.tokens).reshape(count, steps, 1, 1)
    before, after = (
        np.take_along_axis(part, token, axis=2)[:, :, 0] for part in (poses[:, :-1], poses[:, 1:])
    )
    way = velocities_of((after - before).reshape(-1, 3), sim).reshape(count, steps, 3)
    moved = np.abs(way).max(axis=-1) > _STILL
    command = actions[:, -3:].reshape(count, steps, 3)
    return Motions(*(torch.from_numpy(part.astype(np.float32)) for part in (command, way, moved)))


class MotionModel(nn.Module):
    """The prior of K, the features, and the noise."""

    def __init__(self) -> None:
        super().__init__()
        self.hidden = nn.Linear(3, _HIDDEN)
        self.learned = nn.Linear(_HIDDEN, _LEARNED)
        exact = torch.eye(3, _GIVEN + _LEARNED)
        self.mean = nn.Parameter(exact)
        self.log_variance = nn.Parameter(torch.zeros_like(exact))
        self.log_noise = nn.Parameter(torch.full((3,), math.log(_NOISE)))

    @property
    def noise(self) -> Tensor:
        """(3,) deviation of a way that nothing explains."""
        return self.log_noise.exp() + _LEAST_NOISE

    def features(self, command: Tensor) -> Tensor:
        """Phi (..., F) of commands (..., 3), in float64."""
        length = command[..., :2].norm(dim=-1, keepdim=True)
        learned = torch.tanh(self.learned(torch.tanh(self.hidden(2.0 * command))))
        given = torch.cat([command, length, torch.ones_like(length)], dim=-1)
        return torch.cat([given, learned], dim=-1).double()

    def prior(self, count: int) -> Belief:
        """What is believed of so many worlds before anything is seen of them."""
        mean, covariance = self.mean.double(), torch.diag_embed(self.log_variance.double().exp())
        return Belief(mean.expand(count, -1, -1), covariance.expand(count, -1, -1, -1))

    def belief(self, motions: Motions) -> Belief:
        """What is believed after motions were seen."""
        belief = self.prior(len(motions.command))
        phi = self.features(motions.command)
        for t in range(phi.shape[1]):
            belief = _told(belief, phi[:, t], motions, t, *_expected(belief, phi[:, t], motions, t))
        return belief

    def predict(self, belief: Belief, command: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and deviation (B, 3) of what commands (B, 3) come to."""
        mean, spread = _predict(belief, self.features(command))
        return mean.float(), (spread.sqrt() * self.noise).float()

    def loss(self, motions: Motions) -> tuple[Tensor, Tensor]:
        """Mean negative log likelihood of each motion given those before it in its episode.

        Beside it the root of the mean squared error of the last ones, of those that moved.
        """
        belief, losses = self.prior(len(motions.command)), []
        phi, noise = self.features(motions.command), self.noise
        last = phi.shape[1] - 1
        for t in range(last + 1):
            wrong, spread = _expected(belief, phi[:, t], motions, t)
            variance = spread * noise.square()
            loss = (wrong.square() / variance + variance.log()).sum(dim=-1)
            losses.append(0.5 * (loss * motions.moved[:, t]).mean())
            if t < last:
                belief = _told(belief, phi[:, t], motions, t, wrong, spread)
        moved = motions.moved[:, -1:]
        error = (wrong.detach().square() * moved).sum() / (3.0 * moved.sum()).clamp(min=1.0)
        return torch.stack(losses).mean().float(), error.sqrt().float()

    def command(self, belief: Belief, way: Tensor) -> Tensor:
        """(B, 3) in [-1, 1], the nearest that was found to come to ways (B, 3).

        Where a turn falls short, the other way round is tried, too.
        """
        command, missing = self._search(belief, way, way.clamp(-1.0, 1.0))
        if bool((missing[:, 2].abs() > _SHORT).any()):
            back = torch.cat([command[:, :2], -command[:, 2:].sign()], dim=-1)
            other, less = self._search(belief, way, back)
            nearer = less.norm(dim=-1) < missing.norm(dim=-1) - _NEAR_ENOUGH
            command = torch.where(nearer[:, None], other, command)
        return command

    def _search(self, belief: Belief, way: Tensor, command: Tensor) -> tuple[Tensor, Tensor]:
        """Commands (B, 3) from these on, and what their ways miss, by secants of each axis."""
        missing = self._missing(belief, way, command)
        slope = torch.ones_like(way)
        for _ in range(_SEARCH_STEPS):
            tried = (command + missing / slope).clamp(-1.0, 1.0)
            step = tried - command
            if bool(step.abs().max() < _NEAR_ENOUGH):
                break
            rest = self._missing(belief, way, tried)
            secant = torch.where(step.abs() < _NEAR_ENOUGH, slope, (missing - rest) / step)
            better = rest.norm(dim=-1, keepdim=True) < missing.norm(dim=-1, keepdim=True)
            slope = torch.where(better, secant, torch.maximum(secant, 1.5 * slope)).clamp(*_SLOPES)
            command = torch.where(better, tried, command)
            missing = torch.where(better, rest, missing)
        return command, missing

    def _missing(self, belief: Belief, way: Tensor, command: Tensor) -> Tensor:
        return _shortest(way - _predict(belief, self.features(command))[0]).float()


def _expected(belief: Belief, phi: Tensor, motions: Motions, t: int) -> tuple[Tensor, Tensor]:
    """By how much motion t is not what is expected (B, 3), and the variance of that.

    The variance is in units of the noise's.
    """
    mean, spread = _predict(belief, phi)
    return _shortest(motions.way[:, t] - mean), spread


def _told(
    belief: Belief, phi: Tensor, motions: Motions, t: int, wrong: Tensor, spread: Tensor
) -> Belief:
    """The belief after motion t, which was so wrong, with such a spread."""
    along = torch.einsum("bdfg,bg->bdf", belief.covariance, phi)
    gain = motions.moved[:, t, None, None] * along / spread[..., None]
    return Belief(
        belief.mean + gain * wrong[..., None],
        belief.covariance - gain[..., :, None] * along[..., None, :],
    )


def _predict(belief: Belief, phi: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (B, 3) of ways with features (B, F), and their variance in units of the noise's."""
    mean = torch.einsum("bdf,bf->bd", belief.mean, phi)
    return mean, 1.0 + torch.einsum("bf,bdfg,bg->bd", phi, belief.covariance, phi)


def _shortest(way: Tensor) -> Tensor:
    """Ways (..., 3) by the shorter turn."""
    turned = torch.remainder(way[..., 2:] + 1.0, 2.0) - 1.0
    return torch.cat([way[..., :2], turned], dim=-1)
