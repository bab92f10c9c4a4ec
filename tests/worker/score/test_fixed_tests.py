"""The fixed test set, and the two policies to compare with."""

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from tangram_core.task import History
from tangram_tasks.played import Played
from tangram_tasks.rivals.baselines import position_policy, random_policy
from tests.agent.builders import PAIR, SQUARE, setup
from tests.sim.builders import evaluation_generators
from tests.worker.builders import policy
from worker.play.rollout import greedy
from worker.score.test_set import FixedTests

pytestmark = pytest.mark.fast


def played(episodes: int, at_once: int, **more: object) -> Played:
    made = setup(pixels=32)
    with closing(FixedTests(made.task, episodes, at_once, **more)) as tests:
        return Played.of(tests.play(greedy(policy(made).actor)))


def test_the_set_does_not_depend_on_how_many_play_at_a_time() -> None:
    expected = played(12, 4)
    for episodes, at_once in ((7, 3), (7, 7), (7, 50), (1, 1)):
        found = played(episodes, at_once)
        assert len(found.coverage) == episodes
        for name in ("corners", "goals", "coverage"):
            column = vars(expected)[name][:episodes]
            np.testing.assert_allclose(vars(found)[name], column, atol=1e-4, err_msg=name)
        actions = expected.episodes.actions[:episodes]
        np.testing.assert_allclose(found.episodes.actions, actions, atol=1e-4)


def test_the_default_set_is_that_of_the_simulation() -> None:
    made = setup(pixels=32)
    with closing(FixedTests(made.task, 3, 3)) as tests:
        goals = Played.of(tests.play(greedy(policy(made).actor))).goals
        tests.env.reset(evaluation_generators(3))
        np.testing.assert_array_equal(goals, tests.env.facts()["goals"])


@pytest.mark.parametrize("other", [{"seed": 1}, {"role": "play"}])
def test_another_name_is_another_set(other: dict) -> None:
    assert not np.isclose(played(4, 4).goals, played(4, 4, **other).goals).any()


def test_noise_is_off() -> None:
    made = setup(agent={"noise": 1.0, "uniform_share": 1.0}, pixels=32)
    acting = policy(made)
    with closing(FixedTests(made.task, 3, 3)) as tests:
        found = Played.of(tests.play(greedy(acting.actor)))
    expected = acting.act(found.starts, found.episodes["placed"][:, 0], found.goals)
    np.testing.assert_array_equal(found.episodes.actions[:, 0], expected)


def test_the_camera_is_on_though_training_has_none() -> None:
    made = setup()
    assert not made.task.sim.pixels
    with closing(FixedTests(made.task, 20, 10)) as tests:
        whole = tests.play(position_policy(made.task.layout, made.task.sim))
    found, scores = Played.of(whole), made.task.score(whole)
    assert found.camera is not None
    np.testing.assert_allclose(found.camera, 2.0 * found.coverage - 1.0, atol=0.1)
    assert scores["mean_reward_camera"] == pytest.approx(scores["mean_reward"], abs=0.03)


@pytest.mark.parametrize(
    ("reward", "own"),
    [
        ({}, False),
        ({"name": "dense"}, True),
        ({"source": "camera"}, True),
    ],
)
def test_the_trained_reward_is_reported_where_it_is_another(reward: dict, own: bool) -> None:
    made = setup(pixels=32)
    task = replace(made.task, reward=replace(made.task.reward, **reward))
    made = replace(made, task=task)
    with closing(FixedTests(made.task, 3, 3)) as tests:
        whole = tests.play(greedy(policy(made).actor))
    found, scores = Played.of(whole), made.task.score(whole)
    assert scores["mean_reward"] == pytest.approx(float(np.mean(2.0 * found.coverage - 1.0)))
    assert ("mean_train_reward" in scores) == own


@pytest.mark.parametrize(("tokens", "actions"), [(SQUARE, 1), (SQUARE, 3), (PAIR, 1), (PAIR, 2)])
def test_the_position_policy_solves_position_and_nothing_else(
    tokens: dict, actions: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tangram_sim.batch.MAX_OVERLAP", 1.0)
    made = setup(tokens, pixels=32, actions_per_token=actions)
    with closing(FixedTests(made.task, 10, 10)) as tests:
        found = Played.of(tests.play(position_policy(made.task.layout, made.task.sim)))
    centres = made.task.layout.bases(found.ends), made.task.layout.bases(found.goals)
    np.testing.assert_allclose(*centres, atol=1e-6)
    assert found.episodes["placed"][:, -1].all() == (tokens is PAIR or actions == 1)
    angles = made.task.layout.poses(found.corners)[..., 2]
    np.testing.assert_allclose(angles[:, -1], angles[:, 0], atol=1e-9)


@pytest.mark.parametrize("flip", [False, True])
def test_the_random_policy_fills_the_action_space_from_the_episodes_generators(flip: bool) -> None:
    made = setup({"shapes": ["parallelogram"], "scale": 1.0}, allow_flip=flip)
    choose = random_policy(made.task.layout, made.task.sim)
    seen = dict.fromkeys(("corners", "placed", "goals"), np.zeros((500, 1)))
    none = History({}, np.zeros((500, 0, 3), np.float32))
    one, two = (choose(seen, none, evaluation_generators(500)) for _ in range(2))
    np.testing.assert_array_equal(one, two)
    assert one.shape == (500, made.task.spec.action_size)
    np.testing.assert_allclose(one.min(axis=0), -1.0, atol=0.05)
    np.testing.assert_allclose(one.max(axis=0), 1.0, atol=0.05)
