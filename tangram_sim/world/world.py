"""One arena with K tokens, whatever moves them."""

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

    Both backends keep this contract; one test module holds them to it. A token is carried
    above the others and set down; with the engine, tokens that are set down in one place then push
    each other apart. Nothing stops one at the arena's edge.
    """

    def place(self, poses: Floats, flipped: Bools | None = None) -> None:
        """Put every token at rest at its pose: (K, 3) of x, y (arena units) and angle (rad).

        Args:
            poses: of the tokens.
            flipped: (K,) which lie on their other side, see `Layout.corners`, chiral ones only;
                None: none does.
        """

    def move(self, token: int, velocity: Floats, flip: bool = False) -> None:
        """Move one token for one second, and stop it.

        Args:
            token: its index.
            velocity: (3,) x, y in arena units a second; angular velocity about z in rad/s.
            flip: turn it over in the air, about its body's x axis, before it moves; a chiral one.
        """

    def poses(self) -> Floats:
        """(K, 3) x, y and angle in (-pi, pi]."""

    def flipped(self) -> Bools:
        """(K,) which tokens lie on their other side."""

    def picture(self) -> Pixels:
        """(P, P) grayscale picture of the tokens as they lie; see pictures.py."""

    def close(self) -> None:
        """Free what the world holds; calling it twice does no harm."""


def check_world(layout: Layout, sim: SimConfig) -> None:
    """Refuse a task that no world could play, without making one.

    Raises:
        SamplingError: see `check_room`.
        ConfigError: the engine or OpenCV is needed and not installed, or see `check_targets`.
    """
    check_room(layout, sim)
    if sim.backend == "physics" and find_spec("pybullet") is None:
        raise _no_engine("no module named 'pybullet'")
    if sim.looks and find_spec("cv2") is None:
        raise no_opencv("no module named 'cv2'")


def check_room(layout: Layout, sim: SimConfig) -> None:
    """Refuse a task whose tokens have no room, also where nothing is played.

    Raises:
        SamplingError: a token does not fit into the arena, or not all tokens do.
        ConfigError: see `check_targets`.
    """
    check_targets(layout, sim)
    generators = [np.random.default_rng(0)]
    sample_starts(layout, sim, sample_targets(layout, sim, generators), generators)


def check_shown(sim: SimConfig, outlines: bool) -> None:
    """Raise ConfigError, which says who takes silhouettes, for who knows nothing of outlines."""
    if sim.observe == "silhouette" and not outlines:
        raise ConfigError(
            "sim.observe=silhouette is for an agent of outlines: train one with task=fill "
            "agent=outline, or set sim.observe=corners; tangram-play silhouette= fills one"
        )


def make_world(layout: Layout, sim: SimConfig) -> World:
    """A world of the configured backend; ConfigError if the engine is not installed."""
    if sim.backend == "kinematic":
        return KinematicWorld(layout, sim)
    try:
        # Only here: the master and machines without an engine must never load it.
        from tangram_sim.world.physics import PhysicsWorld  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise _no_engine(str(error)) from error
    return PhysicsWorld(layout, sim)


def no_opencv(why: str) -> ConfigError:
    """What is raised where pictures are to be observed, and nothing can look at them."""
    return ConfigError(
        f"sim.observe=pictures needs OpenCV ({why}): install opencv-python-headless, or set "
        "sim.observe=corners"
    )


def _no_engine(why: str) -> ConfigError:
    return ConfigError(
        f"sim.backend=physics needs PyBullet ({why}): install pybullet, from Python 3.12 on "
        "pybullet-arm64, or set sim.backend=kinematic"
    )
