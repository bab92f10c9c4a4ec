"""Settings of the simulated world and of the reward."""

from dataclasses import dataclass

from tangram_sim.checks import check_choice, check_range
from tangram_sim.errors import ConfigError

BACKENDS = ("physics", "kinematic")
REWARDS = ("overlap", "dense", "pose")
SOURCES = ("polygon", "camera")
# A step of Bullet is exact up to a turn of pi / 4 and turns too little beyond, so a half turn
# needs four.
MIN_SUBSTEPS = 4
# A fifth of the arena is a whole token: nothing is left to see beyond.
MAX_CORNER_NOISE = 0.2


@dataclass(frozen=True)
class SimConfig:
    """The world that tokens move in.

    Attributes:
        backend: physics (PyBullet) or kinematic (the exact rigid motion, no engine).
        arena: side of the square arena, in the units of the tokens.
        actions_per_token: actions after which a token counts as placed.
        substeps: simulation steps in one action of one second (physics only).
        damping: Bullet's linear and angular damping (physics only), whose own default is 0.04.
        inexact: allow damping and fewer than 4 substeps, with which tokens fall short of what
            they are told; for experiments on what an agent makes of that.
        corner_noise: standard deviation of the Gaussian noise on the corners that agents see, as a
            share of the arena; rewards and scores are those of the exact corners.
        camera: take the pictures and report Eq. 14 from them at every step.
        pixels: side of the camera's square picture.
        max_tries: random poses tried for a token before sampling gives up.
    """

    backend: str = "physics"
    arena: float = 2.0
    actions_per_token: int = 1
    substeps: int = 8
    damping: float = 0.0
    inexact: bool = False
    corner_noise: float = 0.0
    camera: bool = False
    pixels: int = 64
    max_tries: int = 1000

    def __post_init__(self) -> None:
        check_choice("sim.backend", self.backend, BACKENDS)
        check_range("sim.arena", self.arena, 1e-3, 1e3)
        check_range("sim.actions_per_token", self.actions_per_token, 1, 100)
        check_range("sim.corner_noise", self.corner_noise, 0.0, MAX_CORNER_NOISE)
        self._check_motion()
        check_range("sim.pixels", self.pixels, 16, 1024)
        check_range("sim.max_tries", self.max_tries, 1, 1_000_000)

    def _check_motion(self) -> None:
        check_range("sim.damping", self.damping, 0.0, 1.0)
        check_range("sim.substeps", self.substeps, 1 if self.inexact else MIN_SUBSTEPS, 1000)
        if self.damping > 0.0 and not self.inexact:
            raise ConfigError(
                f"sim.damping must be 0, got {self.damping}: tokens would stop short of what they "
                "are told; set sim.inexact=true for an experiment on that"
            )


@dataclass(frozen=True)
class RewardConfig:
    """What an action is worth.

    Attributes:
        name: overlap (Eq. 14), dense (Eq. 15), pose (corner distances modulo the symmetry), or
            `package.module:function` for one of the user's own.
        source: what Eq. 14 is measured on while playing: exact polygons or the camera's pictures.
        sharpness: dense and pose: how steep the logarithm is near the target; larger is steeper.
    """

    name: str = "overlap"
    source: str = "polygon"
    sharpness: float = 100.0

    def __post_init__(self) -> None:
        module, _, function = self.name.partition(":")
        if self.name not in REWARDS and not (module and function):
            raise ConfigError(
                f"reward.name must be one of {', '.join(REWARDS)} or package.module:function, "
                f"got '{self.name}'"
            )
        check_choice("reward.source", self.source, SOURCES)
        check_range("reward.sharpness", self.sharpness, 1e-6, 1e9)
        if self.source == "camera" and self.name != "overlap":
            raise ConfigError(
                f"reward.source=camera measures Eq. 14 only, got reward.name={self.name}: "
                "set reward.source=polygon"
            )
