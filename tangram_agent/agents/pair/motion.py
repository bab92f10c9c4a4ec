"""What a command comes to: a model of motion, learned from the replay and corrected in play.

A command c (x, y and turn, shares of full scale) moves a token by a way d, in the same units. The
model is a Bayesian linear regression on given features, d = K phi(c) + noise. What entries of K
are usual, how much they differ between episodes, and the noise are fitted to whole episodes in
closed form; every action that is seen tells the model more of the world at hand. It starts as the
exact rigid motion, d = c, and knows how sure it is. Where actions come late (`sim.world=delayed`)
it knows so much, and takes the command before for the cause.

Legend: B episodes, T actions of each, F features; a command and a way have 3 entries.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from tangram_core.arrays import Floats
from tangram_core.errors import RunError
from tangram_sim.config import SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.motion.actions import chosen_tokens, flips, velocities, velocities_of
from tangram_tasks.played import Past

_FEATURES = 26
_SPREAD, _NOISE = 0.1, 0.02  # deviations of entries of K and of a way, at the start
_LEAST = 1e-4  # deviation of a way, and of an entry of K: another world may differ more
_LEAST_GAIN = 1e-2  # of how far a command's own axis goes: what other worlds differ in first
_BOUNDS = -40.0, 40.0  # logarithms that are believed of weights which came from elsewhere
_FAR, _FAR_LEAST = 12.0, 0.02  # medians, and a way, beside what is usual that are no motion
_KEPT = 0.998  # of what was seen before, with each update
_SEARCH_STEPS, _NEAR_ENOUGH = 30, 1e-5
_SHORT = 0.01  # share of a half turn
_SLOPES = 0.1, 10.0  # of what a command comes to, as the search takes them
_NOISE_DEVIATIONS = 8.0  # of a corner's noise that are no motion
_SEEN = 0.64  # pixels that a token which lies still may seem to move
_STILL = 1e-6  # an action that moves no more was refused or blocked


@dataclass(frozen=True, eq=False)
class Belief:
    """What is believed of the motion in B worlds, in float64.

    Attributes:
        mean: (B, 3, F) of K.
        covariance: (B, 3, F, F) of the rows of K.
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
        way: (B, T, 3) of the token that it named, by the shorter turn.
        moved: (B, T) 1 where it was seen to move; an action that was refused or blocked tells
            nothing.
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
    # Late, nothing is carried out in the first step, and what is told last not at all.
    if sim.dynamics.delayed:
        poses, steps = poses[:, 1:], max(steps - 1, 0)
    actions = past.actions[:, :steps].reshape(count * steps, size).astype(np.float64)
    token = chosen_tokens(actions, layout.tokens).reshape(count, steps, 1, 1)
    ways = velocities_of((poses[:, 1:] - poses[:, :-1]).reshape(-1, 3), sim)
    ways = ways.reshape(count, steps, layout.tokens, 3)
    way = np.take_along_axis(ways, token, axis=2)[:, :, 0]
    # Seen with noise, what was blocked or refused seems to have moved; a lone token never is.
    seen = _SEEN / sim.pixels if sim.observe == "pictures" else 0.0
    noise = max(seen, _NOISE_DEVIATIONS * sim.corner_noise)
    still = _STILL + (noise if layout.tokens > 1 else 0.0)
    moved = np.abs(way).max(axis=-1, initial=0.0) > still
    if sim.motion == "lift":
        # Where others went, too, it was set down on them, and they decided where it came to lie.
        # Their turns are left out: noise turns a small token by much.
        shifted = np.abs(ways[..., :2]).max(axis=-1, initial=0.0) > still
        np.put_along_axis(shifted, token[..., 0], False, axis=2)
        moved &= ~shifted.any(axis=2)
    if past.seen is not None and layout.tokens > 1:
        # One wrong way spoils what is believed.
        found = past.seen[:, -1 - way.shape[1] :] > 0
        moved &= np.take_along_axis(found[:, :-1] & found[:, 1:], token[..., 0], axis=2)[..., 0]
    command = actions[:, -3:].reshape(count, steps, 3).clip(-1.0, 1.0)
    return Motions(*(torch.from_numpy(part.astype(np.float64)) for part in (command, way, moved)))


def features(command: Tensor) -> Tensor:
    """Phi (..., F) of commands (..., 3), in float64.

    A shift that is shortened by its length, a turn by its angle, and what a bias makes of that.
    """
    command = command.double()
    shift, x, y, turn = command[..., :2], command[..., :1], command[..., 1:2], command[..., 2:]
    length, angle = shift.norm(dim=-1, keepdim=True), turn.abs()
    unit = shift / (length + 1e-3)
    of_shift = [length, length * shift, length**2 * shift, x * x, x * y, y * y, unit, x * unit]
    of_turn = [
        angle * turn,
        turn**2,
        turn**3,
        angle * turn**3,
        turn**4,
        turn**5,
        angle * turn**5,
        turn**7,
        angle * turn**7,
    ]
    parts = [command, torch.ones_like(length), *of_shift, *of_turn, length * turn]
    return torch.cat(parts, dim=-1)


@dataclass(frozen=True, eq=False)
class _Seen:
    """Motions of B episodes beside what is usual.

    Attributes:
        phi: (B, T, F), 0 where nothing moved.
        off: (B, 3, T) how far the way is from the usual one.
        along: (B, 3, T, F) covariance of ways and entries of K.
        inverse: (B, 3, T, T) of the covariance of the ways.
    """

    phi: Tensor
    off: Tensor
    along: Tensor
    inverse: Tensor


class MotionModel(nn.Module):
    """What entries of K are usual, how much they differ between episodes, and the noise."""

    def __init__(self) -> None:
        super().__init__()
        exact = torch.eye(3, _FEATURES)
        self.mean = nn.Parameter(exact)
        self.log_variance = nn.Parameter(torch.full_like(exact, 2.0 * math.log(_SPREAD)))
        self.log_noise = nn.Parameter(torch.full((3,), 2.0 * math.log(_NOISE)))
        self.requires_grad_(False)

    @property
    def variance(self) -> Tensor:
        """(3, F) of entries of K between episodes."""
        return self.log_variance.double().clamp(*_BOUNDS).exp()

    @property
    def noise(self) -> Tensor:
        """(3,) variance of a way that nothing explains."""
        return self.log_noise.double().clamp(*_BOUNDS).exp()

    def prior(self, count: int) -> Belief:
        """What is believed of so many worlds before anything is seen of them."""
        mean, covariance = self.mean.double(), torch.diag_embed(self.variance)
        return Belief(mean.expand(count, -1, -1), covariance.expand(count, -1, -1, -1))

    def belief(self, motions: Motions) -> Belief:
        """What is believed after motions were seen."""
        seen, prior = self.beside_usual(motions), self.prior(len(motions.command))
        gain = seen.inverse @ seen.along
        return Belief(
            prior.mean + (gain * seen.off[..., None]).sum(dim=2),
            prior.covariance - seen.along.mT @ gain,
        )

    def off(self, motions: Motions) -> Tensor:
        """(B, 3, T) how far ways are from the usual one, 0 where nothing moved."""
        usual = features(motions.command) @ self.mean.double().mT
        return (_shortest(motions.way - usual) * motions.moved[..., None]).mT

    def beside_usual(self, motions: Motions) -> _Seen:
        """What was seen, beside what was to be expected."""
        moved = motions.moved[..., None]
        phi = features(motions.command) * moved
        along = phi[:, None] * self.variance[:, None]
        noise = torch.diag_embed(self.noise[:, None].expand(3, phi.shape[1]))
        inverse = torch.linalg.inv(along @ phi[:, None].mT + noise)
        return _Seen(phi, self.off(motions), along, inverse)

    def predict(self, belief: Belief, command: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and deviation (B, 3) of what commands (B, 3) come to."""
        phi = features(command)
        spread = torch.einsum("bf,bdfg,bg->bd", phi, belief.covariance, phi)
        deviation = (spread + self.noise).sqrt()
        return torch.einsum("bdf,bf->bd", belief.mean, phi).float(), deviation.float()

    def ahead(
        self, belief: Belief, corners: Floats, past: Past, layout: Layout, sim: SimConfig
    ) -> Floats:
        """Corners (B, V, 2) once what was told last, and comes late, is carried out."""
        if not sim.dynamics.delayed or not past.actions.shape[1]:
            return corners
        last = past.actions[:, -1].astype(np.float64)
        token, rows = chosen_tokens(last, layout.tokens), np.arange(len(last))
        poses, sides = layout.poses(corners), layout.flipped(corners)
        sides[rows, token] ^= flips(last, layout, sim)
        way, _ = self.predict(belief, torch.from_numpy(last[:, -3:]))
        poses[rows, token] += velocities(way.numpy(), sim)
        return layout.corners(poses, sides)

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
        return _shortest(way - torch.einsum("bdf,bf->bd", belief.mean, features(command))).float()


class Fit:
    """Fits a model to episodes, in closed form, where a network takes steps of its optimiser.

    The usual K is that of generalised least squares over the motions seen, older ones counting
    less. Each variance is multiplied by the root of what the errors hold it responsible for over
    what they would if it were right: the likelihood grows without a rate (MM, Zhou et al. 2019).

    Attributes:
        slots: sums of squares and products of each axis; empty before a step.
    """

    def __init__(self, model: MotionModel, screened: bool = False) -> None:
        """With sums of nothing.

        Args:
            model: what is fitted.
            screened: whether motions far beside what is usual are left out, where only tokens that
                met others, or were seen wrongly, can make such.
        """
        self.slots: dict[str, list[Tensor]] = {}
        self._model, self._screened = model, screened

    def load(self, slots: dict[str, list[Tensor]]) -> None:
        """Take over the sums of the same model.

        Raises:
            RunError: they are of another one.
        """
        size = _FEATURES
        wanted = {"squares": [(size, size)] * 3, "products": [(size,)] * 3}
        found = {name: [tuple(one.shape) for one in own] for name, own in slots.items()}
        real = all(one.isfinite().all() for own in slots.values() for one in own)
        sums = real and all((one.diagonal() >= 0.0).all() for one in slots.get("squares", []))
        if slots and not (found == wanted and sums):
            raise RunError(
                "the sums of the motion model are not those of this version: start a new run"
            )
        self.slots = {name: [one.double() for one in own] for name, own in slots.items()}

    @torch.no_grad()
    def step(self, motions: Motions) -> dict[str, Tensor]:
        """Fit to more motions; their error (shares of full scale) and the noise that is seen.

        The error is that of each episode's last action, those before it being known.
        """
        model = self._model
        if self._screened:
            motions = self._plausible(motions)
        seen = model.beside_usual(motions)
        usual = model.mean.double()
        squares = torch.einsum("btf,bdtu,bug->dfg", seen.phi, seen.inverse, seen.phi)
        blame = torch.einsum("bdtu,bdu->bdt", seen.inverse, seen.off)
        lacks = torch.einsum("btf,bdt->bdf", seen.phi, blame)
        products = lacks.sum(dim=0) + torch.einsum("dfg,dg->df", squares, usual)
        self._add("squares", squares)
        self._add("products", products)
        total, right = (torch.stack(self.slots[name]) for name in ("squares", "products"))
        one = torch.eye(total.shape[-1], dtype=total.dtype, device=total.device)
        model.mean.copy_(torch.linalg.solve(total + one, right + one[:3]))
        alone = squares.diagonal(dim1=1, dim2=2)
        model.log_variance.add_(0.5 * (_log(lacks.square().sum(dim=0)) - _log(alone)))
        moved = motions.moved[:, None]
        own = (seen.inverse.diagonal(dim1=2, dim2=3) * moved).sum(dim=(0, 2))
        model.log_noise.add_(0.5 * (_log(blame.square().sum(dim=(0, 2))) - _log(own)))
        for learned in (model.log_noise, model.log_variance):
            learned.clamp_(min=2.0 * math.log(_LEAST))
        model.log_variance.diagonal().clamp_(min=2.0 * math.log(_LEAST_GAIN))
        last = (blame[..., -1] / seen.inverse[..., -1, -1]).square() * moved[..., -1]
        error = (last.sum() / (3.0 * moved[..., -1].sum()).clamp(min=1.0)).sqrt()
        return {
            "motion_error": error.float(),
            "motion_noise": model.log_noise.exp().mean().sqrt(),
        }

    def _plausible(self, motions: Motions) -> Motions:
        """The motions without those that are many medians beside what is usual."""
        off = self._model.off(motions).abs()
        moved = motions.moved > 0.0
        usual = off.mT[moved].median(dim=0).values if moved.any() else off.new_zeros(3)
        near = (off <= _FAR * usual[:, None] + _FAR_LEAST).all(dim=1)
        return replace(motions, moved=motions.moved * near)

    def _add(self, name: str, more: Tensor) -> None:
        before = self.slots.get(name, [torch.zeros_like(one) for one in more])
        self.slots[name] = [_KEPT * old + one for old, one in zip(before, more, strict=True)]


def _log(value: Tensor) -> Tensor:
    return (value + 1e-12).log()


def _shortest(way: Tensor) -> Tensor:
    """Ways (..., 3) by the shorter turn."""
    turned = torch.remainder(way[..., 2:] + 1.0, 2.0) - 1.0
    return torch.cat([way[..., :2], turned], dim=-1)
