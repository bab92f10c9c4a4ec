"""What comes between the tokens and a picture of them: where the camera stands, light, blur, noise.

Legend: B environments, P pixels along a side.
"""

from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np

from tangram_core.arrays import Floats, Pixels
from tangram_sim.config import SimConfig

_CUT = 3.0  # deviations at which the Gaussian of a blur ends

Generators = Sequence[np.random.Generator]


@dataclass(frozen=True, eq=False)
class View:
    """How one episode is seen.

    Attributes:
        x, y: the point that the camera looks at, arena units.
        turn: of the camera, radians.
        light: (2,) share by which light grows from the left to the right, and from below to above.
    """

    x: float
    y: float
    turn: float
    light: Floats


@dataclass(frozen=True)
class Disturbance:
    """What is other than it should be where a camera takes pictures.

    Attributes:
        noise: deviation of the Gaussian noise on each pixel, levels of 255.
        blur: deviation of the Gaussian that pictures are blurred with, pixels.
        light: share by which light falls off across a picture, in a direction that is drawn.
        turn: of the camera, degrees, either way as is drawn.
        shift: of the camera, pixels, in a direction that is drawn.
    """

    noise: float = 0.0
    blur: float = 0.0
    light: float = 0.0
    turn: float = 0.0
    shift: float = 0.0

    def times(self, strength: float) -> "Disturbance":
        """So many times as much of everything."""
        return Disturbance(*(strength * value for value in astuple(self)))


# At a strength of 1. From one corner to the other light falls off by sqrt(2) times as much as is
# said: with 0.25, ground in the shade would be as dark as half a token, and count as one in Eq. 14.
FULL = Disturbance(noise=8.0, blur=1.0, light=0.2, turn=1.0, shift=2.0)


class Lens:
    """The camera's disturbance; without any, nothing is drawn and pictures stay as they are.

    Attributes:
        disturbs: whether anything is other than it should be.
        views: B, how the episodes are seen.
    """

    def __init__(self, sim: SimConfig) -> None:
        self._off = FULL.times(sim.disturbance)
        self._pixel = sim.arena / sim.pixels if sim.pixels else 0.0  # arena units
        self.views: list[View] = []
        self.disturbs = sim.disturbance > 0.0

    def begin(self, generators: Generators) -> list[View]:
        """Draw how each of B episodes is seen."""
        self.views = [self._view(generator) for generator in generators]
        return self.views

    def stand(self, views: Sequence[View]) -> list[View]:
        """See B episodes as something was seen before."""
        self.views = list(views)
        return self.views

    def _view(self, generator: np.random.Generator) -> View:
        if not self.disturbs:
            return View(0.0, 0.0, 0.0, np.zeros(2))
        x, y = self._off.shift * self._pixel * _direction(generator)
        turn = np.radians(self._off.turn) * generator.choice((-1, 1))
        return View(float(x), float(y), float(turn), self._off.light * _direction(generator))

    def taken(self, episode: int, picture: Pixels, generator: np.random.Generator) -> Pixels:
        """A picture (P, P) of an episode as it comes out."""
        if not self.disturbs:
            return picture
        light = self.views[episode].light
        # Nowhere is more light than in the picture of even light: levels would be cut.
        side = (np.arange(len(picture)) + 0.5) / len(picture) - 0.5
        lit = light[0] * side - light[1] * side[:, None]
        levels = _blurred(picture * (1.0 + lit - lit.max()), self._off.blur)
        levels += self._off.noise * generator.standard_normal(levels.shape)
        return np.clip(np.round(levels), 0, 255).astype(np.uint8)


def _direction(generator: np.random.Generator) -> Floats:
    angle = generator.uniform(-np.pi, np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def _blurred(levels: Floats, deviation: float) -> Floats:
    """A picture (P, P) after a Gaussian; beyond its edges it goes on as it ends."""
    reach = int(np.ceil(_CUT * deviation))
    if not reach:
        return levels
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation) ** 2)
    weights /= weights.sum()
    for _ in range(2):
        wide = np.pad(levels, ((reach, reach), (0, 0)), mode="edge")
        rows = len(levels)
        levels = sum(w * wide[i : i + rows] for i, w in enumerate(weights.tolist())).T
    return levels
