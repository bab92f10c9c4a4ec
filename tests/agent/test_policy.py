"""Acting and exploring."""

import numpy as np
import pytest

from tangram_agent.learner import Learner
from tangram_agent.policy import Policy
from tangram_agent.setup import Setup
from tangram_agent.types import Weights
from tangram_sim.errors import RunError
from tests.agent.builders import PAIR, SCENE, random_transitions, setup

pytestmark = pytest.mark.fast


def policy_of(made: Setup) -> Policy:
    policy = Policy(made)
    policy.load(Learner(made, seed=0).acting_weights(7))
    return policy


def test_load_takes_weights_and_version() -> None:
    made = setup(agent=SCENE)
    policy = Policy(made)
    assert policy.version == -1
    weights = Learner(made, seed=0).acting_weights(7)
    policy.load(weights)
    assert policy.version == 7
    assert policy.shapes == {name: value.shape for name, value in weights.tensors.items()}


def test_weights_are_a_copy() -> None:
    made = setup(agent=SCENE)
    learner = Learner(made, seed=0)
    weights = learner.acting_weights(0)
    before = {name: value.copy() for name, value in weights.tensors.items()}
    learner.update(random_transitions(made, 8))
    for name, value in before.items():
        np.testing.assert_array_equal(weights.tensors[name], value)


def test_weights_of_another_network_are_refused() -> None:
    with pytest.raises(RunError, match="on one side only"):
        Policy(setup(agent=SCENE)).load(Weights(0, {}))


def test_acting_is_the_acting_network_of_the_learner() -> None:
    made = setup(agent=SCENE | {"acting_average": 0.5})
    learner = Learner(made, seed=0)
    batch = random_transitions(made, 8)
    learner.update(batch)
    policy = Policy(made)
    policy.load(learner.acting_weights(1))
    expected = learner.acting(learner.steps(batch).view)[0].detach().numpy()
    found = policy.act(batch.state, batch.placed, batch.goal)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_with_several_tokens_the_next_one_is_named() -> None:
    made = setup(PAIR, agent=SCENE)
    batch = random_transitions(made, 2)
    actions = policy_of(made).act(batch.state, np.array([[0, 0], [1, 0]]), batch.goal)
    assert actions.shape == (2, 4)
    assert actions[:, 0].tolist() == [-0.5, 0.5]


def explore(made: Setup, count: int = 500) -> tuple[np.ndarray, np.ndarray]:
    policy, batch = policy_of(made), random_transitions(made, count)
    generators = [np.random.default_rng(i) for i in range(count)]
    scene = (batch.state, batch.placed, batch.goal)
    return policy.act(*scene), policy.explore(*scene, generators)


def test_gaussian_noise_has_the_spread_that_is_set() -> None:
    plain, noisy = explore(setup(agent=SCENE | {"noise": 0.05, "uniform_share": 0.0}))
    inside = np.abs(plain) < 0.8
    gap = (noisy - plain)[inside]
    assert gap.std() == pytest.approx(0.05, rel=0.1)
    assert abs(gap.mean()) < 0.01


def test_a_share_of_actions_is_uniform() -> None:
    plain, noisy = explore(setup(agent=SCENE | {"noise": 0.0, "uniform_share": 0.3}))
    drawn = np.abs(noisy - plain).max(axis=1) > 1e-6
    assert drawn.mean() == pytest.approx(0.3, abs=0.06)
    assert noisy[drawn].std() == pytest.approx(1 / np.sqrt(3), rel=0.1)


def test_exploring_stays_in_range_and_keeps_the_choice_of_token() -> None:
    plain, noisy = explore(setup(PAIR, agent=SCENE | {"noise": 2.0, "uniform_share": 0.5}))
    assert np.abs(noisy).max() <= 1.0
    np.testing.assert_array_equal(noisy[:, 0], plain[:, 0])


def test_the_noise_does_not_depend_on_the_batching() -> None:
    made = setup(PAIR)
    policy, batch = policy_of(made), random_transitions(made, 4)
    together = policy.explore(
        batch.state, batch.placed, batch.goal, [np.random.default_rng(i) for i in range(4)]
    )
    for i in range(4):
        one = slice(i, i + 1)
        alone = policy.explore(
            batch.state[one], batch.placed[one], batch.goal[one], [np.random.default_rng(i)]
        )
        np.testing.assert_allclose(alone[0], together[i], atol=1e-6)
