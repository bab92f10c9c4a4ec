"""Actor and critic of pairs: what turning and mirroring a scene does to them."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tangram_agent.agents.pair.networks import Networks
from tangram_agent.agents.pair.pairs import Pairs
from tangram_agent.nets.networks import initialise
from tests.agent.agents.pair.pair_scenes import (
    PERCEPTRON,
    as_tensor,
    every_pair,
    random_pairs,
    random_scene,
    seven,
)
from tests.agent.builders import SMALL, setup

pytestmark = pytest.mark.fast

LAYOUT = seven().task.layout
NETS = {"mha": SMALL, "mlp": PERCEPTRON}
PARALLELOGRAM = 6


def networks(kind: str, seed: int = 0) -> Networks:
    made = Networks(LAYOUT, 2.0, seven(net=NETS[kind]).agent.net)
    initialise(made, torch.Generator().manual_seed(seed))
    return made.requires_grad_(False)


def pose_of(made: Networks, pairs: Pairs) -> torch.Tensor:
    """Where the actor puts the tokens of pairs."""
    moved: Pairs = made.critic.graph.moved(pairs, made.actor(pairs)[0])
    return moved.pose


def value_of(made: Networks, pairs: Pairs) -> torch.Tensor:
    """Values of pairs whose tokens stay where they are."""
    values: torch.Tensor = made.critic(pairs, torch.zeros(len(pairs.pose), 3))
    return values


def same_angles(found: torch.Tensor, expected: torch.Tensor) -> None:
    np.testing.assert_allclose(np.exp(1j * (found - expected).numpy()), 1.0, atol=1e-4)


@pytest.mark.parametrize("kind", NETS)
def test_proposals_turn_with_the_scene(kind: str) -> None:
    made, rng = networks(kind), np.random.default_rng(0)
    (own, sides), (goals, goal_sides) = random_scene(LAYOUT, rng), random_scene(LAYOUT, rng)
    angle, shift = 0.9, np.array([0.4, -0.3])
    spin = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])

    def moved(poses: np.ndarray) -> np.ndarray:
        return np.column_stack([poses[:, :2] @ spin + shift, poses[:, 2] + angle])

    plain = every_pair(own, sides, goals, goal_sides)
    image = every_pair(moved(own), sides, moved(goals), goal_sides)
    # The arena's bound on actions is a square, which does not turn with the scene.
    near = pose_of(made, plain).sub(plain.pose)[:, :2].norm(dim=-1) < 1.9
    pose, turned = pose_of(made, plain), pose_of(made, image)
    assert near.float().mean() > 0.9
    np.testing.assert_allclose(turned[near], as_tensor(moved(pose.numpy()))[near], atol=1e-4)
    np.testing.assert_allclose(value_of(made, image), value_of(made, plain), atol=1e-5)


@pytest.mark.parametrize("kind", NETS)
def test_a_token_on_its_other_side_does_what_its_mirror_image_does(kind: str) -> None:
    made, rng = networks(kind), np.random.default_rng(1)
    tokens, pieces = random_scene(LAYOUT, rng), random_scene(LAYOUT, rng)
    plain = every_pair(*tokens, *pieces)
    image = every_pair(*LAYOUT.mirrored(*tokens), *LAYOUT.mirrored(*pieces))
    pose, seen = pose_of(made, plain), pose_of(made, image)
    chiral = plain.token == PARALLELOGRAM
    expected = pose * torch.tensor([1.0, -1.0, -1.0])
    np.testing.assert_allclose(seen[chiral, :2], expected[chiral, :2], atol=1e-5)
    same_angles(seen[chiral, 2], expected[chiral, 2])
    values = [value_of(made, pairs)[chiral] for pairs in (image, plain)]
    np.testing.assert_allclose(*values, atol=1e-5)


@pytest.mark.parametrize("kind", NETS)
def test_a_token_stays_without_a_word_and_is_shifted_by_an_arena_at_most(kind: str) -> None:
    pairs = random_pairs(LAYOUT, 0)
    silent, loud = networks(kind), networks(kind)
    for parameter in silent.parameters():
        parameter.zero_()
    np.testing.assert_array_equal(pose_of(silent, pairs), pairs.pose)
    assert not value_of(silent, pairs).any()
    for parameter in loud.parameters():
        parameter.mul_(100.0)
    velocity, raw = loud.actor(pairs)
    assert raw.abs().max() > 10.0
    assert velocity.abs().max() <= 1.0
    assert (pose_of(loud, pairs) - pairs.pose)[:, :2].abs().max() <= 2.0 + 1e-6


@pytest.mark.parametrize("kind", NETS)
def test_the_critic_knows_how_much_is_covered_and_which_side_it_is(kind: str) -> None:
    made, pairs = networks(kind), random_pairs(LAYOUT, 0)
    value = value_of(made, pairs)
    other = value_of(made, replace(pairs, covered=1.0 - pairs.covered))
    assert (value - other).abs().min() > 0.0
    flipped = value_of(made, replace(pairs, goal_flipped=1.0 - pairs.goal_flipped))
    changed = (value - flipped).abs() > 0.0
    # Only a parallelogram has two sides.
    assert changed.tolist() == (pairs.piece == PARALLELOGRAM).tolist()


def test_a_turn_of_pairs_is_atan2_over_k() -> None:
    layout = setup().task.layout
    made = Networks(layout, 2.0, setup().agent.net)
    pairs = random_pairs(layout, 0)
    velocity, raw = made.actor(pairs)
    outputs = made.actor.head(pairs)
    assert torch.equal(raw, outputs[:, :2])  # the turn has no bound to run into
    expected = torch.atan2(outputs[:, 3], outputs[:, 2]) / 4 / math.pi
    torch.testing.assert_close(velocity[:, 2], expected)
