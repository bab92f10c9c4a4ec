"""The world between an action and its token: what a token is told where an action says something.

Everything that is not the engine's own stands here, for every backend alike: gain, bias, drift,
noise and delay. What is fixed comes from `SimConfig`, what varies each episode draws for itself.

Legend: B environments. Entries are x, y and turn; full scale is the arena's width and half a turn.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tangram_sim.arrays import Bools, Floats, Ints
from tangram_sim.config import SimConfig
from tangram_sim.observation_noise import CUT


@dataclass(frozen=True, eq=False)
class Command:
    """What B environments are to do.

    Attributes:
        tokens: (B,) which one moves.
        velocity: (B, 3) in arena units and radians a second.
        flip: (B,) whether it is turned over.
        idle: (B,) where nothing moves.
    """

    tokens: Ints
    velocity: Floats
    flip: Bools
    idle: Bools


class Actuation:
    """What the episodes that are being played have drawn, and what it makes of actions.

    Attributes:
        gain: (B, 3), see `SimConfig`, as all of these.
        bias: (B, 3).
        drift: (B,).
        damping: (B,).
        pending: with `sim.delay` what the next step carries out; None: nothing.
        carried: what the last step carried out, as it was commanded; None before the first.
    """

    def __init__(self, sim: SimConfig, count: int) -> None:
        self._sim = sim
        self._scale = full_scale(sim)
        self._generators: Sequence[np.random.Generator] = ()
        self.gain: Floats = np.tile(np.array(sim.gain, np.float64), (count, 1))
        self.bias: Floats = np.tile(np.array(sim.bias, np.float64), (count, 1))
        self.drift: Floats = np.full(count, sim.drift)
        self.damping: Floats = np.full(count, sim.damping)
        self.pending: Command | None = None
        self.carried: Command | None = None

    def begin(self, generators: Sequence[np.random.Generator]) -> None:
        """Draw what varies, for one episode each; what does not draws nothing."""
        sim, self._generators, self.pending, self.carried = self._sim, generators, None, None
        if sim.gain_spread > 1.0:
            self.gain = np.array(sim.gain) * sim.gain_spread ** self._uniform(3)
        if sim.bias_spread:
            self.bias = np.array(sim.bias) + sim.bias_spread * self._uniform(3)
        if sim.drift_spread:
            self.drift = sim.drift + sim.drift_spread * self._uniform(1)[:, 0]
        if sim.damping_spread:
            share = (1.0 + self._uniform(1)[:, 0]) / 2.0
            self.damping = sim.damping + sim.damping_spread * share

    def carry_out(self, command: Command) -> Command:
        """What this step carries out of what it was told, or of what the one before was."""
        if self._sim.delay:
            command, self.pending = self.pending or _nothing(command), command
        self.carried = command
        noise: Floats = np.zeros_like(command.velocity)
        if self._sim.action_noise:
            drawn = np.stack([generator.standard_normal(3) for generator in self._generators])
            noise = np.clip(drawn, -CUT, CUT) * self._sim.action_noise
        return replace(command, velocity=self.told(command.velocity, noise))

    def told(self, velocity: Floats, noise: Floats | float = 0.0) -> Floats:
        """What tokens are told, (B, 3), where actions say velocities (B, 3), both a second.

        Args:
            velocity: in arena units and radians.
            noise: (B, 3) on the entries, full scales.
        """
        given: Floats = self.gain * velocity + (self.bias + noise) * self._scale
        given[:, 2] += np.pi * self.drift * np.hypot(given[:, 0], given[:, 1]) / self._sim.arena
        return given

    def commands(self, wanted: Floats) -> Floats:
        """The entries of actions, (B, 3) in [-1, 1], by which tokens are told what is nearest."""
        share = (wanted / self._scale - self.bias) / self.gain
        share[:, :2] = np.clip(share[:, :2], -1.0, 1.0)
        # The turn makes up for the drift of the shift that can be made.
        share[:, 2] = 0.0
        share[:, 2] = (wanted - self.told(share * self._scale))[:, 2] / np.pi / self.gain[:, 2]
        return np.clip(share, -1.0, 1.0)

    def _uniform(self, size: int) -> Floats:
        """(B, size) in [-1, 1)."""
        return np.stack([generator.uniform(-1.0, 1.0, size) for generator in self._generators])


def full_scale(sim: SimConfig) -> Floats:
    """(3,) what an entry of 1 moves in a second: the arena's width in x and in y, half a turn."""
    return np.array([sim.arena, sim.arena, np.pi])


def reach(sim: SimConfig) -> Floats:
    """(3,) the most that a token can be told in an action, full scales."""
    noise = CUT * sim.action_noise
    most = np.array(sim.gain) * sim.gain_spread + np.abs(sim.bias) + sim.bias_spread + noise
    most[2] += (abs(sim.drift) + sim.drift_spread) * np.hypot(most[0], most[1])
    bound: Floats = most
    return bound


def _nothing(command: Command) -> Command:
    return replace(command, idle=np.ones_like(command.idle))
