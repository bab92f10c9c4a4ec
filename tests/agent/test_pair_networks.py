"""Actor and critic of pairs: what turning and mirroring a scene does to them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tangram_agent.pair_networks import PairNetworks
from tangram_agent.pairs import PairGraph

from tangram_agent.config import NetConfig
from tangram_agent.networks import initialise
from tests.agent.builders import SMALL
from tests.agent.pair_scenes import as_tensor, every_pair, random_pairs, random_scene, seven

pytestmark = pytest.mark.fast

LAYOUT = seven().layout
NETS = {"mha": NetConfig(**SMALL), "mlp": NetConfig("mlp", (16, 16))}
PARALLELOGRAM = 6


def networks(kind: str, contacts: bool = True, seed: int = 0) -> PairNetworks:
    made = PairNetworks(PairGraph(LAYOUT, 2.0), NETS[kind], contacts)
    initialise(made, torch.Generator().manual_seed(seed))
    return made.requires_grad_(False)


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
    near = made.actor(plain)[0].sub(plain.pose)[:, :2].norm(dim=-1) < 1.9
    pose, turned = made.actor(plain)[0], made.actor(image)[0]
    assert near.float().mean() > 0.9
    np.testing.assert_allclose(turned[near], as_tensor(moved(pose.numpy()))[near], atol=1e-4)
    np.testing.assert_allclose(made.critic(image), made.critic(plain), atol=1e-5)
    pushed = [made.critic.pushed(one, to) for one, to in ((plain, pose), (image, turned))]
    np.testing.assert_allclose(pushed[0][near], pushed[1][near], atol=1e-5)


@pytest.mark.parametrize("kind", NETS)
def test_a_token_on_its_other_side_does_what_its_mirror_image_does(kind: str) -> None:
    made, rng = networks(kind), np.random.default_rng(1)
    tokens, pieces = random_scene(LAYOUT, rng), random_scene(LAYOUT, rng)
    plain = every_pair(*tokens, *pieces)
    image = every_pair(*LAYOUT.mirrored(*tokens), *LAYOUT.mirrored(*pieces))
    pose, seen = made.actor(plain)[0], made.actor(image)[0]
    chiral = plain.token == PARALLELOGRAM
    expected = pose * torch.tensor([1.0, -1.0, -1.0])
    np.testing.assert_allclose(seen[chiral, :2], expected[chiral, :2], atol=1e-5)
    same_angles(seen[chiral, 2], expected[chiral, 2])
    np.testing.assert_allclose(made.critic(image)[chiral], made.critic(plain)[chiral], atol=1e-5)


@pytest.mark.parametrize("kind", NETS)
def test_an_actor_that_says_nothing_leaves_the_token_where_it_is(kind: str) -> None:
    made, pairs = networks(kind), random_pairs(LAYOUT, 0)
    for parameter in made.parameters():
        parameter.zero_()
    np.testing.assert_array_equal(made.actor(pairs)[0], pairs.pose)
    assert not made.critic(pairs).any()


@pytest.mark.parametrize("kind", NETS)
def test_a_shift_is_as_wide_as_the_arena_at_most(kind: str) -> None:
    made, pairs = networks(kind), random_pairs(LAYOUT, 0)
    for parameter in made.parameters():
        parameter.mul_(100.0)
    pose, raw = made.actor(pairs)
    assert raw.abs().max() > 10.0
    assert (pose - pairs.pose)[:, :2].abs().max() <= 2.0 + 1e-6


@pytest.mark.parametrize("kind", NETS)
def test_the_critic_knows_how_much_is_covered_and_which_side_it_is(kind: str) -> None:
    made, pairs = networks(kind), random_pairs(LAYOUT, 0)
    value = made.critic(pairs)
    other = made.critic(replace(pairs, covered=1.0 - pairs.covered))
    assert (value - other).abs().min() > 0.0
    flipped = made.critic(replace(pairs, goal_flipped=1.0 - pairs.goal_flipped))
    changed = (value - flipped).abs() > 0.0
    # Only a parallelogram has two sides.
    assert changed.tolist() == (pairs.piece == PARALLELOGRAM).tolist()


@pytest.mark.parametrize("kind", NETS)
def test_what_is_pushed_depends_on_where_the_token_slides(kind: str) -> None:
    pairs = random_pairs(LAYOUT, 0)
    here, there = pairs.pose, pairs.pose + 0.1
    made = networks(kind)
    assert (made.critic.pushed(pairs, here) - made.critic.pushed(pairs, there)).abs().min() > 0.0
    alone = networks(kind, contacts=False)
    assert not alone.critic.pushed(pairs, there).any()
    own = dict(alone.named_parameters())
    more = set(dict(made.named_parameters())) - set(own)
    assert {name.split(".")[1] for name in more} == {"push_head"}
