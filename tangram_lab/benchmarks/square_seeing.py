"""What simpler ways of seeing come to on a single square: its score after one exact action.

Legend: P pixels along a side of a picture, B scenes.
"""

from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import cv2
import numpy as np

from tangram_sim.arrays import Floats, Pixels
from tangram_sim.config import SimConfig
from tangram_sim.layout import Layout, TokensConfig, make_layout
from tangram_sim.lens import Lens
from tangram_sim.rewards import overlap
from tangram_sim.sampling import sample_poses
from tangram_sim.world import make_world
from tangram_vision.levels import coverage
from tangram_vision.seeing import see

Way = Callable[[Pixels], Floats]  # a picture (P, P) -> x, y and turn of the square


def square_rows(scale: float, sim: SimConfig, scenes: int, seed: int) -> Iterator[dict[str, Any]]:
    """A row for each way to see: errors of the pose, and the mean reward of going where it says.

    The action is the difference of the poses seen of the target and of the token, and it is carried
    out exactly: what is lost is lost by seeing.
    """
    layout = make_layout(TokensConfig(("square",), scale))
    ways: dict[str, Way] = {
        "the fit (`see`)": lambda picture: see(picture, layout, sim.arena).poses[0],
        "moments": lambda picture: moments(picture, sim.arena),
        "cv2.minAreaRect": lambda picture: least_rectangle(picture, sim.arena),
    }
    starts, targets, pictures = _scenes(layout, sim, scenes, seed)
    for name, way in ways.items():
        seen = np.array([[way(picture) for picture in pair] for pair in pictures])  # (B, 2, 3)
        ends = starts + seen[:, 1] - seen[:, 0]
        rewards = overlap(layout.corners(ends[:, None]), layout.corners(targets[:, None]), layout)
        off = seen - np.stack([starts, targets], axis=1)
        far = np.hypot(off[..., 0], off[..., 1])
        turned = np.degrees(np.abs((off[..., 2] + np.pi / 4.0) % (np.pi / 2.0) - np.pi / 4.0))
        yield {
            "way": name,
            "pictures": f"{sim.pixels} {sim.picture}",
            "scenes": scenes,
            "mean reward": float(rewards.mean()),
            "position, median": float(np.median(far)),
            "angle (°), median": float(np.median(turned)),
            "95th perc. (°)": float(np.percentile(turned, 95)),
        }


def moments(picture: Pixels, arena: float) -> Floats:
    """The square's pose by its centre and by the phase of its fourth moment."""
    cover = coverage(picture)
    assert cover is not None
    weight = np.where(cover > 0.1, cover, 0.0)
    z = _places(len(picture), arena)
    centre = (weight * z).sum() / weight.sum()
    fourth = (weight * (z - centre) ** 4).sum()
    return np.array([centre.real, centre.imag, np.angle(-fourth) / 4.0])


def least_rectangle(picture: Pixels, arena: float) -> Floats:
    """The square's pose as the least rectangle around the pixels that are covered by half."""
    cover = coverage(picture)
    assert cover is not None
    rows, columns = np.nonzero(cover > 0.5)
    (x, y), _, degrees = cv2.minAreaRect(np.column_stack([columns, rows]).astype(np.float32))
    width, middle = arena / len(picture), (len(picture) - 1) / 2.0
    return np.array([(x - middle) * width, (middle - y) * width, -np.radians(degrees)])


def _places(pixels: int, arena: float) -> Any:
    """(P, P) centres of pixels as x + iy, arena units."""
    middle = (pixels - 1) / 2.0
    columns, rows = np.meshgrid(np.arange(pixels) - middle, middle - np.arange(pixels))
    return (columns + 1j * rows) * (arena / pixels)


def _scenes(
    layout: Layout, sim: SimConfig, scenes: int, seed: int
) -> tuple[Floats, Floats, list[tuple[Pixels, Pixels]]]:
    """Poses of tokens and targets, (B, 3) each, and the pictures of both."""
    poses, pictures = np.empty((scenes, 2, 3)), []
    with closing(make_world(layout, sim)) as world:
        for number in range(scenes):
            generator = np.random.default_rng([seed, number])
            lens = Lens(sim)
            lens.begin([generator])
            pair = []
            for which in range(2):
                own = sample_poses(layout, sim, generator)
                poses[number, which] = own[0]
                world.place(own)
                pair.append(lens.taken(0, world.picture(), generator))
            pictures.append((pair[0], pair[1]))
    return poses[:, 0], poses[:, 1], pictures
