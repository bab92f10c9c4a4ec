"""Choosing among pairs: against brute force, and with networks that know the geometry exactly."""

from contextlib import closing
from itertools import product
from typing import Any, cast

import numpy as np
import pytest
import torch

from tangram_agent.agents.pair import planning
from tangram_agent.agents.pair.actor import Decision
from tangram_agent.agents.pair.coverage import covered_share, covering
from tangram_agent.agents.pair.networks import Networks
from tangram_agent.agents.pair.pairs import PairGraph, Pairs
from tangram_agent.agents.pair.planning import Planner
from tangram_agent.base.types import Choice
from tangram_agent.nets.networks import initialise
from tangram_core.arrays import Bools, Floats
from tangram_core.setup import Setup
from tangram_sim.batch import BatchedEnv
from tangram_sim.motion.actions import velocities_of
from tests.agent.agents.pair.pair_scenes import (
    PERCEPTRON,
    TWO,
    PerfectCritic,
    PerfectNetworks,
    as_tensor,
    random_scene,
    seven,
)
from tests.agent.builders import SMALL, Policy, setup

pytestmark = pytest.mark.fast

COUNT = 6


def scenes(made: Setup, count: int = COUNT, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Corners, placed and goals of random scenes; every one has a token left."""
    rng = np.random.default_rng(seed)
    layout = made.task.layout
    corners, goals = (layout.corners(*random_scene(layout, rng, count)) for _ in range(2))
    placed = rng.random((count, layout.tokens)) < 0.5
    placed[:, 0] &= ~placed.all(axis=1)
    return corners, placed, goals


def random_networks(made: Setup, seed: int = 0) -> Networks:
    networks = Networks(made.task.layout, made.task.sim.arena, made.agent.net)
    initialise(networks, torch.Generator().manual_seed(seed))
    return networks.requires_grad_(False)


def perfect(made: Setup) -> Planner:
    graph = PairGraph(made.task.layout, made.task.sim.arena)
    networks = PerfectNetworks(PerfectCritic(made.task.layout), graph)
    return planner(cast("Networks", networks), made)


def planner(networks: Networks, made: Setup) -> Planner:
    return Planner(networks, made.task, made.agent.config.reapply)


def chosen(chooser: Planner, corners: Floats, placed: Bools, goals: Floats) -> Choice:
    with torch.no_grad():
        every = chooser(*(torch.from_numpy(one) for one in (corners, placed, goals)))
    token, flip, velocity = (one.numpy() for one in every)
    return Choice(token, flip > 0, velocity)


# Against brute force


def total(
    made: Setup,
    networks: Networks,
    scene: tuple[np.ndarray, ...],
    token: int,
    flip: bool,
    pose: np.ndarray | None = None,
    piece: int = 0,
) -> tuple[float, np.ndarray]:
    """Value over all pieces of one token's pose, by default the actor's own for one piece."""
    layout = made.task.layout
    corners, _, goals = (part[None] for part in scene)
    covered = covering(corners, goals, layout)
    share = covered_share(covered, layout)[0, token]
    here, side = layout.poses(corners)[0, token], layout.flipped(corners)[0, token] ^ flip
    wanted, sides = layout.poses(goals)[0], layout.flipped(goals)[0]

    def pair(where: np.ndarray, index: int) -> Pairs:
        own = as_tensor([where]), as_tensor([side]), torch.tensor([token])
        goal = as_tensor([wanted[index]]), as_tensor([sides[index]]), torch.tensor([index])
        return Pairs(*own, *goal, as_tensor([share[index]]))

    graph = PairGraph(layout, made.task.sim.arena)

    def proposed(pairs: Pairs) -> np.ndarray:
        place: np.ndarray = graph.moved(pairs, networks.actor(pairs)[0]).pose[0].numpy()
        return place

    if pose is None:
        pose = proposed(pair(here, piece))
        for _ in range(made.agent.config.reapply):
            pose = proposed(pair(pose, piece))
    still = torch.zeros(1, 3)
    values = [networks.critic(pair(pose, index), still).item() for index in range(layout.tokens)]
    own = layout.areas
    worth = (covered[0, token] / np.maximum(own[token], own)).sum()
    return sum(values) - worth, pose


@pytest.mark.parametrize("net", [SMALL, PERCEPTRON])
@pytest.mark.parametrize("options", [{}, {"reapply": 2}, {"allow_flip": True}])
def test_the_best_of_all_is_played(
    monkeypatch: pytest.MonkeyPatch, net: dict[str, Any], options: dict[str, Any]
) -> None:
    """With a short list that leaves nothing out."""
    monkeypatch.setattr(planning, "_SHORT_LIST", 1000)
    flip = options.get("allow_flip", False)
    made = setup(TWO, {"reapply": options.get("reapply", 0)}, net, allow_flip=flip)
    networks = random_networks(made)
    corners, placed, goals = scenes(made)
    choice = chosen(planner(networks, made), corners, placed, goals)
    for row in range(COUNT):
        scene = corners[row], placed[row], goals[row]
        every = [
            (*total(made, networks, scene, token, turned, piece=piece), token, turned)
            for token, turned, piece in product(range(2), (False, True), range(2))
            if not placed[row, token] and (not turned or (flip and made.task.layout.chiral[token]))
        ]
        _, pose, token, turned = max(every, key=lambda one: one[0])
        assert (choice.token[row], choice.flip[row]) == (token, turned)
        way = velocities_of(
            (pose - made.task.layout.poses(corners[row])[token])[None], made.task.sim
        )[0]
        np.testing.assert_allclose(choice.velocity[row], way.clip(-1.0, 1.0), atol=1e-5)


def test_no_placed_token_is_named_while_others_are_left() -> None:
    made = seven()
    corners, placed, goals = scenes(made, 40)
    token = chosen(planner(random_networks(made), made), corners, placed, goals).token
    assert not placed[np.arange(40), token].any()
    assert len(set(token)) > 1
    nothing = chosen(planner(random_networks(made), made), corners, placed | True, goals)
    assert not nothing.token.any()


# With networks that know everything


def assembled(made: Setup, chooser: Planner, episodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Overlap at the end (B,), and flips (B, T) of whole episodes."""
    policy = Policy(made)
    policy.actor._decides = Decision(made.task, chooser)  # perfect networks have no weights to load
    flips = []
    with closing(BatchedEnv(made.task.layout, made.task.sim, made.task.reward, episodes)) as env:
        env.reset([np.random.default_rng([7, i]) for i in range(episodes)])
        for _ in range(env.horizon):
            actions = policy.act(env.corners, env.placed, env.goals)
            flips.append(actions[:, -4] > 0.0)
            result = env.step(actions.astype(np.float64))
            assert not result.refused.any()
        return result.coverage, np.stack(flips, axis=1)


@pytest.mark.parametrize(
    "sim", [{}, {"mirrored": 0.5}, {"mirrored": 0.5, "allow_flip": True}, {"targets": "connected"}]
)
def test_perfect_networks_assemble_everything(sim: dict[str, Any]) -> None:
    made = seven(starts="outside", **sim)
    overlap, _ = assembled(made, perfect(made), 12)
    assert overlap.min() > 0.999


def test_of_two_moves_worth_as_much_the_one_that_fills_its_piece(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By rounding the last of the short list would be worth most."""
    made = seven()
    corners, placed, goals = scenes(made)
    chooser = perfect(made)

    def rounded(_: object, rows: object, which: torch.Tensor, pose: object) -> torch.Tensor:
        return 1e-6 * torch.arange(which.shape[1]).expand(which.shape)

    monkeypatch.setattr(chooser, "_gained", rounded)
    found = chosen(chooser, corners, placed, goals)
    poses = made.task.layout.poses(corners)[np.arange(COUNT), found.token]
    ends = poses[:, :2] + found.velocity[:, :2] * made.task.sim.arena
    alike = made.task.layout.areas[found.token][:, None] == made.task.layout.areas
    apart = np.linalg.norm(made.task.layout.poses(goals)[..., :2] - ends[:, None], axis=2)
    assert (np.where(alike, apart, np.inf).min(axis=1) < 1e-5).all()


def test_a_token_is_turned_over_just_where_its_piece_lies_on_the_other_side() -> None:
    tokens = {"shapes": ["parallelogram"], "scale": 0.8}
    made = setup(tokens, {"kind": "pair"}, allow_flip=True, mirrored=0.5)
    rng = np.random.default_rng(0)
    own, wanted = (random_scene(made.task.layout, rng, 40) for _ in range(2))
    corners, goals = made.task.layout.corners(*own), made.task.layout.corners(*wanted)
    choice = chosen(perfect(made), corners, np.zeros((40, 1), np.bool_), goals)
    np.testing.assert_array_equal(choice.flip, (own[1] ^ wanted[1])[:, 0])
    assert 5 < choice.flip.sum() < 35
