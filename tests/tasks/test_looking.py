"""Agents that see pictures alone: nothing exact reaches what they do, learn and send."""

from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tangram_agent.base.relabelling import learnable
from tangram_core.errors import ConfigError
from tangram_core.setup import Setup, make_setup
from tangram_core.spec import Episodes
from tangram_core.wire.messages import EpisodeBatch, decode_from_worker
from tangram_sim.batch import BatchedEnv
from tangram_sim.motion.kinematics import KinematicWorld
from tests.agent.builders import Policy
from worker.play.rollout import Rollout

pytestmark = pytest.mark.fast


def setup(*shapes: str, **sim: Any) -> Setup:
    return make_setup(
        {
            "task": {"kind": "place"},
            "tokens": {"shapes": list(shapes), "scale": 0.8},
            "sim": {"backend": "kinematic", "pixels": 64, "observe": "pictures", **sim},
            "reward": {},
            "agent": {"kind": "pair", "uniform_share": 0.25},
            "net": {"width": 8, "layers": 1, "feed_forward": 8},
        }
    )


def played(task: Setup, policy: Policy, groups: int = 2) -> Episodes:
    with closing(task.task.make(4)) as env:
        return Rollout(env, task.spec, 0, "player", 0, 0).play(policy.actor.act, groups)


def at_random(task: Setup) -> Setup:
    """All actions are uniform, whatever the untrained weights are: they decide what is seen."""
    config = replace(task.agent.config, uniform_share=1.0)
    return replace(task, agent=replace(task.agent, config=config))


def noisy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever asks environments for what is exact gets noise."""
    noise = np.random.default_rng(9)
    for name in ("corners", "goals"):
        monkeypatch.setattr(
            BatchedEnv,
            name,
            property(
                lambda env, name=name: noise.normal(0, 1, env.__dict__[name].shape),
                lambda env, value, name=name: env.__dict__.__setitem__(name, value),
            ),
            raising=False,
        )


@pytest.mark.parametrize("shapes", [("square",), ("square", "large_triangle", "parallelogram")])
def test_nothing_exact_leaks(monkeypatch: pytest.MonkeyPatch, shapes: tuple[str, ...]) -> None:
    """With noise in the place of exact corners and goals all that travels is the same."""
    task = setup(*shapes)
    policy = Policy(task)
    whole = played(task, policy)
    noisy(monkeypatch)
    other = played(task, policy)
    assert other.arrays.keys() == whole.arrays.keys() > {"seen", "goals_seen"}
    for name, column in whole.arrays.items():
        np.testing.assert_array_equal(column, other[name], err_msg=name)


@pytest.mark.parametrize("shapes", [("square",), ("small_triangle", "small_triangle", "square")])
def test_the_same_pictures_give_the_same_episodes(
    monkeypatch: pytest.MonkeyPatch, shapes: tuple[str, ...]
) -> None:
    """Played again with the pictures of before, in a world that lies of poses and blocks."""
    task = setup(*shapes)
    policy, take, tape = Policy(task), KinematicWorld.picture, list[Any]()
    monkeypatch.setattr(KinematicWorld, "picture", lambda *of: tape.append(take(*of)) or tape[-1])
    whole = played(task, policy)
    noise, shown = np.random.default_rng(9), iter(tape)
    monkeypatch.setattr(KinematicWorld, "picture", lambda *of: [take(*of), next(shown)][1])
    monkeypatch.setattr(BatchedEnv, "_covered", lambda env, *_: noise.uniform(0, 1, env.count))
    poses = KinematicWorld.poses
    lie = lambda world: poses(world) + noise.normal(0, 1, poses(world).shape)  # noqa: E731
    monkeypatch.setattr(KinematicWorld, "poses", lie)
    other = played(task, policy)
    for name, column in whole.arrays.items():
        np.testing.assert_array_equal(column, other[name], err_msg=name)
    assert tape
    assert next(shown, None) is None


def test_what_is_seen_is_near_and_the_reward_is_that_of_pictures() -> None:
    task = setup("square", pixels=128)
    with closing(task.task.make(4)) as own:
        env = own.world
        env.reset([np.random.default_rng(i) for i in range(4)])
        off = task.task.layout.bases(env.seen) - task.task.layout.bases(env.corners)
        assert 0.0 < np.abs(off).max() < 0.005
        gap = task.task.layout.bases(env.seen_goals) - task.task.layout.bases(env.goals)
        assert 0.0 < np.abs(gap).max() < 0.005
        way = (task.task.layout.bases(env.seen_goals) - task.task.layout.bases(env.seen))[
            :, 0
        ] / 2.0
        result = env.step(np.column_stack([way, np.zeros(4)]))
        np.testing.assert_array_equal(result.rewards, result.camera_rewards)
        assert np.abs(result.rewards - (2.0 * result.coverage - 1.0)).max() > 1e-4


def test_alike_tokens_are_moved_where_they_are_seen() -> None:
    task = setup("small_triangle", "small_triangle")
    with closing(task.task.make(6)) as own:
        env = own.world
        env.reset([np.random.default_rng(i) for i in range(6)])
        assert not env.sight.missing.any()
        before = task.task.layout.bases(env.seen)
        action = np.tile([1.0, 0.05, 0.0, 0.0], (6, 1))  # the second token, a little to the right
        env.step(action)
        moved = task.task.layout.bases(env.seen) - before
        sure = ~env.sight.missing.any(axis=1)
        assert sure.sum() >= 4
        np.testing.assert_allclose(moved[sure, 1], [[0.1, 0.0]] * sure.sum(), atol=0.02)
        np.testing.assert_allclose(moved[sure, 0], 0.0, atol=0.02)


def test_what_is_missing_travels_and_is_not_learned_from() -> None:
    task = at_random(setup("small_triangle", actions_per_token=5))
    episodes = played(task, Policy(task), 4)
    spec = task.spec
    frames = EpisodeBatch(1, 0, episodes).encode(spec)
    arrived = decode_from_worker(frames, spec).episodes
    np.testing.assert_array_equal(arrived["seen"], episodes["seen"])
    gone = ~np.asarray(episodes["seen"]).all(axis=(1, 2))
    assert 0 < gone.sum() < len(gone)  # random actions leave the picture
    seen = learnable(arrived)
    np.testing.assert_array_equal(seen["corners"], episodes["corners"][~gone])
    exact = Episodes({n: a for n, a in episodes.arrays.items() if n != "seen"})
    assert learnable(exact).count == len(gone)


def test_without_an_eye_pictures_are_refused() -> None:
    task = setup("square")
    with pytest.raises(ConfigError, match="^sim.observe=pictures needs an eye, .*corners$"):
        BatchedEnv(task.task.layout, task.task.sim, task.task.reward)
