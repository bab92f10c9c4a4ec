"""Tokens that are lifted and set down: what gives way, by how much, and what stays where it is."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pybullet
import pytest

from tangram_sim.arrays import Floats
from tangram_sim.config import SimConfig
from tangram_sim.layout import Layout
from tangram_sim.physics import PhysicsWorld
from tangram_sim.sampling import sample_poses
from tests.sim.builders import SEVEN, SQUARE_SCALE, angle_gap, largest_overlap, layout_of

pytestmark = pytest.mark.fast

PAIR = layout_of("square", "square")  # sides of 0.4
GAME = layout_of(*SEVEN, scale=0.6)
MOST = 1e-5  # of area that two settled tokens share


@pytest.fixture
def worlds() -> Iterator[list[PhysicsWorld]]:
    made: list[PhysicsWorld] = []
    yield made
    for world in made:
        world.close()


def make(worlds: list[PhysicsWorld], layout: Layout, **settings: Any) -> PhysicsWorld:
    worlds.append(PhysicsWorld(layout, SimConfig(**settings)))
    return worlds[-1]


def tilt(world: PhysicsWorld) -> float:
    """How far a body is from the table or from upright, at most."""
    found = 0.0
    for body in world._bodies:
        (_, _, height), turn = pybullet.getBasePositionAndOrientation(
            body, physicsClientId=world._client
        )
        found = max(found, abs(height), abs(turn[0]), abs(turn[1]))
    return found


def speed(world: PhysicsWorld) -> float:
    velocities = [
        pybullet.getBaseVelocity(body, physicsClientId=world._client) for body in world._bodies
    ]
    return float(np.abs(velocities).max())


def set_down(
    world: PhysicsWorld, layout: Layout, still: Sequence[float], pose: Sequence[float]
) -> Floats:
    """Carry token 1 from afar to a pose, token 0 lies at another; the poses afterwards."""
    start = np.array([still, (0.9, 0.9, 0.0)])
    world.place(start)
    world.move(1, np.array(pose) - start[1])
    assert largest_overlap(layout, world.poses()) < MOST
    return world.poses()


def test_a_lifted_token_passes_over_others(worlds: list[PhysicsWorld]) -> None:
    world = make(worlds, layout_of("square", "square", "small_triangle", scale=0.4))
    start = np.array([[-0.8, 0.0, 0.0], [0.0, 0.0, 0.5], [0.1, 0.4, 0.2]])
    world.place(start)
    world.move(0, np.array([1.6, 0.0, 2.0]))
    expected = start.copy()
    expected[0] = [0.8, 0.0, 2.0]
    np.testing.assert_allclose(world.poses(), expected, atol=1e-9)


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
    worlds: list[PhysicsWorld], still: Sequence[float], pose: Sequence[float]
) -> None:
    poses = set_down(make(worlds, PAIR), PAIR, still, pose)
    np.testing.assert_allclose(poses[:, :2], [still[:2], pose[:2]], atol=1e-9)
    assert angle_gap(poses[:, 2], np.array([still[2], pose[2]])).max() < 1e-9


def test_equal_tokens_give_way_alike(worlds: list[PhysicsWorld]) -> None:
    poses = set_down(make(worlds, PAIR), PAIR, (-0.175, 0.0, 0.0), (0.175, 0.0, 0.0))
    np.testing.assert_allclose(poses[0, :2], -poses[1, :2], atol=1e-6)
    assert poses[1, 0] == pytest.approx(0.2, abs=1e-3)
    assert np.abs(poses[:, 1:]).max() < 0.01


def test_the_heavier_token_moves_less(worlds: list[PhysicsWorld]) -> None:
    layout = layout_of("square", {"name": "wide", "corners": [[0, 0], [1, 0], [1, 1], [0, 1]]})
    ratio = layout.shapes[1].area / layout.shapes[0].area
    half = (0.4 + layout.shapes[1].area ** 0.5) / 2.0
    poses = set_down(make(worlds, layout), layout, (0.0, 0.0, 0.0), (half - 0.05, 0.0, 0.0))
    light, heavy = -poses[0, 0], poses[1, 0] - (half - 0.05)
    assert light + heavy == pytest.approx(0.05, abs=1e-3)
    assert light / heavy == pytest.approx(ratio, rel=1e-2)


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
def test_no_overlap_is_missed_and_nothing_tips_over(
    worlds: list[PhysicsWorld], scale: float
) -> None:
    """Whatever is set down on what: all end apart, upright, at rest, and not far away."""
    layout = layout_of(*SEVEN, scale=scale)
    world = make(worlds, layout)
    size = layout.shapes[0].radius
    for poses, token, way in placements(layout, 100, 0.8):
        world.place(poses)
        world.move(token, way)
        after, wanted = world.poses(), poses.copy()
        wanted[token] += way
        assert largest_overlap(layout, after) < MOST
        assert tilt(world) < 1e-5
        assert speed(world) == 0.0
        assert np.abs(after - wanted)[:, :2].max() < size


def test_what_does_not_meet_does_not_move(worlds: list[PhysicsWorld]) -> None:
    world = make(worlds, GAME)
    for poses, token, way in placements(GAME, 40, 2.0):
        wanted = poses.copy()
        wanted[token] += way
        if largest_overlap(GAME, wanted) > 0.0:
            continue
        world.place(poses)
        world.move(token, way)
        np.testing.assert_allclose(world.poses()[:, :2], wanted[:, :2], atol=1e-9)


@pytest.mark.parametrize("motion", ["lift", "slide"])
def test_an_episode_knows_nothing_of_those_before(worlds: list[PhysicsWorld], motion: str) -> None:
    """The engine keeps contacts of tokens that were put elsewhere: they threw others away."""
    used = make(worlds, GAME, motion=motion)
    for poses, token, way in placements(GAME, 25, 1.0):
        fresh = make(worlds, GAME, motion=motion)
        for world in (used, fresh):
            world.place(poses)
            world.move(token, way)
        np.testing.assert_array_equal(used.poses(), fresh.poses())
        fresh.close()


def test_settled_tokens_do_not_creep(worlds: list[PhysicsWorld]) -> None:
    """While others are carried: what is left of a settled overlap pushes no one any further."""
    layout = layout_of("square", "square", "square")
    world = make(worlds, layout)
    world.place(np.array([[-0.2, 0.0, 0.0], [0.9, 0.9, 0.0], [0.0, 0.7, 0.0]]))
    world.move(1, np.array([-0.73, -0.85, 0.1]))
    before = world.poses()
    for sign in (1.0, -1.0) * 10:
        world.move(2, np.array([0.1 * sign, 0.0, 0.0]))
    np.testing.assert_allclose(world.poses(), before, atol=1e-9)


def test_settling_ends_soon(worlds: list[PhysicsWorld], monkeypatch: pytest.MonkeyPatch) -> None:
    """Each step removes half of an overlap: to a hundred-thousandth in less than thirty."""
    steps, play = list[int](), pybullet.stepSimulation

    def counted(**settings: Any) -> None:
        steps.append(1)
        play(**settings)

    monkeypatch.setattr(pybullet, "stepSimulation", counted)
    set_down(make(worlds, PAIR), PAIR, (-0.175, 0.0, 0.0), (0.175, 0.02, 0.3))
    assert 2 < len(steps) < 30


@pytest.mark.parametrize("motion", ["lift", "slide"])
def test_contacts_of_an_episode_end_with_it(worlds: list[PhysicsWorld], motion: str) -> None:
    """The same two side by side again, but the other way round: what touched is now far apart."""
    layout = layout_of("square", "square", "small_triangle", scale=SQUARE_SCALE)
    world = make(worlds, layout, motion=motion)
    world.place(np.array([[-0.3, 0, 0], [0.2, 0, 0], [0, 0.8, 0]]))
    world.move(0, np.array([0.15, 0.0, 0.0]))
    after = np.array([[0.205, 0, 0], [-0.205, 0, 0], [0, 0.8, 0]])
    world.place(after)
    world.move(2, np.array([0.1, 0.0, 0.0]))
    np.testing.assert_allclose(world.poses()[:2], after[:2], atol=1e-9)
