"""The examples of the documentation learn: an agent of one's own, a task of one's own."""

import numpy as np
import pytest
import torch

from tangram_agent.agents.scene.scenes import Scenes
from tangram_core.conformance import check_agent, play
from tangram_core.seeding import episode_generator
from tests.agent.builders import SCENE, SMALL, SQUARE, setup
from tests.core.examples import example
from tests.sim.builders import evaluation_generators

pytestmark = pytest.mark.slow


def test_the_agent_of_the_examples_learns_their_task() -> None:
    task, td3 = example("point").Point(), example("td3")
    agent = td3.TD3(td3.TD3Config(batch_size=128, hidden=(64, 64)))
    learner, actor = agent.learner(task, 0, "cpu"), agent.actor(task)
    rng = {name: np.random.default_rng([0, i]) for i, name in enumerate(learner.streams)}
    actor.load(learner.broadcast())
    env = task.make(10)
    for number in range(35):
        own = [episode_generator(0, "player", 0, 0, number * 10 + i) for i in range(10)]
        learner.insert(play(task, env, own, actor.act).episodes, rng)
        for _ in range(20 if number > 3 else 0):
            learner.update(0.0, rng)
        actor.load(learner.broadcast())
    own = evaluation_generators(50)
    tests = play(task, task.make(50), own, lambda seen, past, _: actor.act(seen, past))
    assert task.score(tests)["success"] >= 0.9


def test_the_shortest_path_knows_the_angle_and_where_an_action_leads() -> None:
    path, made = example("paper_path"), setup(SQUARE, agent=SCENE, net=SMALL)
    graph = path.AngleGraph(made.task.layout)
    square = torch.tensor([[-0.2, -0.2], [0.2, -0.2], [0.2, 0.2], [-0.2, 0.2]])

    def turned(degrees: float) -> torch.Tensor:
        turn = torch.tensor([[0.0, 0.0, degrees / 180.0]])
        return path.moved(graph, scene(square), turn).corners[0]

    def scene(corners: torch.Tensor) -> Scenes:
        placed, token = torch.zeros(1, 1, dtype=torch.bool), torch.zeros(1, dtype=torch.long)
        return Scenes(corners[None], placed, square[None], token)

    for degrees, told in (
        (0.0, (1.0, 0.0)),
        (90.0, (1.0, 0.0)),
        (45.0, (-1.0, 0.0)),
        (22.5, (0.0, -1.0)),
    ):
        features = graph.node_features(scene(turned(degrees)))
        assert features.shape[-1] == graph.features
        np.testing.assert_allclose(
            features[0, :, -2:].numpy(), [told] * features.shape[1], atol=1e-5
        )
    there = path.moved(graph, scene(square), torch.tensor([[0.25, -0.5, 0.0]]))
    np.testing.assert_allclose(
        there.corners[0].numpy(), square + torch.tensor([0.5, -1.0]), atol=1e-6
    )
    check_agent(path.Both(made.agent.config, made.agent.net), made.task)
