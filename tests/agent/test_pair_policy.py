"""Policies of several tokens: the actions they give, exploring, and weights over the wire."""

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tangram_agent.learner import Learner
from tangram_agent.messages import decode_weights
from tangram_agent.policy import Policy
from tangram_agent.runs import Run
from tangram_agent.setup import Setup
from tangram_agent.types import Transitions
from tangram_sim.actions import chosen_tokens, flips, velocities
from tangram_sim.batch import BatchedEnv
from tangram_sim.errors import ConfigError
from tests.agent.builders import PAPER, SMALL, setup
from tests.agent.messages import broadcast
from tests.agent.pair_scenes import PERCEPTRON, TWO, seven, transitions

pytestmark = pytest.mark.fast

COUNT = 200
PARALLELOGRAM = 6
Scene = tuple[np.ndarray, np.ndarray, np.ndarray]


def policy_of(made: Setup) -> Policy:
    policy = Policy(made)
    policy.load(Learner(made, 0).acting_weights(7))
    return policy


def scene_of(batch: Transitions) -> Scene:
    return batch.state, batch.placed, batch.goal


def generators(count: int) -> list[np.random.Generator]:
    return [np.random.default_rng(i) for i in range(count)]


@pytest.mark.parametrize("net", [SMALL, PERCEPTRON])
@pytest.mark.parametrize("sim", [{}, {"backend": "physics", "motion": "slide"}])
def test_weights_travel_to_workers(net: dict[str, Any], sim: dict[str, Any]) -> None:
    made = seven({}, net, **sim)
    weights = Learner(made, 0).acting_weights(7)
    policy = Policy(made)
    assert {name: tensor.shape for name, tensor in weights.tensors.items()} == policy.shapes
    epoch, arrived = decode_weights(broadcast(weights, "run"), policy.shapes)
    policy.load(arrived)
    assert (epoch, policy.version) == ("run", 7)
    for name, tensor in policy.weights().tensors.items():
        np.testing.assert_array_equal(tensor, weights.tensors[name])


@pytest.mark.parametrize("flip", [False, True])
def test_an_action_takes_its_token_to_the_pose_that_was_chosen(flip: bool) -> None:
    """By the simulation's own reading of actions."""
    made = seven(allow_flip=flip)
    policy, scene = policy_of(made), scene_of(transitions(made, COUNT))
    actions = policy.act(*scene)
    exact = [part.astype(np.float64) for part in scene]
    choice = policy._planner.choose(exact[0], exact[1] > 0, exact[2])  # type: ignore[union-attr]
    assert actions.shape == (COUNT, 4 + flip)
    assert actions.dtype == np.float32
    np.testing.assert_array_equal(chosen_tokens(actions, 7), choice.token)
    np.testing.assert_array_equal(flips(actions, made.layout, made.sim), choice.flip)
    assert choice.flip.any() == flip
    found = made.layout.poses(exact[0])[np.arange(COUNT), choice.token]
    found += velocities(actions, made.sim)
    np.testing.assert_allclose(found[:, :2], choice.pose[:, :2], atol=1e-5)
    np.testing.assert_allclose(np.exp(1j * (found - choice.pose)[:, 2]), 1.0, atol=1e-5)
    # By the shorter turn: no entry is cut off.
    assert np.abs(actions).max() <= 1.0


def test_refinement_is_for_acting_and_not_for_exploring() -> None:
    agent = {"refine_steps": 5, "noise": 0.0, "uniform_share": 0.0}
    made = seven(agent, PERCEPTRON)
    policy, scene = policy_of(made), scene_of(transitions(made, 8))
    refined, plain = policy.act(*scene), policy.act(*scene, refine=False)
    assert not np.allclose(refined, plain, atol=1e-4)
    np.testing.assert_array_equal(policy.explore(*scene, generators(8)), plain)


def test_noise_moves_the_velocity_and_leaves_the_choice_alone() -> None:
    made = seven({"noise": 0.05, "uniform_share": 0.0}, PERCEPTRON, allow_flip=True)
    policy, scene = policy_of(made), scene_of(transitions(made, COUNT))
    plain, noisy = policy.act(*scene), policy.explore(*scene, generators(COUNT))
    np.testing.assert_array_equal(noisy[:, :2], plain[:, :2])
    inside = np.abs(plain[:, 2:]) < 0.8
    assert (noisy - plain)[:, 2:][inside].std() == pytest.approx(0.05, rel=0.1)


def test_a_share_of_actions_takes_any_token_that_is_left_anywhere() -> None:
    made = seven({"noise": 0.0, "uniform_share": 1.0}, PERCEPTRON, allow_flip=True)
    policy, scene = policy_of(made), scene_of(transitions(made, COUNT, placed=0.5))
    scene[1][:, 0] = 0
    actions = policy.explore(*scene, generators(COUNT))
    token = chosen_tokens(actions, 7)
    assert not scene[1][np.arange(COUNT), token].any()
    assert set(token) == set(range(7))
    poses = made.layout.poses(scene[0].astype(np.float64))[np.arange(COUNT), token]
    end = poses + velocities(actions, made.sim)
    assert np.abs(end[:, :2]).max() <= 1.0 + 1e-5
    np.testing.assert_allclose(end[:, :2].std(axis=0), 1.0 / np.sqrt(3.0), rtol=0.1)
    assert abs(np.exp(1j * end[:, 2]).mean()) < 0.15
    assert set(actions[:, 1]) == {-1.0, 1.0}
    turned = flips(actions, made.layout, made.sim)
    assert 0.2 < turned[token == PARALLELOGRAM].mean() < 0.8


def test_where_all_are_placed_exploring_names_the_first() -> None:
    made = seven({"uniform_share": 1.0}, PERCEPTRON)
    scene = scene_of(transitions(made, 4, placed=1.1))
    actions = policy_of(made).explore(*scene, generators(4))
    assert chosen_tokens(actions, 7).tolist() == [0] * 4


@pytest.mark.parametrize("sim", [{}, {"allow_flip": True}])
def test_exploring_does_not_depend_on_the_batching(sim: dict[str, Any]) -> None:
    made = seven({"uniform_share": 0.5}, PERCEPTRON, **sim)
    policy, scene = policy_of(made), scene_of(transitions(made, 8))
    together = policy.explore(*scene, generators(8))
    for i in range(8):
        one = [part[i : i + 1] for part in scene]
        alone = policy.explore(*one, [np.random.default_rng(i)])
        np.testing.assert_allclose(alone[0], together[i], atol=1e-5)


@pytest.mark.parametrize("readout", ["pair", "token"])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_whole_episodes_of_a_token_with_two_sides(readout: str, noise: float) -> None:
    """Every readout plays every task, also one whose tokens may be turned over."""
    agent = {"readout": readout}
    made = setup(TWO, agent, PERCEPTRON, allow_flip=True, corner_noise=noise)
    policy = policy_of(made)
    with closing(BatchedEnv(made.layout, made.sim, made.reward, 4)) as env:
        env.reset(generators(4))
        for _ in range(env.horizon):
            actions = policy.explore(env.seen, env.placed, env.seen_goals, generators(4))
            assert not env.step(actions.astype(np.float64)).refused.any()
    learner, batch = Learner(made, 0), transitions(made, 8)
    learner.update(learner.prepared(batch, np.random.default_rng(0)))
    assert learner.updates == 1


def test_the_agent_of_the_paper_plays_and_learns_the_game() -> None:
    made = seven(PAPER, mirrored=0.5)
    policy, learner, batch = policy_of(made), Learner(made, 0), transitions(made, 8)
    assert policy.act(*scene_of(batch)).shape == (8, 4)
    learner.update(learner.prepared(batch, np.random.default_rng(0)))
    assert learner.updates == 1


def run_of(made: Setup) -> Run:
    return Run(Path("run"), {}, made, 7, policy_of(made))


def test_a_run_plays_on_with_other_settings_of_the_agent() -> None:
    run = run_of(seven({}, PERCEPTRON))
    scene = scene_of(transitions(run.setup, 8))
    other = run.with_settings({"agent": {"refine_steps": 20, "order": "listed"}})
    assert (other.setup.agent.refine_steps, run.setup.agent.refine_steps) == (20, 0)
    assert other.policy.version == 7
    left = [int(np.argmin(flags)) for flags in scene[1]]
    assert chosen_tokens(other.policy.act(*scene), 7).tolist() == left
    assert not np.allclose(other.policy.act(*scene), run.policy.act(*scene), atol=1e-3)


@pytest.mark.parametrize(
    ("section", "name", "value", "reason"),
    [
        ("agent", "order", "x", "run with agent.order=x: agent.order must be one of learned,"),
        ("agent", "order", 1, "wrong config: .*agent.order"),
        ("agent", "odd", 1, "wrong config: .*odd"),
        ("agent", "batch_size", 9, "agent.batch_size=9 changes nothing with a trained run, which"),
        ("sim", "stages", (), "changes nothing with a trained run, which only plays: leave it out"),
        ("agent", "readout", "token", "agent.readout=token does not fit this run, whose weights"),
        ("sim", "arena", 3.0, "trained with sim.arena=2: leave it out, or train a run with it"),
        (
            "sim",
            "motion",
            "slide",
            "run with sim.motion=slide: sim.motion=slide needs the engine's",
        ),
    ],
)
def test_settings_that_a_trained_run_cannot_play_with_are_refused(
    section: str, name: str, value: Any, reason: str
) -> None:
    with pytest.raises(ConfigError, match=reason):
        run_of(seven({}, PERCEPTRON)).with_settings({section: {name: value}})


def test_settings_of_the_world_are_those_that_are_played_in() -> None:
    run = run_of(seven({}, PERCEPTRON))
    other = run.with_settings({"sim": {"allow_flip": True, "corner_noise": 0.01}})
    assert (other.setup.sim.allow_flip, other.setup.sim.corner_noise) == (True, 0.01)
    assert other.policy.act(*scene_of(transitions(other.setup, 8))).shape == (8, 5)
    assert run.with_settings({"sim": {}}) is run
