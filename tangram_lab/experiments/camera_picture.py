"""Fig. 3: the pictures that the camera of the simulation takes in one episode."""

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from tangram_lab.experiments.report.style import COLOURS, WIDTH_IN, empty_figure
from tangram_lab.experiments.scenes import FRAME, bare
from tangram_sim.actions import velocities
from tangram_sim.arrays import Floats, Pixels
from tangram_sim.config import SimConfig
from tangram_sim.errors import ConfigError
from tangram_sim.layout import TokensConfig, make_layout
from tangram_sim.pictures import token_pixels
from tangram_sim.rewards import TargetPictures
from tangram_sim.sampling import sample_poses
from tangram_sim.world import check_world, make_world
from worker.baselines import position_policy

TOKENS = TokensConfig(("square",), 1.131370849898476)  # tokens=square: side 0.4
PIXELS = 192
SEED = 5
TARGET, TOKEN, BOTH = (to_rgb(colour) for colour in (COLOURS[4], COLOURS[5], COLOURS[0]))


@dataclass(frozen=True, eq=False)
class Shots:
    """What the camera saw of one episode.

    Attributes:
        backend: the world that it was played in.
        target, start, end: grayscale pictures (P, P).
        reward: Eq. 14 of target and end, in [-1, 1].
    """

    backend: str
    target: Pixels
    start: Pixels
    end: Pixels
    reward: float


def draw_camera() -> tuple[Figure, str]:
    """The four panels of Fig. 3, and what they show."""
    shots = take_shots()
    figure = empty_figure(WIDTH_IN, WIDTH_IN * 0.28)
    panels = figure.subplots(1, 4)
    pictures = (shots.target, shots.start, shots.end)
    labels = ("(a) target", "(b) initial position", "(c) after action a")
    for panel, picture, label in zip(panels, pictures, labels, strict=False):
        _show(panel, np.repeat(picture[..., None], 3, axis=-1), label)
    _show(panels[3], _overlap(shots.target, shots.end), f"(d) overlap, r = {shots.reward:.3f}")
    return figure, _caption(shots)


def take_shots(backend: str = "physics") -> Shots:
    """One episode: its action moves the token exactly onto the target's centre, without a turn.

    That is what the paper's agents learn. Without the engine the kinematic world plays it, whose
    camera follows the same convention.
    """
    layout = make_layout(TOKENS)
    sim = SimConfig(backend=backend, camera=True, pixels=PIXELS)
    try:
        check_world(layout, sim)
    except ConfigError:
        return take_shots("kinematic")
    generator = np.random.default_rng(SEED)
    target, start = (sample_poses(layout, sim, generator) for _ in range(2))
    policy = position_policy(layout, sim)
    placed = np.zeros((1, 1), dtype=np.bool_)
    corners, goals = layout.corners(start)[None], layout.corners(target)[None]
    action = policy(corners, placed, goals, [generator])
    world = make_world(layout, sim)
    try:
        world.place(target)
        target_picture = world.picture()
        world.place(start)
        start_picture = world.picture()
        world.move(0, velocities(action.astype(np.float64), sim)[0])
        end_picture = world.picture()
    finally:
        world.close()
    reward = TargetPictures(target_picture[None]).rewards(end_picture[None])[0]
    return Shots(sim.backend, target_picture, start_picture, end_picture, reward)


def _overlap(target: Pixels, end: Pixels) -> Floats:
    """(P, P, 3) colours in [0, 1]: where target, token and both are."""
    wanted, covered = token_pixels(target), token_pixels(end)
    image = np.ones((*target.shape, 3))
    image[wanted] = TARGET
    image[covered] = TOKEN
    image[wanted & covered] = BOTH
    return image


def _show(panel: Axes, image: Pixels | Floats, label: str) -> None:
    bare(panel)
    panel.imshow(image, interpolation="nearest")
    panel.set_xlabel(label)
    for spine in panel.spines.values():
        spine.set_visible(True)
        spine.set_color(FRAME)


def _caption(shots: Shots) -> str:
    engine = (
        "PyBullet's camera"
        if shots.backend == "physics"
        else "the kinematic world's camera (PyBullet is not installed)"
    )
    raw = (shots.reward + 1.0) / 2.0
    return (
        f"Fig. 3: pictures of {PIXELS} x {PIXELS} pixels from {engine}: (a) the target, (b) the "
        "initial random position, (c) after an action a that meets the target's centre and does "
        "not turn, (d) target (amber), token (light blue) and what both cover (dark blue). "
        f"The share of the target's pixels that are covered is {raw:.3f}, so by Eq. 14, scaled to "
        f"[-1, 1], the reward is r = {shots.reward:.3f}."
    )
