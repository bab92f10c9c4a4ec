"""Acting and exploring on scenes and on pairs, and weights over the wire."""

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.vector import SyncVectorEnv

from tangram_agent.agents.pair.actor import critic_plays
from tangram_agent.base.types import Transitions
from tangram_agent.nets.weights import to_arrays
from tangram_agent.runs import Run
from tangram_core.agent import Weights
from tangram_core.errors import ConfigError, RunError, WireError
from tangram_core.setup import Setup
from tangram_core.wire.messages import decode_weights
from tangram_sim.batch import BatchedEnv
from tangram_sim.motion.actions import chosen_tokens, flips, full_scale, velocities
from tangram_tasks.goal_env import place
from tests.agent.agents.pair.pair_scenes import PERCEPTRON, SEVEN, TWO, seven, transitions
from tests.agent.builders import (
    PAIR,
    PAPER,
    SCENE,
    SMALL,
    Policy,
    learn,
    learner_of,
    random_transitions,
    seen_in,
    setup,
)
from tests.agent.messages import broadcast
from worker.play.session import Acting

pytestmark = pytest.mark.fast

COUNT = 120
PARALLELOGRAM = 6
Scene = tuple[np.ndarray, np.ndarray, np.ndarray]


def policy_of(made: Setup) -> Policy:
    policy = Policy(made)
    policy.load(learner_of(made).export())
    return policy


def scene_of(batch: Transitions) -> Scene:
    return batch.state, batch.placed, batch.goal


def generators(count: int) -> list[np.random.Generator]:
    return [np.random.default_rng(i) for i in range(count)]


def explored(made: Setup, count: int = COUNT) -> tuple[np.ndarray, np.ndarray]:
    """Actions in the same scenes, without exploring and with it."""
    policy, scene = policy_of(made), scene_of(transitions(made, count))
    return policy.act(*scene), policy.explore(*scene, generators(count))


@pytest.mark.parametrize("made", [setup(agent=SCENE), seven({}, SMALL), seven({}, PERCEPTRON)])
def test_weights_travel_to_workers(made: Setup) -> None:
    weights, actor = Weights(7, learner_of(made).broadcast()), made.agent.actor(made.task)
    policy = Acting(actor)
    assert policy.version == -1
    assert {name: tensor.shape for name, tensor in weights.tensors.items()} == actor.shapes
    epoch, arrived = decode_weights(broadcast(weights, "run"), actor.shapes)
    policy.follow(arrived)
    assert (epoch, policy.version) == ("run", 7)
    for name, tensor in to_arrays(actor.network).items():
        np.testing.assert_array_equal(tensor, weights.tensors[name])
    with pytest.raises(RunError, match="on one side only"):
        policy.follow(Weights(0, {}))


ONE = {"shapes": ["parallelogram"], "scale": 0.8}
HAS_A_SAY = [
    (setup(agent=PAPER), False),
    (setup(agent={"reapply": 2}), False),
    (setup(ONE), False),
    (setup(ONE, mirrored=0.5), False),
    (setup(ONE, allow_flip=True), True),
    (setup(PAIR), True),
]


@pytest.mark.parametrize(("made", "has"), HAS_A_SAY)
def test_a_critic_travels_where_it_has_a_say_in_what_is_played(made: Setup, has: bool) -> None:
    """What did not come is no number here: whoever asked it would not act as others do."""
    learner, told = learner_of(made), Policy(made)
    sent = learner.broadcast()
    left_out = {name.partition(".")[0] for name in learner.export().keys() - sent.keys()}
    assert (critic_plays(made.task), left_out) == (
        has,
        {"critic"} if (made.agent_kind == "pair") and not has else set(),
    )
    assert {name: tensor.shape for name, tensor in sent.items()} == told.actor.shapes
    for parameter in told.actor.network.parameters():
        parameter.fill_(np.nan)
    told.load(sent)
    batch, knows = random_transitions(made, 20), policy_of(made)
    scene = scene_of(batch)
    np.testing.assert_array_equal(told.act(*scene), knows.act(*scene))
    one, other = (p.explore(*scene, generators(20)) for p in (told, knows))
    np.testing.assert_array_equal(one, other)
    assert np.isfinite(one).all()


def test_what_travels_is_no_checkpoint() -> None:
    """Who plays a finished run may set what makes its critic play."""
    learner, policy = learner_of(setup(ONE)), Policy(setup(ONE, allow_flip=True))
    with pytest.raises(RunError, match="'critic.head.* is on one side only"):
        policy.load(learner.broadcast())
    policy.load(learner.export())
    whole = Weights(7, learner.export())
    with pytest.raises(WireError, match="critic.head"):
        decode_weights(broadcast(whole), Policy(setup(ONE)).actor.shapes)


def test_weights_are_a_copy() -> None:
    made = setup(agent=SCENE)
    learner = learner_of(made)
    weights = learner.broadcast()
    before = {name: value.copy() for name, value in weights.items()}
    learn(learner, random_transitions(made, 8))
    for name, value in before.items():
        np.testing.assert_array_equal(weights[name], value)


def test_acting_is_the_acting_network_of_the_learner() -> None:
    made = setup(agent=SCENE | {"acting_average": 0.5})
    learner, policy = learner_of(made), Policy(made)
    batch = random_transitions(made, 8)
    learn(learner, batch)
    policy.load(learner.broadcast())
    expected = (
        learner.acting(learner.steps(batch, np.random.default_rng(0)).view)[0].detach().numpy()
    )
    np.testing.assert_allclose(policy.act(*scene_of(batch)), expected, atol=1e-6)


@pytest.mark.parametrize("flip", [False, True])
def test_an_action_says_what_was_chosen(flip: bool) -> None:
    """By the simulation's own reading of actions."""
    made = seven(allow_flip=flip)
    count = 40
    policy, scene = policy_of(made), scene_of(transitions(made, count))
    actions = policy.act(*scene)
    exact = [torch.from_numpy(part.astype(np.float64)) for part in scene]
    with torch.no_grad():
        token, turned, velocity = (one.numpy() for one in policy.actor.graph().planner(*exact))
    assert actions.shape == (count, 4 + flip)
    assert actions.dtype == np.float32
    np.testing.assert_array_equal(chosen_tokens(actions, 7), token)
    np.testing.assert_array_equal(flips(actions, made.task.layout, made.task.sim), turned)
    assert turned.any() == flip
    command = velocity * full_scale(made.task.sim)
    np.testing.assert_allclose(velocities(actions, made.task.sim), command, atol=1e-5)
    # By the shorter turn: no entry is cut off.
    assert np.abs(actions).max() <= 1.0


NOISE = {"noise": 0.05, "uniform_share": 0.0}


@pytest.mark.parametrize(
    ("made", "chosen"),  # how many entries say which token, and whether it is turned over
    [
        (setup(agent=SCENE | NOISE), 0),
        (setup(PAIR, agent=SCENE | NOISE), 1),
        (seven(NOISE, PERCEPTRON, allow_flip=True), 2),
    ],
)
def test_noise_moves_the_velocity_by_its_spread_and_leaves_the_choice(
    made: Setup, chosen: int
) -> None:
    plain, noisy = explored(made, 500)
    np.testing.assert_array_equal(noisy[:, :chosen], plain[:, :chosen])
    inside = np.abs(plain[:, chosen:]) < 0.8
    gap = (noisy - plain)[:, chosen:][inside]
    assert gap.std() == pytest.approx(0.05, rel=0.1)
    assert abs(gap.mean()) < 0.01


@pytest.mark.parametrize("times", [1, 2])
def test_noise_inside_is_added_before_the_last_tanh(times: int) -> None:
    agent = SCENE | NOISE | {"noise_inside": True, "actor_tanh": times}
    plain, noisy = explored(setup(agent=agent), 500)
    gap = np.arctanh(noisy) - np.arctanh(plain)
    assert gap.std() == pytest.approx(0.05, rel=0.1)
    assert abs(gap.mean()) < 0.01
    assert np.abs(plain).max() < (np.tanh(1.0) if times == 2 else 1.0)


def test_a_share_of_actions_is_uniform() -> None:
    plain, noisy = explored(setup(agent=SCENE | {"noise": 0.0, "uniform_share": 0.3}), 500)
    drawn = np.abs(noisy - plain).max(axis=1) > 1e-6
    assert drawn.mean() == pytest.approx(0.3, abs=0.06)
    assert noisy[drawn].std() == pytest.approx(1 / np.sqrt(3), rel=0.1)


def test_exploring_stays_in_range_and_keeps_the_choice_of_token() -> None:
    plain, noisy = explored(setup(PAIR, agent=SCENE | {"noise": 2.0, "uniform_share": 0.5}))
    assert np.abs(noisy).max() <= 1.0
    np.testing.assert_array_equal(noisy[:, 0], plain[:, 0])


def test_a_share_of_actions_takes_any_token_that_is_left_anywhere() -> None:
    made = seven({"noise": 0.0, "uniform_share": 1.0}, PERCEPTRON, allow_flip=True)
    policy, scene = policy_of(made), scene_of(transitions(made, COUNT, placed=0.5))
    scene[1][:, 0] = 0
    actions = policy.explore(*scene, generators(COUNT))
    token = chosen_tokens(actions, 7)
    assert not scene[1][np.arange(COUNT), token].any()
    assert set(token) == set(range(7))
    poses = made.task.layout.poses(scene[0].astype(np.float64))[np.arange(COUNT), token]
    end = poses + velocities(actions, made.task.sim)
    assert np.abs(end[:, :2]).max() <= 1.0 + 1e-5
    np.testing.assert_allclose(end[:, :2].std(axis=0), 1.0 / np.sqrt(3.0), rtol=0.1)
    assert abs(np.exp(1j * end[:, 2]).mean()) < 0.15
    assert set(actions[:, 1]) == {-1.0, 1.0}
    turned = flips(actions, made.task.layout, made.task.sim)
    assert 0.2 < turned[token == PARALLELOGRAM].mean() < 0.8


def test_where_all_are_placed_exploring_names_the_first() -> None:
    made = seven({"uniform_share": 1.0}, PERCEPTRON)
    scene = scene_of(transitions(made, 4, placed=1.1))
    actions = policy_of(made).explore(*scene, generators(4))
    assert chosen_tokens(actions, 7).tolist() == [0] * 4


@pytest.mark.parametrize(
    "made",
    [
        setup(PAIR, SCENE),
        seven({"uniform_share": 0.5}, PERCEPTRON),
        seven({"uniform_share": 0.5}, PERCEPTRON, allow_flip=True),
    ],
)
def test_exploring_does_not_depend_on_the_batching(made: Setup) -> None:
    policy, scene = policy_of(made), scene_of(transitions(made, 8))
    together = policy.explore(*scene, generators(8))
    for i, generator in enumerate(generators(8)):
        alone = policy.explore(*(part[i : i + 1] for part in scene), [generator])
        np.testing.assert_allclose(alone[0], together[i], atol=1e-5)


def learns(made: Setup) -> None:
    learner = learner_of(made)
    learn(learner, transitions(made, 8))
    assert learner.updates == 1


@pytest.mark.parametrize("kind", ["pair", "scene"])
def test_whole_episodes_of_a_token_with_two_sides(kind: str) -> None:
    """Either plays every task, also one whose tokens may be turned over."""
    made = setup(TWO, {"kind": kind}, PERCEPTRON, allow_flip=True)
    policy = policy_of(made)
    with closing(BatchedEnv(made.task.layout, made.task.sim, made.task.reward, 4)) as env:
        env.reset(generators(4))
        for _ in range(env.horizon):
            actions = policy.explore(env.seen, env.placed, env.seen_goals, generators(4))
            assert not env.step(actions.astype(np.float64)).refused.any()
    learns(made)


def test_the_agent_of_the_paper_plays_and_learns_the_game() -> None:
    made = seven(PAPER, mirrored=0.5)
    assert policy_of(made).act(*scene_of(transitions(made, 8))).shape == (8, 4)
    learns(made)


def run_of(made: Setup) -> Run:
    return Run(Path("run"), {}, made, Weights(7, learner_of(made).export()))


SHOWN = {"observation": 53, "achieved_goal": 46, "desired_goal": 46}


def test_predict_takes_what_the_environments_show() -> None:
    made = seven({}, PERCEPTRON)
    run, world = run_of(made), {"backend": "kinematic", **SEVEN}
    one, several = place(**world), SyncVectorEnv([lambda: place(**world)] * 3)
    observation, _ = one.reset(seed=1)
    observations, _ = several.reset(seed=0)
    for _ in range(3):  # with tokens that are placed, too
        actions = run.predict(observations)
        shown = {
            "corners": observation["achieved_goal"].reshape(1, -1, 2),
            "placed": observation["observation"][None, -7:] > 0.5,
            "goals": observation["desired_goal"].reshape(1, -1, 2),
        }
        np.testing.assert_allclose(run.act(shown)[0], actions[1], atol=1e-5)
        alone = run.predict(observation)
        np.testing.assert_allclose(alone, actions[1], atol=1e-5)
        assert one.action_space.contains(alone)
        assert several.action_space.contains(actions)
        observation, *_ = one.step(actions[1])
        observations, *_ = several.step(actions)


@pytest.mark.parametrize(
    ("observation", "reason"),
    [
        (
            {name: np.zeros(size - 2) for name, size in SHOWN.items()},
            "observation.'observation'. has shape .51,., but run needs .53,.: use observations of",
        ),
        (
            {name: np.zeros((2, size)) for name, size in SHOWN.items()}
            | {"desired_goal": np.zeros(46)},
            "observation.'desired_goal'. has shape .46,., but run needs .2, 46.: use",
        ),
        (
            {name: np.zeros((2, 2, size)) for name, size in SHOWN.items()},
            "has shape .2, 2, 53., but run needs .2, 53.",
        ),
        (
            {name: np.zeros((0, size)) for name, size in SHOWN.items()},
            "has shape .0, 53., but run needs .1, 53.",
        ),
        (
            {name: np.full(size, np.nan) for name, size in SHOWN.items()},
            "observation.'observation'. must be finite and within .-1e.06: give what",
        ),
        (
            {name: np.full(size, 1e30) for name, size in SHOWN.items()},
            "observation.'observation'. must be finite and within .-1e.06: give what",
        ),
        (dict.fromkeys(SHOWN, "corners"), "entries must be numbers: could not convert string"),
        ({1: 2}, "of observation, achieved_goal, desired_goal, got 1: give the"),
        ({"observation": np.zeros(53)}, "of observation, achieved_goal, desired_goal, got observ"),
        ({}, "got an empty one: give the observation that reset or step returns"),
        (({}, {}), "got a tuple: give the observation that reset or step returns"),
    ],
)
def test_an_observation_of_another_form_is_refused(observation: Any, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        run_of(seven({}, PERCEPTRON)).predict(observation)


def test_a_run_plays_on_with_other_settings_of_the_agent() -> None:
    run = run_of(seven({}, PERCEPTRON))
    scene = seen_in(transitions(run.setup, 8))
    other = run.with_settings({"agent": {"reapply": 3}})
    assert (other.setup.agent.config.reapply, run.setup.agent.config.reapply) == (3, 0)
    assert other.updates == 7
    assert not np.allclose(other.act(scene), run.act(scene), atol=1e-3)


@pytest.mark.parametrize(
    ("section", "name", "value", "reason"),
    [
        ("agent", "reapply", -1, "run with agent.reapply=-1: agent.reapply must be between 0 and"),
        ("agent", "reapply", "x", "agent.reapply must be a whole number, got x"),
        ("agent", "odd", 1, "there is no setting agent.odd"),
        ("agent", "batch_size", 9, "agent.batch_size=9 changes nothing with a trained run, which"),
        ("agent", "kind", "scene", "agent.kind=scene does not fit .*kind=pair: leave"),
        ("sim", "arena", 3.0, "trained with sim.arena=2: leave it out, or train a run with it"),
        ("sim", "pixels", 8, "run with sim.pixels=8: sim.pixels must be 0 or at least 16"),
    ],
)
def test_settings_that_a_trained_run_cannot_play_with_are_refused(
    section: str, name: str, value: Any, reason: str
) -> None:
    with pytest.raises(ConfigError, match=reason):
        run_of(seven({}, PERCEPTRON)).with_settings({section: {name: value}})


def test_settings_of_the_world_are_those_that_are_played_in() -> None:
    run = run_of(seven({}, PERCEPTRON))
    other = run.with_settings({"sim": {"allow_flip": True, "targets": "connected"}})
    assert (other.task.sim.allow_flip, other.task.sim.targets) == (True, "connected")
    assert other.act(seen_in(transitions(other.setup, 8))).shape == (8, 5)
    assert run.with_settings({"sim": {}}) is run
