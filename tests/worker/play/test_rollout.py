"""Play: what is recorded equals a naive loop, whatever is played side by side."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tangram_core.seeding import episode_generator
from tangram_core.setup import Setup
from tangram_core.spec import Arrays, Episodes
from tangram_sim.geometry.overlap import covered_share
from tangram_tasks.env import PlaceEnv
from tangram_tasks.played import Played
from tests.agent.builders import PAIR, SQUARE, Policy, setup
from tests.sim.builders import sample_poses
from tests.worker.builders import policy
from worker.play.rollout import Rollout, parts, play

pytestmark = pytest.mark.fast

# Explores a lot, so that a stream of random numbers that is out of step shows.
CURIOUS = {"noise": 0.3, "uniform_share": 0.3}
IDENTITY = (5, "player", 2, 3)


def naive_episode(made: Setup, acting: Policy, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """One episode without any batch: pose arithmetic straight from the definition."""
    layout, sim = made.task.layout, made.task.sim
    goal = layout.corners(sample_poses(layout, sim, rng))
    pose = sample_poses(layout, sim, rng).copy()
    moves = np.zeros(layout.tokens, int)
    corners, placed, actions, rewards = [layout.corners(pose)], [moves >= 1], [], []

    def is_placed(moves: np.ndarray) -> np.ndarray:
        limited = layout.tokens == 1 and sim.actions_per_token > 1
        return (moves >= sim.actions_per_token) & (not limited)

    for _ in range(made.task.spec.horizon):
        flags = is_placed(moves)
        action = acting.explore(corners[-1][None], flags[None], goal[None], [rng])[0]
        token = 0
        if layout.tokens > 1:
            token = min(int((action[0] + 1.0) / 2.0 * layout.tokens), layout.tokens - 1)
        if moves[token] < sim.actions_per_token:
            pose[token] += action[-3:] * np.array([sim.arena, sim.arena, np.pi])
            moves[token] += 1
        corners.append(layout.corners(pose))
        placed.append(is_placed(moves))
        actions.append(action)
        rewards.append(2.0 * covered_share(corners[-1][None], goal[None], layout)[0] - 1.0)
    return {
        "corners": np.array(corners),
        "placed": np.array(placed),
        "actions": np.array(actions),
        "rewards": np.array(rewards),
        "terminated": np.array(placed)[1:].all(axis=1),
        "goals": goal,
    }


@contextmanager
def environment(made: Setup, count: int = 4) -> Iterator[PlaceEnv]:
    with closing(made.task.make(count)) as env:
        yield env


def rolled_out(made: Setup, envs: int, count: int) -> Episodes:
    with environment(made, envs) as env:
        rollout, acting = Rollout(env, made.spec, *IDENTITY), policy(made)
        played = [rollout.play(acting.actor.act, groups) for groups in (1, count // envs - 1)]
        assert rollout.episode == count
    names = played[0].arrays
    return Episodes({n: np.concatenate([one[n] for one in played]) for n in names})


@pytest.mark.parametrize(("tokens", "actions"), [(SQUARE, 1), (SQUARE, 3), (PAIR, 2)])
def test_episodes_equal_a_naive_loop_however_they_are_batched(
    tokens: dict, actions: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The naive loop sets tokens down wherever they are told to.
    monkeypatch.setattr("tangram_sim.batch.MAX_OVERLAP", 1.0)
    made = setup(tokens, CURIOUS, actions_per_token=actions)
    acting = policy(made)
    naive = [naive_episode(made, acting, episode_generator(*IDENTITY, n)) for n in range(16)]
    for envs in (1, 8):
        episodes = rolled_out(made, envs, 16)
        assert {name: column.dtype.name for name, column in episodes.arrays.items()} == {
            **dict.fromkeys(("corners", "actions", "rewards", "goals"), "float32"),
            **dict.fromkeys(("placed", "terminated"), "uint8"),
        }
        assert (np.abs(episodes.actions) <= 1.0).all()
        for number, expected in enumerate(naive):
            for name, column in expected.items():
                # Batches of other sizes round differently in the network's matrix products.
                np.testing.assert_allclose(
                    episodes[name][number], column, atol=2e-5, err_msg=f"{name} of {number}"
                )


@pytest.mark.parametrize(("size", "counts"), [(5, [5, 5, 2]), (12, [12]), (40, [12]), (4, [4] * 3)])
def test_messages_are_parts_of_the_record_in_order(size: int, counts: list[int]) -> None:
    episodes = rolled_out(setup(), envs=4, count=12)
    found = list(parts(episodes, size))
    assert [part.count for part in found] == counts
    for name, column in episodes.arrays.items():
        pieces = [part[name] for part in found]
        np.testing.assert_array_equal(np.concatenate(pieces), column)
        assert all(np.shares_memory(piece, column) for piece in pieces)  # nothing is copied


@pytest.mark.parametrize("camera", [True, False])
def test_as_many_episodes_as_asked_for_in_any_number_of_environments(camera: bool) -> None:
    made = setup(pixels=32 * camera)
    acting = policy(made)
    with environment(made, 3) as env:
        given = env, made.spec, acting.actor.act, np.random.default_rng
        four, six = (Played.of(play(*given, count, facts=True)) for count in (4, 6))
    assert len(four.coverage) == len(four.starts) == four.episodes.count == 4
    np.testing.assert_array_equal(four.corners, six.corners[:4])
    np.testing.assert_array_equal(four.episodes.actions, six.episodes.actions[:4])
    assert (four.camera is None) == (not camera)


@pytest.mark.parametrize(("asked", "groups"), [(0, 0), (1, 0), (2, 1), (3, 1), (4, 2)])
def test_play_ends_before_an_action_when_it_is_told_to(asked: int, groups: int) -> None:
    """What was begun is left out: an episode of two actions is whole after two questions."""
    made = setup(actions_per_token=2)
    answers = iter([True] * asked + [False])
    with environment(made, 3) as env:
        rollout = Rollout(env, made.spec, *IDENTITY)
        episodes = rollout.play(policy(made).actor.act, 5, lambda: next(answers))
    assert episodes.count == rollout.episode == 3 * groups


def test_the_time_of_choices_is_that_of_those_who_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    made, clock = setup(PAIR), iter(range(100))  # a second for each choice
    monkeypatch.setattr("worker.play.rollout.time.process_time", lambda: float(next(clock)))
    with environment(made, 2) as env:
        step = env.step
        ended = np.array([True, False])
        monkeypatch.setattr(env, "step", lambda one: replace(step(one), terminated=ended))
        acting = policy(made).actor.act
        played = play(env, made.spec, acting, lambda i: episode_generator(*IDENTITY, i), 2)
    assert played.chose.tolist() == [0.5, 1.5]


def test_what_the_policy_sees_in_pictures_is_what_travels() -> None:
    made = setup(observe="pictures", pixels=32, backend="physics")
    seen: list[np.ndarray] = []

    def choose(now: Arrays, *_: object) -> Any:
        seen.extend([now["corners"].copy(), now["goals"].copy()])
        return np.zeros((4, 3), np.float32)

    with environment(made) as env:
        whole = play(env, made.spec, choose, np.random.default_rng, 4, facts=True)
    played = Played.of(whole)
    episodes = played.episodes
    np.testing.assert_array_equal(episodes["corners"][:, 0], seen[0].astype(np.float32))
    np.testing.assert_array_equal(episodes["goals"], seen[1].astype(np.float32))
    for found, exact in ((episodes["corners"], played.corners), (episodes["goals"], played.goals)):
        assert np.abs(found - exact).max() > 0.0
        middles = (one.mean(axis=-2) for one in (found, exact))  # alike corners have no names
        np.testing.assert_allclose(*middles, atol=0.05)
