"""What every backend must do, and what the engine must not get wrong."""

import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from tangram_core.arrays import Floats
from tangram_core.errors import ConfigError, SamplingError
from tangram_sim.batch import BatchedEnv
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import area, clip, covered_share
from tangram_sim.rewards import TargetPictures
from tangram_sim.sight.pictures import BACKGROUND, TOKEN_GRAY, rasterise
from tangram_sim.targets.sampling import sample_batch
from tangram_sim.world import world as world_module
from tangram_sim.world.world import World, check_room, check_shown, check_world, make_world
from tests.sim.builders import LOPSIDED, SQUARE_SCALE, TRIO, angle_gap, layout_of, random_poses

pytestmark = pytest.mark.fast

WorldMaker = Callable[..., World]
ANGLES = (-180, -179.9, -150, -120, -90, -60, -45, -10, -1, 0, 0.5, 5, 30, 75, 135, 170, 179, 180)
VELOCITIES = ((0.0, 0.0), (1.0, 1.0), (-1.0, 0.3), (0.01, -0.02), (0.0, 1.0))  # widths a second


@pytest.fixture(params=["physics", "kinematic"])
def make(request: pytest.FixtureRequest) -> Iterator[WorldMaker]:
    worlds = []

    def maker(layout: Layout, **settings: Any) -> World:
        worlds.append(make_world(layout, SimConfig(backend=request.param, **settings)))
        return worlds[-1]

    yield maker
    for world in worlds:
        world.close()


def errors(world: World, arena: float) -> tuple[float, float]:
    """Largest error of position (arena widths) and angle (degrees) over a table of actions."""
    start = np.array([[0.2 * arena, -0.3 * arena, 0.7]])
    position, angle = 0.0, 0.0
    for x, y in VELOCITIES:
        for degrees in ANGLES:
            velocity = np.array([x * arena, y * arena, np.radians(degrees)])
            world.place(start)
            world.move(0, velocity)
            wanted, got = start[0] + velocity, world.poses()[0]
            position = max(position, float(np.abs(got - wanted)[:2].max()) / arena)
            angle = max(angle, float(np.degrees(angle_gap(got[2], wanted[2]))))
    return position, angle


@pytest.mark.parametrize(
    ("shape", "arena"),
    [
        ("small_triangle", 2.0),
        ("parallelogram", 2.0),
        (LOPSIDED, 2.0),
        ("square", 1e-3),  # the engine limits velocities: it must not see the arena's unit
        ("square", 1e3),
    ],
)
def test_commanded_pose_is_reached_in_every_unit(
    make: WorldMaker, shape: object, arena: float
) -> None:
    position, angle = errors(make(layout_of(shape, scale=0.15 * arena), arena=arena), arena)
    assert position < 1e-9
    assert angle < 1e-3


def test_poses_are_what_was_placed(make: WorldMaker) -> None:
    layout = layout_of(*TRIO)
    world = make(layout)
    for poses in random_poses(np.random.default_rng(0), 50, 3, 1.0):
        world.place(poses)
        np.testing.assert_allclose(world.poses(), poses, atol=1e-12)
        world.poses()[:] = 9.0  # a copy
        np.testing.assert_allclose(world.poses(), poses, atol=1e-12)


def test_angles_are_told_between_minus_pi_and_pi(make: WorldMaker) -> None:
    world = make(layout_of("square"))
    for turns in (-2, -1, 1, 2):
        world.place(np.array([[0.0, 0.0, 1.0 + 2.0 * np.pi * turns]]))
        assert world.poses()[0, 2] == pytest.approx(1.0)
    world.place(np.array([[0.0, 0.0, 3.0]]))
    world.move(0, np.array([0.0, 0.0, 1.0]))
    assert world.poses()[0, 2] == pytest.approx(4.0 - 2.0 * np.pi)


def test_only_the_named_token_moves_and_it_stops(make: WorldMaker) -> None:
    world = make(layout_of("square", "square", "small_triangle", scale=0.3))
    start = np.array([[0.0, 0.6, 0.0], [0.0, 0.0, 0.0], [0.0, -0.6, 0.0]])
    world.place(start)
    first, second = np.array([0.5, -0.25, 2.0]), np.array([-0.1, 0.2, -3.0])
    world.move(1, first)
    np.testing.assert_allclose(world.poses(), [start[0], first, start[2]], atol=1e-6)
    world.move(2, second)
    np.testing.assert_allclose(world.poses(), [start[0], first, start[2] + second], atol=1e-6)
    world.move(1, -first)
    np.testing.assert_allclose(world.poses(), [start[0], start[1], start[2] + second], atol=1e-6)


def test_placing_stops_and_forgets(make: WorldMaker) -> None:
    world = make(layout_of("square"))
    world.move(0, np.array([1.0, 1.0, 1.0]))
    world.place(np.array([[0.1, 0.2, 0.3]]))
    world.move(0, np.zeros(3))
    np.testing.assert_allclose(world.poses(), [[0.1, 0.2, 0.3]], atol=1e-12)


def test_nothing_stops_a_token_at_the_arenas_edge(make: WorldMaker) -> None:
    world = make(layout_of("square"), pixels=64)
    world.place(np.array([[0.8, 0.0, 0.0]]))
    world.move(0, np.array([2.0, 0.0, 0.0]))
    assert world.poses()[0, 0] == pytest.approx(2.8)
    assert (world.picture() == BACKGROUND).all()


def test_picture_of_a_token_in_the_upper_right(make: WorldMaker) -> None:
    """Its corners lie on borders of pixels: which pixels it covers can be counted."""
    world = make(layout_of("square"), pixels=20)  # a pixel is 0.1 wide, the square 4 pixels
    world.place(np.array([[0.6 + 1e-6, 0.3 + 1e-6, 0.0]]))
    picture = world.picture()
    expected = np.full((20, 20), BACKGROUND, dtype=np.uint8)
    expected[5:9, 14:18] = TOKEN_GRAY
    assert picture.dtype == np.uint8
    np.testing.assert_array_equal(picture, expected)


@pytest.mark.parametrize(
    ("pixels", "arena", "view"), [(16, 2.0, 1.0), (63, 2.0, 1.0), (64, 0.02, 1.0), (200, 0.02, 2.5)]
)
def test_pictures_show_pixel_centres(
    make: WorldMaker, pixels: int, arena: float, view: float
) -> None:
    """Pixel for pixel: half a pixel of shift would show, and so would a wrong field of view."""
    layout = layout_of(*TRIO, scale=0.4 * arena)
    world, wrong = make(layout, pixels=pixels, arena=arena, view=view), 0
    for poses in random_poses(np.random.default_rng(0), 25, 3, 0.5 * arena):
        world.place(poses)
        exact = rasterise(layout.corners(poses), layout, view * arena, pixels)
        wrong += int(np.count_nonzero(world.picture() != exact))
    # A pixel whose centre lies on an edge to rounding may fall on either side.
    assert wrong <= 10 * pixels / 64


def test_a_grey_pixel_is_as_dark_as_it_is_covered(make: WorldMaker) -> None:
    world = make(layout_of("square"), pixels=20, observe="pictures")  # a pixel is 0.1 wide
    world.place(np.array([[0.625 + 1e-6, 0.3 + 1e-6, 0.0]]))
    picture = world.picture().astype(int)
    covered = np.zeros((20, 20))
    covered[5:9, 14:19] = 0.75, 1.0, 1.0, 1.0, 0.25
    wanted = BACKGROUND - (BACKGROUND - TOKEN_GRAY) * covered
    assert np.abs(picture - wanted).max() <= 1


def perimeter(polygons: Floats) -> Floats:
    """(B,) of polygons (B, M, 2)."""
    edges = np.roll(polygons, -1, axis=1) - polygons
    return np.asarray(np.linalg.norm(edges, axis=-1).sum(axis=1))


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
    share = covered_share(tokens, targets, layout)
    bound: Floats = (common + share * whole) / (layout.areas.sum() - whole)
    return bound


def near_and_far(layout: Layout, sim: SimConfig, size: int) -> tuple[Floats, Floats]:
    """Targets, and states of which most lie upon them more or less; no tokens overlap."""
    rng = np.random.default_rng(0)
    targets = sample_batch(layout, sim, [rng] * size)
    states = targets + rng.normal(size=targets.shape) * [0.03, 0.03, 0.3]
    # A state whose tokens overlap would not be the sum of its pieces: one token moves alone.
    states[:, 1:] = targets[:, 1:]
    return targets, states


def errors_of_shares(layout: Layout, size: int, pixels: int) -> tuple[Floats, Floats]:
    """(B,) by how much shares of pixels exceed those of area, and how much they may."""
    sim = SimConfig(backend="kinematic", pixels=pixels)
    targets, states = near_and_far(layout, sim, size)
    world, shares = make_world(layout, sim), []
    for target, state in zip(targets, states, strict=True):
        world.place(target)
        wanted = TargetPictures(world.picture()[None])
        world.place(state)
        shares.append((wanted.rewards(world.picture()[None])[0] + 1.0) / 2.0)
    tokens, goals = layout.corners(states), layout.corners(targets)
    bound = camera_bound(layout, tokens, goals, sim.arena / pixels)
    return np.array(shares) - covered_share(tokens, goals, layout), bound


@pytest.mark.parametrize(
    ("shapes", "scale"),
    [(("square",), SQUARE_SCALE), (("small_triangle",), 1.6), (TRIO, 0.8)],
)
def test_camera_and_polygons_agree(shapes: tuple[str, ...], scale: float) -> None:
    """Eq. 14 of the pictures; that those of the engine are the same is tested above."""
    layout = layout_of(*shapes, scale=scale)
    errors, bound = errors_of_shares(layout, 300, 64)
    assert (np.abs(errors) <= bound).all()
    # The bound is for the worst pose; over many the errors all but cancel.
    assert np.abs(errors).mean() < 0.02
    assert abs(errors.mean()) < 0.003
    finer, _ = errors_of_shares(layout, 100, 128)
    coarser, _ = errors_of_shares(layout, 100, 32)
    assert np.abs(finer).mean() < np.abs(coarser).mean() / 2.5


def test_worlds_do_not_share_bodies_and_close_twice(make: WorldMaker) -> None:
    first, second = (make(layout_of("square")) for _ in range(2))
    first.move(0, np.array([0.5, 0.0, 0.0]))
    np.testing.assert_array_equal(second.poses(), np.zeros((1, 3)))
    first.close()
    second.move(0, np.array([0.0, 0.5, 0.0]))
    np.testing.assert_allclose(second.poses(), [[0.0, 0.5, 0.0]], atol=1e-12)


def test_a_token_that_does_not_fit_is_refused_before_a_world_is_made() -> None:
    check_world(layout_of("square"), SimConfig())
    with pytest.raises(SamplingError, match="does not fit into an arena of width 2"):
        check_world(layout_of("square", scale=10.0), SimConfig())
    with pytest.raises(SamplingError, match="no room for token .* beside .* others"):
        check_world(layout_of(*["square"] * 16, scale=1.8), SimConfig())


def test_targets_are_tried_before_a_world_is_made() -> None:
    layout = layout_of("square", "square", scale=2.0**0.5)
    with pytest.raises(SamplingError, match="no connected target within an arena of width 0.75"):
        check_world(layout, SimConfig(arena=0.75, targets="connected"))
    with pytest.raises(SamplingError, match="no room for token"):
        check_world(layout, SimConfig(arena=0.75))
    with pytest.raises(ConfigError, match="sim.targets=figures needs all seven tans"):
        check_world(layout, SimConfig(targets="figures"))


def test_a_missing_engine_is_named_also_before_a_world_is_made(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)
    for name in ("engine", "physics"):
        monkeypatch.delitem(sys.modules, f"tangram_sim.world.{name}", raising=False)
    with pytest.raises(ConfigError, match=r"set\s+sim\.backend=kinematic"):
        make_world(layout_of("square"), SimConfig())
    monkeypatch.setattr(world_module, "find_spec", lambda name: None)
    check_world(layout_of("square"), SimConfig(backend="kinematic"))
    with pytest.raises(ConfigError, match=r"needs PyBullet .*: install pybullet, from .*, or set"):
        check_world(layout_of("square"), SimConfig())
    seen = SimConfig(backend="kinematic", observe="pictures", pixels=64)
    check_room(layout_of("square"), seen)  # a master looks at nothing
    with pytest.raises(ConfigError, match=r"needs OpenCV .*: install opencv-.*, or set"):
        check_world(layout_of("square"), seen)


def test_silhouettes_are_shown_to_who_knows_outlines() -> None:
    """A master asks before it starts, an environment when it is made."""
    shown = SimConfig(backend="kinematic", observe="silhouette")
    reason = "^sim.observe=silhouette is for an agent of outlines: .*set sim.observe=corners"
    with pytest.raises(ConfigError, match=reason):
        check_shown(shown, outlines=False)
    with pytest.raises(ConfigError, match=reason):
        BatchedEnv(layout_of("square"), shown, RewardConfig(), 1)
    check_shown(shown, outlines=True)
