"""The agent of pushes: geometry, what networks see, what is learned from, and that it learns."""

from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from shapely.geometry import Point, Polygon

import tangram_agent.agents.push.actor as actor_module
from tangram_agent.agents.push.actor import PushActor
from tangram_agent.agents.push.agent import Pushing, PushingConfig
from tangram_agent.agents.push.choosing import Search
from tangram_agent.agents.push.learner import Batch, PushLearner, PushReplay
from tangram_agent.agents.push.scenes import PUSHES, Scene, Tokens, distance, gap, rotated
from tangram_agent.agents.push.seen import beside, pushes, seen_by
from tangram_agent.runs import beginning
from tangram_core.agent import Learner
from tangram_core.conformance import check_agent, play
from tangram_core.errors import ConfigError
from tangram_core.seeding import episode_generator
from tangram_core.task import Generators, History, Played
from tangram_sim.geometry.layout import TokensConfig
from tangram_tasks.push.places import on_table, push_of
from tangram_tasks.push.task import Push, PushConfig
from tangram_tasks.push.trials import Trials, middle
from tests.agent.builders import PAIR, setup
from tests.sim.builders import SEVEN

pytestmark = pytest.mark.fast

CPU = torch.device("cpu")
SMALL = PushingConfig(width=8, batch_size=16, learning_starts=16, replay_capacity=200, looked_at=4)
SQUARE = Push(TokensConfig(("square",), 1.1))
TWO = Push(TokensConfig(("square", "small_triangle"), 1.1))
SOME = Push(TokensConfig(tuple(SEVEN), 0.6), PushConfig(count=3))


def generators(role: str, first: int, count: int) -> Generators:
    return [episode_generator(0, role, 0, 0, first + i) for i in range(count)]


def now(corners: np.ndarray) -> History:
    return History({"corners": corners[:, None]}, np.zeros((len(corners), 0, 4), np.float32))


def tried(
    actor: PushActor, corners: np.ndarray, goals: np.ndarray, actions: np.ndarray
) -> torch.Tensor:
    possible = np.ones(actions.shape[:2], np.bool_)
    return actor._tried(corners, goals, actions, possible, now(corners))


def played(task: Push, learner: Learner, agent: Pushing, count: int = 6) -> Played:
    actor = agent.actor(task)
    actor.load(learner.broadcast())
    with closing(task.make(count)) as env:
        return play(task, env, generators("play", 0, count), actor.act)


@pytest.mark.parametrize("task", [SQUARE, TWO, SOME], ids=["one", "two", "three of seven"])
def test_it_keeps_the_promises_of_an_agent(task: Push) -> None:
    check_agent(Pushing(SMALL), task)


def test_it_learns_pushes_alone() -> None:
    with pytest.raises(ConfigError, match="agent=push learns only task=push, got task=place"):
        Pushing().check(setup(PAIR).task)


def test_distances_and_gaps_are_those_of_polygons() -> None:
    tokens, rng = Tokens(SOME, CPU), np.random.default_rng(0)
    which = torch.from_numpy(rng.integers(7, size=(2, 300)))
    poses = torch.from_numpy(rng.uniform(-1, 1, (2, 300, 3)) * (0.4, 0.4, np.pi)).float()
    points = torch.from_numpy(rng.uniform(-0.5, 0.5, (300, 2))).float()
    some, others = (tokens.laid(poses[i], which[i]) for i in range(2))
    far, between = distance(some, points.T), gap(some, others)
    shapes = [[Polygon(one) for one in every.permute(2, 1, 0).numpy()] for every in (some, others)]
    for i, (one, other) in enumerate(zip(*shapes, strict=True)):
        assert far[i] == pytest.approx(one.distance(Point(points[i].numpy())), abs=1e-5)
        if one.intersects(other):
            assert between[i] <= 1e-5
        else:
            assert -1e-5 <= between[i] <= one.distance(other) + 1e-5


def scene(task: Push, count: int) -> Scene:
    with closing(task.make(count)) as env:
        seen = env.reset(generators("test", 0, count))
        return Tokens(task, CPU).scene(seen["corners"], seen["goals"])


def moved(scene: Scene, angle: float, x: float, y: float) -> Scene:
    """The same, elsewhere on the table."""
    turn = torch.full(scene.poses.shape[:2], angle)

    def there(poses: torch.Tensor) -> torch.Tensor:
        place = rotated(poses[..., :2], turn) + torch.tensor([x, y])
        return torch.cat([place, poses[..., 2:] + angle], dim=-1)

    return replace(scene, poses=there(scene.poses), goals=there(scene.goals))


def test_what_is_seen_hangs_on_no_frame_but_the_tokens_own() -> None:
    tokens, found = Tokens(TWO, CPU), scene(TWO, 5)
    slots = torch.tensor([0, 1, 0, 1, 0])

    def views(of: Scene) -> tuple[torch.Tensor, torch.Tensor]:
        seen = seen_by(tokens, of, slots, 1 - slots)
        return seen.token[:, :-1], seen.other  # but how near the edge is

    for here, there in zip(views(found), views(moved(found, 2.0, 0.1, -0.2)), strict=True):
        torch.testing.assert_close(here, there, atol=1e-4, rtol=1e-4)


def test_a_token_that_is_not_there_is_not_seen() -> None:
    tokens, agent = Tokens(TWO, CPU), Pushing(SMALL)
    critic = agent.learner(TWO, 0, "cpu").critic  # type: ignore[attr-defined]
    found = scene(TWO, 4)
    gone = replace(found, present=torch.tensor([[True, False]]).expand(4, 2))
    poses = gone.poses.clone()
    poses[:, 1] += 5.0
    slots, zeros = torch.zeros(4, dtype=torch.int64), torch.zeros(4, 1, 22)
    values = [
        critic(seen_by(tokens, one, slots, slots + 1), zeros)
        for one in (gone, replace(gone, poses=poses))
    ]
    torch.testing.assert_close(values[0], values[1])


def test_beside_a_token_is_what_lies_nearest_to_it_or_to_its_place() -> None:
    found = scene(SOME, 1)
    places = torch.tensor([[[-0.5, 0.0, 0.0], [0.1, 0.0, 0.0], [0.6, 0.0, 0.0]]])
    found = replace(found, poses=places, goals=places)
    slots = torch.arange(3)

    def nearest(one: Scene) -> list[int]:
        return beside(one.repeated(3), slots).tolist()

    assert nearest(found) == [1, 2, 1]
    goals = places.clone()
    goals[0, 1, 0] = -0.4  # the middle one must come beside the first
    assert nearest(replace(found, goals=goals)) == [1, 0, 1]
    gone = replace(found, present=torch.tensor([[True, False, True]]))
    assert nearest(gone)[0] == 2


def test_pushes_near_tokens_in_their_places_are_told_from_those_near_others() -> None:
    tokens, found = Tokens(TWO, CPU), scene(TWO, 6)
    poses = found.poses.clone()
    poses[:, 0], poses[:, 1] = torch.tensor([0.0, 0.0, 0.0]), torch.tensor([0.3, 0.0, 0.0])
    slots, others = torch.zeros(6, dtype=torch.int64), torch.ones(6, dtype=torch.int64)
    which = torch.arange(PUSHES).expand(6, -1)
    own = found.which[:, :1]

    def near(goals: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        seen = seen_by(tokens, replace(found, poses=poses, goals=goals), slots, others)
        ways = tokens.begins[own, which], tokens.ends[own, which]
        numbers = pushes(tokens, seen, *ways, torch.zeros(6, PUSHES, 3))[0]
        return numbers[..., -8:-4], numbers[..., -4:]

    placed, other = near(poses)
    assert (other == 1.0).all()
    assert placed.min() < -0.3
    away, left = near(poses + 0.5)
    assert (away == 1.0).all()
    torch.testing.assert_close(left, placed)


def test_pushes_that_are_looked_at_are_those_that_the_table_makes() -> None:
    """Where the finger comes down, and what refuses it."""
    task, tokens = SOME, Tokens(SOME, CPU)
    rng, count = np.random.default_rng(1), 40
    with closing(task.make(count)) as env:
        seen = env.reset(generators("test", 0, count))
    corners = seen["corners"]
    found = tokens.scene(corners, seen["goals"])
    slots = torch.from_numpy(rng.integers(3, size=count))
    view = seen_by(tokens, found, slots, beside(found, slots))
    which = torch.from_numpy(rng.integers(PUSHES, size=(count, 30)))
    own = view.which[:, None]
    begins, ends = tokens.begins[own, which], tokens.ends[own, which]
    never = pushes(tokens, view, begins, ends, torch.zeros(count, 30, 3))[1]
    refused = 0
    for row in range(count):
        for i in range(30):
            action = tokens.actions[int(view.which[row]), int(which[row, i])]
            push = push_of(task.layout, corners[row], action, 0.04, task.config.longest)
            refused += bool(push.refused)
            if push.refused:
                assert never[row, i]
                continue
            angle, place = view.pose[row, 2], view.pose[row, :2]
            there = rotated(begins[row, i], angle) + place
            np.testing.assert_allclose(there.numpy(), push.begin, atol=1e-4)
            # The table cuts short what would leave it; the agent never asks for that.
            if not never[row, i]:
                way = rotated(ends[row, i] - begins[row, i], angle)
                np.testing.assert_allclose(way.numpy(), push.way, atol=1e-4)
    assert 10 < refused < 600


def test_a_push_that_is_tried_in_the_engine_is_known_to_lead_home() -> None:
    actor = Pushing(SMALL).actor(TWO)
    assert isinstance(actor, PushActor)
    with closing(TWO.make(3)) as env:
        corners = env.reset(generators("test", 0, 3))["corners"]
        goals = corners.copy()
        home = [[-0.9, 0.1, 0.3], [-0.1, 0.2, -0.3], [0.6, -0.3, 0.3]]  # pushes of the square
        actions = np.tile([0.7, 0.4, 0.5, 0.9], (3, 4, 1))  # others, of the triangle
        trials, place = Trials(TWO), [1, 3, 0]
        for table in range(3):
            actions[table, place[table]] = -0.5, *home[table]
            trials.begin(corners[table], goals[table], middle(TWO))
            after = trials.after(actions[table, place[table]])
            assert after is not None
            goals[table] = after
    assert not TWO.placed(corners, goals).all(axis=1).any()
    assert tried(actor, corners, goals, actions).tolist() == place


def test_pushes_of_every_token_that_is_not_in_place_are_tried() -> None:
    actor = Pushing(SMALL).actor(SOME)
    assert isinstance(actor, PushActor)
    actor.load(Pushing(SMALL).learner(SOME, 0, "cpu").broadcast())
    found = scene(SOME, 5)
    goals = found.goals.clone()
    goals[:, 1] = found.poses[:, 1]
    found = replace(found, goals=goals)
    drawn = torch.arange(PUSHES).expand(15, -1)
    _, slots, _ = actor._best(found, actor._pairs(found), Search(drawn, 40, most=12))
    assert all(set(row) == {0, 2} for row in slots.tolist())


def test_a_push_that_the_engine_refuses_is_not_the_best_though_it_harms_nothing() -> None:
    actor, layout = Pushing(SMALL).actor(TWO), TWO.layout
    assert isinstance(actor, PushActor)
    corners = layout.corners(np.array([[[0.78, 0.0, 0.0], [-0.4, 0.0, 0.0]]]))
    goals = layout.corners(np.array([[[0.78, 0.0, 0.0], [-0.4, 0.6, 1.0]]]))
    trials, rng = Trials(TWO), np.random.default_rng(0)
    trials.begin(corners[0], goals[0], middle(TWO))
    refused, harms = list[np.ndarray](), list[np.ndarray]()
    while not (refused and harms):  # of the square, which is in its place at the table's edge
        push = np.append(-0.5, rng.uniform(-1.0, 1.0, 3))
        after = trials.after(push)
        if after is None:
            refused.append(push)
        elif not TWO.placed(after[None], goals)[0, 0]:
            harms.append(push)
    actions = np.stack([refused[0], harms[0]])[None]
    assert tried(actor, corners, goals, actions).tolist() == [1]


def test_where_all_is_in_place_nothing_is_left_to_go() -> None:
    actor, found = Pushing(SMALL).actor(SOME), scene(SOME, 3)
    assert isinstance(actor, PushActor)
    some = torch.tensor([True, False, True]).expand(3, -1)
    assert not actor._values(replace(found, goals=found.poses), some).any()
    assert ((actor._values(found, some) < 0.0) == some).all()


def test_tokens_that_are_not_next_are_pushed_only_where_no_other_can_be() -> None:
    actor = Pushing(SMALL).actor(SOME)
    assert isinstance(actor, PushActor)
    actor.load(Pushing(SMALL).learner(SOME, 0, "cpu").broadcast())
    found = scene(SOME, 4)
    drawn = torch.arange(PUSHES).expand(12, -1)
    eligible = torch.tensor([[False, True, True], [True, False, False]] * 2)
    search = Search(drawn, 40, 8, eligible)
    _, slots, _ = actor._best(found, actor._pairs(found), search)
    assert [set(row) for row in slots.tolist()] == [{1, 2}, {0}] * 2
    found.poses[0, 1:, 0] = found.poses[2, 1:, 0] = 1.5  # out of the finger's reach
    _, slots, _ = actor._best(found, actor._pairs(found), search)
    assert [set(row) for row in slots.tolist()] == [{0}, {0}] * 2


def test_the_largest_random_number_names_the_last_token_and_push() -> None:
    class Largest(np.random.Generator):
        def random(self, size: int) -> np.ndarray:  # type: ignore[override]
            return np.full(size, np.nextafter(1.0, 0.0))

    actor = Pushing(replace(SMALL, uniform_share=1.0)).actor(SOME)
    assert isinstance(actor, PushActor)
    actor.load(Pushing(SMALL).learner(SOME, 0, "cpu").broadcast())
    with closing(SOME.make(1)) as env:
        seen = env.reset(generators("test", 0, 1))
    action = actor.act(seen, beginning(SOME.spec, seen), [Largest(np.random.PCG64(0))])
    last = np.flatnonzero(on_table(seen["goals"], SOME.layout)[0])[-1]
    np.testing.assert_array_equal(action[0], actor._tokens.actions[last, -1].astype(np.float32))


def test_that_token_is_pushed_that_comes_next(monkeypatch: pytest.MonkeyPatch) -> None:
    for times in (1, 1000):  # more are tried than the one token has
        actor = Pushing(replace(SMALL, tried=times)).actor(SOME)
        actor.load(Pushing(SMALL).learner(SOME, 0, "cpu").broadcast())
        with closing(SOME.make(3)) as env:
            seen = env.reset(generators("test", 0, 3))
        there = on_table(seen["goals"], SOME.layout)
        for place in range(3):
            following = np.stack([np.arange(7) == np.flatnonzero(row)[place] for row in there])
            rows = iter(following)
            monkeypatch.setattr(actor_module, "come_next", lambda *_, rows=rows: next(rows))
            actions = actor.act(seen, now(seen["corners"]))
            pushed = ((actions[:, 0] + 1.0) / 2.0 * 7).astype(int)
            assert pushed.tolist() == following.argmax(1).tolist()


def test_what_has_been_before_is_not_sought_again(monkeypatch: pytest.MonkeyPatch) -> None:
    def nearer(self: PushActor, scene: Scene, wanted: torch.Tensor) -> torch.Tensor:
        far: torch.Tensor = (scene.goals - scene.poses)[..., :2].norm(dim=-1)
        return torch.where(wanted, -far, 0.0)

    monkeypatch.setattr(PushActor, "_values", nearer)
    actor = Pushing(SMALL).actor(TWO)
    assert isinstance(actor, PushActor)
    with closing(TWO.make(1)) as env:
        seen = env.reset(generators("test", 0, 1))
    corners, goals = seen["corners"], seen["goals"]
    pushes = [-0.5, -0.9, 0.1, 0.3], [-0.5, -0.1, 0.2, -0.3]
    actions, possible = np.array([pushes]), np.ones((1, 2), np.bool_)
    trials = Trials(TWO)
    trials.begin(corners[0], goals[0], middle(TWO))
    after = trials.after(actions[0, 0])
    assert after is not None
    past = now(corners)
    for away, before, chosen in ((0.04, False, 0), (0.04, True, 1), (0.02, True, 0)):
        goals = after[None] + np.array([away, 0.0])  # in its place from 0.03 on
        past.seen["corners"] = np.stack([after if before else corners[0], corners[0]])[None]
        assert actor._tried(corners, goals, actions, possible, past).tolist() == [chosen]
    assert actor._tried(corners, goals, actions, ~np.array([[True, False]]), past).tolist() == [1]


def test_a_push_that_did_nothing_is_not_made_again() -> None:
    actor = Pushing(replace(SMALL, tried=8)).actor(TWO)
    actor.load(Pushing(SMALL).learner(TWO, 0, "cpu").broadcast())
    with closing(TWO.make(1)) as env:
        seen = env.reset(generators("test", 0, 1))
    corners = seen["corners"][:, None]
    first = actor.act(seen, now(seen["corners"]))
    for moved, again in ((0.0, False), (0.5, True)):  # by what the push may have moved all
        before = np.concatenate([corners - moved, corners], axis=1)
        then = actor.act(seen, History({"corners": before}, first[:, None]))
        assert np.array_equal(then, first) == again


def test_no_more_pushes_are_tried_than_there_are() -> None:
    actor = Pushing(replace(SMALL, tried=1000)).actor(SQUARE)
    with closing(SQUARE.make(1)) as env:
        seen = env.reset(generators("test", 0, 1))
    assert actor.act(seen, now(seen["corners"])).shape == (1, 4)


def test_hindsight_takes_whole_tokens_of_what_was_reached() -> None:
    replay, layout = PushReplay(SOME, 100), SOME.layout
    shape = (200, layout.corner_count, 2)
    desired, reached = np.zeros(shape, np.float32), np.ones(shape, np.float32)
    found = replay.relabelled(desired, reached, np.random.default_rng(0))
    tokens = [found[:, layout.corners_of(k)].reshape(200, -1) for k in range(7)]
    for token in tokens:
        assert (token == token[:, :1]).all()
    whole = np.stack([token[:, 0] for token in tokens], axis=1).all(axis=1)
    assert 110 < whole.sum() < 170


def test_targets_pay_and_end_as_the_task_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a discount of 0 and of 1 for a value of -1."""
    loose = Push(TWO.tokens, replace(TWO.config, within=0.3, turned=1.5))
    learner, seen, (rows, steps, desired) = learned_from(loose, monkeypatch)
    targets = learner._target(seen).numpy()
    achieved = learner.replay.arrays["corners"][rows, steps + 1]
    ended = loose.ended(achieved, desired, np.zeros(100, bool))
    expected = loose.rewards(achieved, desired) - 0.9 * ~ended
    assert 5 < ended.sum() < 95
    np.testing.assert_allclose(targets, expected, atol=1e-6)


def test_of_three_tokens_a_pair_is_paid_and_a_third_that_is_pushed_away_costs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    learner, seen, _ = learned_from(SOME, monkeypatch)
    poses, rows = torch.zeros(100, 3, 3), torch.arange(100)
    third = 3 - seen.slots - seen.others
    seen = replace(seen, poses=poses, goals=poses, following=poses.clone())
    assert (learner._target(seen) == 0.0).all()  # both are in place: the end
    seen.following[rows, third, 0] = 0.5
    assert (learner._target(seen) == -2.0).all()
    seen.following[rows, seen.slots, 0] = 0.5
    torch.testing.assert_close(learner._target(seen), torch.full((100,), -2.0 - 0.5 - 0.9))


def learned_from(task: Push, monkeypatch: pytest.MonkeyPatch) -> tuple[PushLearner, Batch, Any]:
    """A learner that holds the following for worth -1, a batch, and what was drawn for it."""
    agent = Pushing(replace(SMALL, gamma=0.9, batch_size=100, relabel_share=0.9))
    learner = agent.learner(task, 0, "cpu")
    assert isinstance(learner, PushLearner)
    rng = {name: np.random.default_rng(i) for i, name in enumerate(learner.streams)}
    learner.insert(played(task, learner, agent).episodes, rng)
    found = learner.replay.chosen(learner.config, rng)
    monkeypatch.setattr(learner.replay, "chosen", lambda *_: found)
    monkeypatch.setattr(
        "tangram_agent.agents.push.learner.best",
        lambda *_: (torch.full((100, 1), -1.0), None, None),
    )
    return learner, learner.drawn(rng), found


def test_a_pair_without_goals_on_the_table_has_a_finite_target(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No honest play shows one, but the bounds of what a worker may send allow it."""
    learner, seen, _ = learned_from(SOME, monkeypatch)
    seen = replace(seen, present=torch.zeros_like(seen.present))
    assert torch.isfinite(learner._target(seen)).all()
