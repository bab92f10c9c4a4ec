"""What comes between the tokens and a picture of them: where the camera stands, light, blur, noise.

Legend: B environments, P pixels along a side.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tangram_sim.arrays import Floats, Pixels
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


class Lens:
    """The disturbances of `SimConfig`; without any, nothing is drawn and pictures stay as they are.

    Attributes:
        moves: whether the camera does not always stand where it should.
        disturbs: whether anything is other than it should be.
        views: B, how the episodes are seen.
    """

    def __init__(self, sim: SimConfig) -> None:
        self._sim = sim
        self.views: list[View] = []
        self.moves = bool(sim.camera_turn or sim.camera_shift)
        self.disturbs = self.moves or bool(
            sim.picture_noise or sim.picture_blur or sim.light_gradient
        )

    def begin(self, generators: Generators) -> list[View]:
        """Draw how each of B episodes is seen."""
        self.views = [self._view(generator) for generator in generators]
        return self.views

    def stand(self, views: Sequence[View]) -> list[View]:
        """See B episodes as something was seen before."""
        self.views = list(views)
        return self.views

    def _view(self, generator: np.random.Generator) -> View:
        sim = self._sim
        way = _direction(generator) if sim.camera_shift else np.zeros(2)
        x, y = way * sim.camera_shift * sim.arena / sim.pixels if sim.pixels else way
        turn = np.radians(sim.camera_turn) * generator.choice((-1, 1)) if sim.camera_turn else 0.0
        light = sim.light_gradient * _direction(generator) if sim.light_gradient else np.zeros(2)
        return View(float(x), float(y), float(turn), light)

    def taken(self, episode: int, picture: Pixels, generator: np.random.Generator) -> Pixels:
        """A picture (P, P) of an episode as it comes out."""
        sim, light = self._sim, self.views[episode].light
        if not (light.any() or sim.picture_blur or sim.picture_noise):
            return picture
        levels = picture.astype(np.float64)
        if light.any():
            # Nowhere is more light than in the picture of even light: levels would be cut.
            side = (np.arange(len(picture)) + 0.5) / len(picture) - 0.5
            lit = light[0] * side - light[1] * side[:, None]
            levels *= 1.0 + lit - lit.max()
        if sim.picture_blur:
            levels = _blurred(levels, sim.picture_blur)
        if sim.picture_noise:
            levels += sim.picture_noise * generator.standard_normal(levels.shape)
        return np.clip(np.round(levels), 0, 255).astype(np.uint8)


def _direction(generator: np.random.Generator) -> Floats:
    angle = generator.uniform(-np.pi, np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def _blurred(levels: Floats, deviation: float) -> Floats:
    """A picture (P, P) after a Gaussian; beyond its edges it goes on as it ends."""
    reach = int(np.ceil(_CUT * deviation))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation) ** 2)
    weights /= weights.sum()
    for _ in range(2):
        wide = np.pad(levels, ((reach, reach), (0, 0)), mode="edge")
        rows = len(levels)
        levels = sum(w * wide[i : i + rows] for i, w in enumerate(weights.tolist())).T
    return levels
