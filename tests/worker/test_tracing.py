"""Agents of outlines that see pictures alone: nothing else reaches what they do, learn and send."""

from contextlib import closing
from typing import Any

import numpy as np
import pytest

from master.trainer import Trainer
from tangram_agent.arrays import EpisodeSpec
from tangram_agent.messages import EpisodeBatch, decode_from_worker
from tangram_agent.policy import Policy
from tangram_agent.setup import Setup
from tangram_agent.types import Episodes
from tangram_sim.areas import overlap
from tangram_sim.batch import BatchedEnv
from tangram_sim.config import RewardConfig
from tangram_sim.errors import ConfigError
from tangram_sim.kinematics import KinematicWorld
from tangram_sim.lens import Disturbance
from tangram_sim.rings import as_area, covered_area
from tangram_vision.tracing import PictureTracer
from tests.agent.outlines import TWO, outline_setup
from worker.looking import environments, make_eye, make_tracer
from worker.rollout import Rollout

pytestmark = pytest.mark.fast


def traced(agent: dict[str, Any] | None = None, **sim: Any) -> Setup:
    return outline_setup(
        TWO, agent, observe="silhouette_pictures", **({"pixels": 64, "picture": "grey"} | sim)
    )


def played(task: Setup, groups: int = 2) -> Episodes:
    with closing(environments(task, 4)) as env:
        return Rollout(env, 0, "player", 0, 0).play(Policy(task).explore, groups)


def test_pieces_leave_no_trace() -> None:
    """A square of two triangles, cut along either diagonal: the same rows, bit for bit."""
    task = traced()
    leg = float(np.sqrt(2.0 * task.layout.areas[0]))
    corner = np.array([[0.0, 0.0], [leg, 0.0], [0.0, leg]]) - leg / 2.0
    cuts = []
    for turn in (0.0, np.pi / 2.0):
        halves = []
        for more in (0.0, np.pi):
            z = (corner @ (1.0, 1j)) * np.exp(1j * (turn + more))
            halves.append(np.column_stack([z.real, z.imag]))
        cuts.append(task.layout.poses(np.concatenate(halves))[None])
    shown = []
    for poses in cuts:
        with closing(environments(task, 1)) as env:
            env.reset([np.random.default_rng(5)], (poses, np.zeros((1, 2), np.bool_)))
            shown.append(env.seen_goals)
            area = as_area(env.seen_goals[0])
            assert overlap(area, covered_area(env.goals[0], task.layout)) > 0.95
    assert np.abs(cuts[0] - cuts[1]).max() > 0.1
    np.testing.assert_array_equal(shown[0], shown[1])


def test_the_same_pictures_give_the_same_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Played again with the pictures of before, in a world that lies of poses."""
    task, tape = traced(), list[Any]()
    takers = {"_picture": BatchedEnv, "portrait": PictureTracer}
    real = {name: getattr(owner, name) for name, owner in takers.items()}
    for name, owner in takers.items():
        take = real[name]
        monkeypatch.setattr(owner, name, lambda *of, take=take: tape.append(take(*of)) or tape[-1])
    whole = played(task)
    shown = iter(tape)
    for name, owner in takers.items():
        monkeypatch.setattr(owner, name, lambda *_: next(shown))
    poses, noise = KinematicWorld.poses, np.random.default_rng(9)
    monkeypatch.setattr(
        KinematicWorld, "poses", lambda world: poses(world) + noise.normal(0, 0.2, (2, 3))
    )
    monkeypatch.setattr(BatchedEnv, "_covered", lambda env, _: noise.uniform(0, 1, env.count))
    other = played(task)
    assert whole.arrays.keys() == other.arrays.keys() > {"achieved", "seen"}
    for name, column in whole.arrays.items():
        np.testing.assert_array_equal(column, getattr(other, name), err_msg=name)


def test_what_tokens_came_to_cover_is_traced_and_travels() -> None:
    task = traced()
    with closing(environments(task, 4)) as env:
        episodes = Rollout(env, 0, "player", 0, 0).play(Policy(task).explore, 1)
        for corners, rows in zip(env.corners, np.asarray(episodes.achieved), strict=True):
            assert overlap(as_area(rows), covered_area(corners, task.layout)) > 0.93
    spec = EpisodeSpec.of(task)
    arrived = decode_from_worker(EpisodeBatch(1, 0, episodes).encode(spec), spec).episodes
    np.testing.assert_array_equal(arrived.achieved, episodes.achieved)
    assert arrived.goals_seen is not None
    assert (arrived.goals_seen == 1).all()
    assert [one.name for one in spec.columns(1)][-1] == "achieved"
    assert "achieved" not in {one.name for one in EpisodeSpec.of(outline_setup()).columns(1)}


def test_a_master_learns_from_them() -> None:
    task = traced({"learning_starts": 8, "batch_size": 8, "replay_capacity": 64})
    trainer = Trainer(task, 0, "cpu")
    trainer.insert(played(task, 4))
    assert 8 <= trainer.rate_limiter.transitions <= 32
    losses = [trainer.update(0.1)["critic_loss"] for _ in range(3)]
    assert np.isfinite(losses).all()


def test_who_does_not_look_cannot_play() -> None:
    task = traced()
    for given in ((None, True), (make_eye(task), True)):
        with pytest.raises(ConfigError, match=r"sim.observe=silhouette_pictures is for tangram-"):
            BatchedEnv(task.layout, task.sim, RewardConfig(), 1, *given)
    assert make_tracer(outline_setup()) is None


def shown(count: int = 2, **sim: Any) -> Any:
    """Rows of the same targets, as environments with this camera see them."""
    task = traced(**sim)
    poses = np.tile([[[0.0, 0.0, 0.3], [0.6, 0.1, 1.0]]], (count, 1, 1))
    with closing(environments(task, count)) as env:
        generators = [np.random.default_rng(i) for i in range(count)]
        env.reset(generators, (poses, np.zeros((count, 2), np.bool_)))
        return env.seen_goals


@pytest.mark.parametrize("noise", [0.0, 8.0])
def test_outlines_are_traced_in_what_the_lens_makes_of_them(
    monkeypatch: pytest.MonkeyPatch, noise: float
) -> None:
    """Each in the picture of it, with the noise that the camera has, and no other."""
    drawn, looked_at = list[Any](), list[Any]()
    draw, trace = PictureTracer.portrait, PictureTracer.trace
    monkeypatch.setattr(PictureTracer, "portrait", lambda *of: drawn.append(draw(*of)) or drawn[-1])
    monkeypatch.setattr(
        PictureTracer,
        "trace",
        lambda own, picture, one: looked_at.append(picture) or trace(own, picture, one),
    )
    monkeypatch.setattr("tangram_sim.lens.FULL", Disturbance(noise=8.0))
    shown(disturbance=noise / 8.0)
    assert len(drawn) == len(looked_at) == 2
    for before, after in zip(drawn, looked_at, strict=True):
        off = after.astype(float) - before
        assert (np.abs(off).max() > 10.0) == (noise > 0.0)
        assert np.abs(off).mean() < noise + 1e-9


def test_each_episode_has_a_camera_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Turned to one side or the other, as each draws: the same target at other angles."""
    monkeypatch.setattr("tangram_sim.lens.FULL", Disturbance(turn=10.0))
    sides = []
    for rows in shown(8, disturbance=1.0, pixels=128):
        z = (rows[:3] - rows[0]) @ (1.0, 1j)
        sides.append(float(np.angle(z[1]) % (np.pi / 4)))
    assert max(sides) - min(sides) > np.radians(10.0)


def test_what_is_achieved_is_taken_by_the_camera_not_put_together_from_what_was_seen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    task, areas = traced(), list[Any]()
    real = PictureTracer.portrait
    monkeypatch.setattr(PictureTracer, "portrait", lambda *of: areas.append(of[1]) or real(*of))
    with closing(environments(task, 1)) as env:
        env.reset([np.random.default_rng(0)])
        _ = env.achieved
        true = covered_area(env.corners[0], task.layout)
        assert areas[-1].equals(true)
        assert not areas[-1].equals(covered_area(env.seen[0], task.layout))


def test_a_camera_that_stands_elsewhere_teaches_nothing() -> None:
    with pytest.raises(ConfigError, match=r"^sim.disturbance=0.5: .*set sim.disturbance=0$"):
        traced(disturbance=0.5).check_learnable()
    traced().check_learnable()
