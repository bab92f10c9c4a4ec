"""What a world makes of an action before its token moves: four of them, by name."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Dynamics:
    """How far the motion of a token is from what its action says.

    Attributes:
        substeps: least simulation steps of the engine in one action of one second. One step turns
            exactly up to pi / 4 and too little beyond, so that a half turn needs four.
        damping: linear and angular, of the engine; above 0 a lifted token stops short.
        damping_spread: each episode draws its damping between damping and so much more.
        gain_spread: each episode draws for x, y and turn how many times it is told what an action
            says, between 1 / gain_spread and gain_spread, uniform in the logarithm.
        bias_spread: each episode draws for x, y and turn what is added to it, at most so many full
            scales either way.
        delayed: an action is carried out one step late: the first moves nothing, the last has no
            effect.
    """

    substeps: int = 8
    damping: float = 0.0
    damping_spread: float = 0.0
    gain_spread: float = 1.0
    bias_spread: float = 0.0
    delayed: bool = False

    @property
    def falls_short(self) -> bool:
        """Whether the engine itself takes a token less far than it is told."""
        return self.damping + self.damping_spread > 0.0


WORLDS = {
    "plain": Dynamics(),
    "bullet": Dynamics(substeps=1, damping=0.04),
    "drawn": Dynamics(damping_spread=0.1, gain_spread=1.25, bias_spread=0.05),
    "delayed": Dynamics(delayed=True),
}
