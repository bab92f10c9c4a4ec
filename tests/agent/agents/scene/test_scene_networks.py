"""Sizes of Table I, symmetries, and the ranges of what actors give."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from conf.cli import composed
from tangram_agent.agents.scene.networks import ActorNet, CriticNet
from tangram_agent.agents.scene.scenes import SceneGraph, Scenes
from tangram_agent.nets.networks import initialise, parameter_count
from tangram_core.setup import Setup, make_setup
from tests.agent.builders import PAIR, PAPER, SMALL, random_transitions, setup

pytestmark = pytest.mark.fast

NETS: dict[str, Any] = {"mha": SMALL, "mlp": {"kind": "mlp"}}


def networks(made: Setup, seed: int = 0) -> tuple[SceneGraph, ActorNet, CriticNet]:
    actor, critic = made.agent.networks(made.task.layout)
    generator = torch.Generator().manual_seed(seed)
    initialise(actor, generator)
    initialise(critic, generator)
    return actor.head.graph, actor, critic


def inputs(made: Setup, count: int = 5) -> Scenes:
    batch = random_transitions(made, count)
    parts = (batch.state, batch.placed, batch.goal)
    state, placed, goal = (torch.from_numpy(np.asarray(part, np.float32)) for part in parts)
    return Scenes(state, placed, goal, torch.zeros(count, dtype=torch.long))


@pytest.mark.parametrize(
    ("told", "sizes", "total"),
    [
        ("agent=paper", (252_227, 252_097), 504_324),
        ("agent=mlp", (6_851, 7_217), 14_068),
        ("agent=mlp net=mlp_large", (237_123, 237_489), 474_612),
    ],
)
def test_sizes_of_table_1(told: str, sizes: tuple[int, int], total: int) -> None:
    made = make_setup(composed("train", ["run_dir=x", "sim=paper", *told.split()]))
    _, actor, critic = networks(made)
    assert (parameter_count(actor), parameter_count(critic)) == sizes
    assert parameter_count(actor, critic) == total


@pytest.mark.parametrize("piece", ["token", "target"])
def test_permuting_corners_permutes_nodes_and_leaves_the_rest(piece: str) -> None:
    made = setup(agent=PAPER)
    graph, actor, critic = networks(made)
    scenes = inputs(made)
    velocity = torch.full((5, 3), 0.3)
    order = torch.tensor([2, 0, 3, 1])
    name = "corners" if piece == "token" else "goal"
    swapped = replace(scenes, **{name: vars(scenes)[name][:, order]})
    first = 0 if piece == "token" else 5
    nodes = torch.arange(graph.nodes)
    nodes[first : first + 4] = first + order

    features = graph.node_features(scenes)
    again = graph.node_features(swapped)
    before, mean = actor.head.encoder(features, graph.adjacency)
    after, mean_again = actor.head.encoder(again, graph.adjacency)
    torch.testing.assert_close(after, before[:, nodes], atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(mean_again, mean, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(actor(swapped)[0], actor(scenes)[0])
    torch.testing.assert_close(critic(swapped, velocity), critic(scenes, velocity))


@pytest.mark.parametrize("kind", ["mha", "mlp"])
def test_actions_of_scenes_stay_in_range(kind: str) -> None:
    made = setup(agent=PAPER, net=NETS[kind])
    _, actor, _ = networks(made)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.mul_(20.0)
    velocity, raw = actor(inputs(made, 64))
    assert raw.abs().max() > 1.0
    assert 0.9 < velocity.abs().max() <= 1.0
    torch.testing.assert_close(velocity, torch.tanh(raw))


def test_the_critic_appends_the_action_to_the_base_of_its_token() -> None:
    made = setup(PAIR, agent=PAPER)
    graph, _, critic = networks(made)
    seen = []
    critic.head.encoder.register_forward_pre_hook(lambda _, args: seen.append(args[0]))
    scenes = replace(inputs(made, 2), token=torch.tensor([0, 1]))
    critic(scenes, torch.tensor([[0.1, 0.2, 0.3]] * 2))
    appended = seen[0][:, :, 4:]
    corners = made.task.layout.corner_count
    expected = torch.zeros(2, graph.nodes, 3)
    expected[0, corners] = expected[1, corners + 1] = torch.tensor([0.1, 0.2, 0.3])
    assert torch.equal(appended, expected)


@pytest.mark.parametrize("kind", ["mha", "mlp"])
def test_the_actor_reads_the_base_of_the_token_that_moves(kind: str) -> None:
    made = setup(PAIR, agent=PAPER, net=NETS[kind])
    _, actor, _ = networks(made)
    scenes = inputs(made)
    first = actor(scenes)[0]
    second = actor(replace(scenes, token=scenes.token + 1))[0]
    assert (first - second).abs().max() > 1e-3
