"""Eq. 14 from the camera against exact polygons, over thousands of poses."""

import numpy as np
import pytest

from tangram_sim.arrays import Floats
from tangram_sim.config import SimConfig
from tangram_sim.geometry import area, clip, overlap_share
from tangram_sim.layout import Layout
from tangram_sim.pictures import BACKGROUND, TOKEN_GRAY, token_pixels
from tangram_sim.rewards import TargetPictures
from tangram_sim.sampling import sample_batch
from tangram_sim.world import make_world
from tests.sim.builders import SQUARE_SCALE, TRIO, layout_of, perimeter, total_area

pytestmark = pytest.mark.fast


def camera_bound(layout: Layout, tokens: Floats, targets: Floats, pixel: float) -> Floats:
    """(B,) how far the share of pixels may be from the share of area, whatever the pose.

    A convex piece of area a and perimeter l holds n pixel centres with |n p^2 - a| <= l p / 2 +
    p^2 (Nosarzewska). Summed over the pieces, with e the error of the common area, f that of the
    target's area t and s the share: |(s t + e) / (t + f) - s| <= (|e| + s |f|) / (t - |f|).
    """
    common, whole = np.zeros(len(tokens)), np.zeros(len(tokens))
    for j in range(layout.tokens):
        target = targets[:, layout.corners_of(j)]
        whole += perimeter(target) * pixel / 2.0 + pixel**2
        for k in range(layout.tokens):
            piece = clip(target, tokens[:, layout.corners_of(k)])
            common += (perimeter(piece) * pixel / 2.0 + pixel**2) * (area(piece) > 0.0)
    share = overlap_share(tokens, targets, layout)
    bound: Floats = (common + share * whole) / (total_area(layout) - whole)
    return bound


def near_and_far(layout: Layout, sim: SimConfig, size: int) -> tuple[Floats, Floats]:
    """Targets, and states of which most lie upon them more or less; no tokens overlap."""
    rng = np.random.default_rng(0)
    targets = sample_batch(layout, sim, [rng] * size)
    states = targets + rng.normal(size=targets.shape) * [0.03, 0.03, 0.3]
    # A state whose tokens overlap would not be the sum of its pieces: one token moves alone.
    states[:, 1:] = targets[:, 1:]
    return targets, states


def camera_shares(sim: SimConfig, layout: Layout, targets: Floats, states: Floats) -> Floats:
    """(B,) shares of the targets' pixels that the states cover."""
    world, shares = make_world(layout, sim), []
    for target, state in zip(targets, states, strict=True):
        world.place(target)
        wanted = TargetPictures(world.picture()[None])
        world.place(state)
        shares.append((wanted.rewards(world.picture()[None])[0] + 1.0) / 2.0)
    world.close()
    return np.array(shares)


@pytest.mark.parametrize("backend", ["physics", "kinematic"])
@pytest.mark.parametrize(
    ("shapes", "scale", "size"),
    [
        (("square",), SQUARE_SCALE, 700),
        (("small_triangle",), 1.6, 700),
        (("parallelogram",), SQUARE_SCALE, 700),
        (TRIO, 0.8, 300),
    ],
)
def test_camera_and_polygons_agree(
    backend: str, shapes: tuple[str, ...], scale: float, size: int
) -> None:
    layout = layout_of(*shapes, scale=scale)
    sim = SimConfig(backend=backend, pixels=64)
    targets, states = near_and_far(layout, sim, size)
    camera = camera_shares(sim, layout, targets, states)
    tokens, goals = layout.corners(states), layout.corners(targets)
    error = camera - overlap_share(tokens, goals, layout)
    bound = camera_bound(layout, tokens, goals, sim.arena / sim.pixels)
    assert (np.abs(error) <= bound).all()
    # The bound is for the worst pose; over many the errors all but cancel.
    assert np.abs(error).mean() < 0.02
    assert abs(error.mean()) < 0.003


def test_finer_pictures_are_closer() -> None:
    layout = layout_of("square")
    mean_errors = []
    for pixels in (32, 128):
        sim = SimConfig(pixels=pixels)
        targets, states = near_and_far(layout, sim, 100)
        exact = overlap_share(layout.corners(states), layout.corners(targets), layout)
        mean_errors.append(np.abs(camera_shares(sim, layout, targets, states) - exact).mean())
    assert mean_errors[1] < mean_errors[0] / 2.5


def test_token_pixels_are_all_but_the_background() -> None:
    picture = np.array([[BACKGROUND, TOKEN_GRAY], [0, BACKGROUND]], dtype=np.uint8)
    assert token_pixels(picture).tolist() == [[False, True], [True, False]]
