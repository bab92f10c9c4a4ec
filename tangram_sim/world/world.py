"""The interface of a world, checks of its settings, and the choice of its backend."""

from importlib.util import find_spec
from typing import Protocol

import numpy as np

from tangram_core.arrays import Bools, Floats, Pixels
from tangram_core.errors import ConfigError
from tangram_sim.config import SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.motion.kinematics import KinematicWorld
from tangram_sim.targets.targets import check_targets, sample_starts, sample_targets


class World(Protocol):
    """K tokens on the plane, in a square arena around the origin.

    Both backends keep this contract, and one test module checks both. A token is carried above the
    others and set down. With the engine, tokens that overlap then push each other apart. A token
    may leave the arena.
    """

    def place(self, poses: Floats, flipped: Bools | None = None) -> None:
        """Put every token at rest in a pose.

        Args:
            poses: (K, 3) x, y (arena units) and angle (rad) of the tokens.
            flipped: (K,) tokens that are turned over, chiral ones only, see `Layout.corners`; None:
                no token is.
        """

    def move(self, token: int, velocity: Floats, flip: bool = False) -> None:
        """Move one token for one second, and stop it.

        Args:
            token: its index.
            velocity: (3,) x, y in arena units per second; angular velocity about z in rad/s.
            flip: whether to turn it over about its body's x axis before it moves, if it is chiral.
        """

    def poses(self) -> Floats:
        """Poses (K, 3) of the tokens: x, y and angle in (-pi, pi]."""

    def flipped(self) -> Bools:
        """(K,) which tokens are turned over."""

    def picture(self) -> Pixels:
        """Grayscale picture (P, P) of the tokens; see pictures.py."""

    def close(self) -> None:
        """Free the resources of the world; further calls do nothing."""


def check_world(layout: Layout, sim: SimConfig) -> None:
    """Check that a world can play a task, without making a world.

    Raises:
        SamplingError: see `check_room`.
        ConfigError: the engine or OpenCV is needed but not installed; see also `check_targets`.
    """
    check_room(layout, sim)
    if sim.backend == "physics" and find_spec("pybullet") is None:
        raise _no_engine("no module named 'pybullet'")
    if sim.looks and find_spec("cv2") is None:
        raise no_opencv("no module named 'cv2'")


def check_room(layout: Layout, sim: SimConfig) -> None:
    """Check that the tokens have room in the arena; this needs neither engine nor OpenCV.

    Raises:
        SamplingError: a token does not fit into the arena, or not all tokens do together.
        ConfigError: see `check_targets`.
    """
    check_targets(layout, sim)
    generators = [np.random.default_rng(0)]
    sample_starts(layout, sim, sample_targets(layout, sim, generators), generators)


def check_shown(sim: SimConfig, outlines: bool) -> None:
    """Raise ConfigError for `sim.observe=silhouette` if the agent does not take outlines."""
    if sim.observe == "silhouette" and not outlines:
        raise ConfigError(
            "sim.observe=silhouette is for an agent of outlines: train one with task=fill "
            "agent=outline, or set sim.observe=corners; tangram-play silhouette=FILE fills one"
        )


def make_world(layout: Layout, sim: SimConfig) -> World:
    """A world of the configured backend; ConfigError if its engine is not installed."""
    if sim.backend == "kinematic":
        return KinematicWorld(layout, sim)
    try:
        # Imported here: the master and machines without an engine must never load it.
        from tangram_sim.world.physics import PhysicsWorld  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise _no_engine(str(error)) from error
    return PhysicsWorld(layout, sim)


def no_opencv(why: str) -> ConfigError:
    """The error for `sim.observe=pictures` without OpenCV; `why` is the reason in its text."""
    return ConfigError(
        f"sim.observe=pictures needs OpenCV ({why}): install opencv-python-headless, or set "
        "sim.observe=corners"
    )


def _no_engine(why: str) -> ConfigError:
    return ConfigError(
        f"sim.backend=physics needs PyBullet ({why}): install pybullet, from Python 3.12 on "
        "pybullet-arm64, or set sim.backend=kinematic"
    )
