"""Tokens that are set down: what gives way, by how much, and what stays where it is."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pybullet
import pytest

from tangram_core.arrays import Floats
from tangram_sim.batch import BatchedEnv
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.motion.actions import corner_bound
from tangram_sim.world.physics import PhysicsWorld
from tests.sim.builders import (
    SEVEN,
    angle_gap,
    evaluation_generators,
    largest_overlap,
    layout_of,
    sample_poses,
)

pytestmark = pytest.mark.fast

PAIR = layout_of("square", "square")  # sides of 0.4
TRIPLE = layout_of("square", "square", "square")
GAME = layout_of(*SEVEN, scale=0.6)
MOST = 1e-5  # of area that two settled tokens share


Make = Callable[..., PhysicsWorld]


@pytest.fixture
def make() -> Iterator[Make]:
    made: list[PhysicsWorld] = []

    def maker(layout: Layout) -> PhysicsWorld:
        made.append(PhysicsWorld(layout, SimConfig()))
        return made[-1]

    yield maker
    for world in made:
        world.close()


def check_at_rest(world: PhysicsWorld) -> None:
    """No body moves, and each lies flat on the table."""
    for body in world._bodies:
        (_, _, height), turn = pybullet.getBasePositionAndOrientation(body, world.client)
        assert np.abs([height, *turn[:2]]).max() < 1e-5
        assert not np.any(pybullet.getBaseVelocity(body, world.client))


def set_down(
    world: PhysicsWorld, layout: Layout, still: Sequence[float], pose: Sequence[float]
) -> Floats:
    """Carry token 1 from afar to a pose, token 0 lies at another; the poses afterwards."""
    start = np.array([still, (0.9, 0.9, 0.0)])
    world.place(start)
    world.move(1, np.array(pose) - start[1])
    assert largest_overlap(layout, world.poses()) < MOST
    return world.poses()


@pytest.mark.parametrize(
    ("still", "pose"),
    [
        ((-0.2, 0.0, 0.0), (0.2, 0.0, 0.0)),  # edge to edge
        ((-0.2, 0.0, 0.0), (0.2, 0.13, 0.0)),  # along a part of the edge
        ((-0.2, -0.2, 0.0), (0.2, 0.2, 0.0)),  # corner to corner
        ((-0.2, 0.0, np.pi / 2.0), (0.2, 0.0, np.pi)),
    ],
)
def test_tokens_that_only_touch_stay(
    make: Make, still: Sequence[float], pose: Sequence[float]
) -> None:
    poses = set_down(make(PAIR), PAIR, still, pose)
    np.testing.assert_allclose(poses[:, :2], [still[:2], pose[:2]], atol=1e-9)
    assert angle_gap(poses[:, 2], np.array([still[2], pose[2]])).max() < 1e-9


@pytest.mark.parametrize("width", [1, 2**0.5 / 4])
def test_the_heavier_token_moves_less(make: Make, width: float) -> None:
    corners = [[0, 0], [width, 0], [width, width], [0, width]]
    layout = layout_of("square", {"name": "other", "corners": corners})
    ratio, half = layout.areas[1] / layout.areas[0], np.sqrt(layout.areas).sum() / 2.0
    poses = set_down(make(layout), layout, (0.0, 0.0, 0.0), (half - 0.05, 0.0, 0.0))
    light, heavy = -poses[0, 0], poses[1, 0] - (half - 0.05)
    assert light + heavy == pytest.approx(0.05, abs=1e-3)
    assert light / heavy == pytest.approx(ratio, rel=1e-2)
    assert np.abs(poses[:, 1:]).max() < 0.01


def placements(layout: Layout, count: int, share: float) -> Iterator[tuple[Floats, int, Floats]]:
    """Layouts, and for each a token and a way that sets it down near another one."""
    rng, sim = np.random.default_rng(0), SimConfig()
    reach = share * np.sqrt(layout.shapes[0].area)
    for _ in range(count):
        poses = sample_poses(layout, sim, rng)
        token, other = rng.permutation(layout.tokens)[:2]
        way = poses[other] - poses[token] + rng.uniform(-1.0, 1.0, 3) * [reach, reach, 3.0]
        way[2] = np.angle(np.exp(1j * way[2]))
        yield poses, int(token), way


@pytest.mark.parametrize("scale", [0.6, 0.1])
def test_no_overlap_is_missed_and_nothing_tips_over(make: Make, scale: float) -> None:
    """Whatever is set down on what: all end apart, upright, at rest, and not far away."""
    layout = layout_of(*SEVEN, scale=scale)
    world = make(layout)
    size = layout.shapes[0].radius
    for poses, token, way in placements(layout, 60, 0.8):
        world.place(poses)
        world.move(token, way)
        after, wanted = world.poses(), poses.copy()
        wanted[token] += way
        assert largest_overlap(layout, after) < MOST
        check_at_rest(world)
        assert np.abs(after - wanted)[:, :2].max() < size


def test_what_does_not_meet_does_not_move(make: Make) -> None:
    world = make(GAME)
    for poses, token, way in placements(GAME, 40, 2.0):
        wanted = poses.copy()
        wanted[token] += way
        if largest_overlap(GAME, wanted) > 0.0:
            continue
        world.place(poses)
        world.move(token, way)
        np.testing.assert_allclose(world.poses()[:, :2], wanted[:, :2], atol=1e-9)


def test_settled_tokens_do_not_creep(make: Make) -> None:
    """While others are carried: what is left of a settled overlap pushes no one any further."""
    world = make(TRIPLE)
    world.place(np.array([[-0.2, 0.0, 0.0], [0.9, 0.9, 0.0], [0.0, 0.7, 0.0]]))
    world.move(1, np.array([-0.73, -0.85, 0.1]))
    before = world.poses()
    for sign in (1.0, -1.0) * 10:
        world.move(2, np.array([0.1 * sign, 0.0, 0.0]))
    np.testing.assert_allclose(world.poses(), before, atol=1e-9)


def test_settling_ends_soon(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each step removes half of an overlap: to a hundred-thousandth in less than thirty."""
    steps, play = list[int](), pybullet.stepSimulation

    def counted(**settings: Any) -> None:
        steps.append(1)
        play(**settings)

    monkeypatch.setattr(pybullet, "stepSimulation", counted)
    set_down(make(PAIR), PAIR, (-0.175, 0.0, 0.0), (0.175, 0.02, 0.3))
    assert 2 < len(steps) < 30


def test_contacts_of_an_episode_end_with_it(make: Make) -> None:
    """The same two side by side again, but the other way round: what touched is now far apart."""
    world = make(layout_of("square", "square", "small_triangle"))
    world.place(np.array([[-0.3, 0, 0], [0.2, 0, 0], [0, 0.8, 0]]))
    world.move(0, np.array([0.15, 0.0, 0.0]))
    after = np.array([[0.205, 0, 0], [-0.205, 0, 0], [0, 0.8, 0]])
    world.place(after)
    world.move(2, np.array([0.1, 0.0, 0.0]))
    np.testing.assert_allclose(world.poses()[:2], after[:2], atol=1e-9)


def test_an_episode_ends_apart_and_no_corner_leaves_the_bound() -> None:
    sim, rng = SimConfig(starts="outside"), np.random.default_rng(0)
    env = BatchedEnv(GAME, sim, RewardConfig(), 6)
    env.reset(evaluation_generators(6))
    for token in range(env.horizon):
        actions = rng.uniform(-0.4, 0.4, (6, 4))
        actions[:, 0] = (token + 0.5) / 3.5 - 1.0
        env.step(actions)
        assert np.abs(env.corners).max() <= corner_bound(7, sim)
    assert max(largest_overlap(GAME, poses) for poses in GAME.poses(env.corners)) < MOST
    env.close()
