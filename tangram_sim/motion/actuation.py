"""The world between an action and its token: what a token is told where an action says something.

Everything that is not the engine's own stands here, for every backend alike: gain, bias and delay.
See `Dynamics`; what varies each episode draws for itself.

Legend: B environments. Entries are x, y and turn; full scale is the arena's width and half a turn.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tangram_core.arrays import Bools, Floats, Ints
from tangram_sim.config import SimConfig


@dataclass(frozen=True, eq=False)
class Command:
    """What B environments are to do: which token (B,) moves, or none where they are idle.

    Attributes:
        velocity: (B, 3) in arena units and radians a second.
        flip: (B,) whether it is turned over.
    """

    tokens: Ints
    velocity: Floats
    flip: Bools
    idle: Bools


class Actuation:
    """What the episodes that are being played have drawn, and what it makes of actions.

    Attributes:
        gain: (B, 3), see `Dynamics`, as all of these.
        bias: (B, 3).
        damping: (B,).
        pending: in a delayed world what the next step carries out; None: nothing.
        carried: what the last step carried out, as it was commanded; None before the first.
    """

    def __init__(self, sim: SimConfig, count: int) -> None:
        self._dynamics = sim.dynamics
        self._scale = full_scale(sim)
        self.gain: Floats = np.ones((count, 3))
        self.bias: Floats = np.zeros((count, 3))
        self.damping: Floats = np.full(count, self._dynamics.damping)
        self.pending: Command | None = None
        self.carried: Command | None = None

    def begin(self, generators: Sequence[np.random.Generator]) -> None:
        """Draw what varies, for one episode each; what does not draws nothing."""
        world, self.pending, self.carried = self._dynamics, None, None
        if world.gain_spread > 1.0:
            self.gain = world.gain_spread ** _uniform(generators, 3)
        if world.bias_spread:
            self.bias = world.bias_spread * _uniform(generators, 3)
        if world.damping_spread:
            share = (1.0 + _uniform(generators, 1)[:, 0]) / 2.0
            self.damping = world.damping + world.damping_spread * share

    def carry_out(self, command: Command) -> Command:
        """What this step carries out of what it was told, or of what the one before was."""
        if self._dynamics.delayed:
            nothing = replace(command, idle=np.ones_like(command.idle))
            command, self.pending = self.pending or nothing, command
        self.carried = command
        return replace(command, velocity=self.told(command.velocity))

    def told(self, velocity: Floats) -> Floats:
        """What tokens are told, (B, 3), where actions say velocities (B, 3), both a second.

        Arena units and radians.
        """
        given: Floats = self.gain * velocity + self.bias * self._scale
        return given

    def commands(self, wanted: Floats) -> Floats:
        """The entries of actions, (B, 3) in [-1, 1], by which tokens are told what is nearest."""
        return np.clip((wanted / self._scale - self.bias) / self.gain, -1.0, 1.0)


def full_scale(sim: SimConfig) -> Floats:
    """(3,) what an entry of 1 moves in a second: the arena's width in x and in y, half a turn."""
    return np.array([sim.arena, sim.arena, np.pi])


def reach(sim: SimConfig) -> Floats:
    """(3,) the most that a token can be told in an action, full scales."""
    return np.full(3, sim.dynamics.gain_spread + sim.dynamics.bias_spread)


def _uniform(generators: Sequence[np.random.Generator], size: int) -> Floats:
    """(B, size) in [-1, 1)."""
    return np.stack([generator.uniform(-1.0, 1.0, size) for generator in generators])
