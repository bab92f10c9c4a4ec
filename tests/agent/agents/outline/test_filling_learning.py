"""What an agent of outlines learns from, and how."""

from typing import Any

import numpy as np
import pytest
import shapely
import torch
from shapely.errors import GEOSException

from tangram_agent.agents.outline.filling import MOST_PLACES, UNUSED, Filling, Rests
from tangram_agent.agents.outline.filling_replay import FILLED, OPEN, FillReplay
from tangram_agent.agents.outline.learner import FillLearner
from tangram_agent.agents.outline.values import Corners, features
from tangram_core.agent import NotFiniteError
from tangram_core.errors import RunError
from tangram_core.spec import Episodes
from tests.agent.agents.outline.outlines import TWO, outline_setup, played_in
from tests.agent.builders import learner_of

pytestmark = pytest.mark.fast

MADE = outline_setup(agent={"replay_capacity": 8, "batch_size": 8})
LEG = float(np.sqrt(2.0 * MADE.task.layout.areas[0]))
FAR = [9.0, 9.0, 0.0]
# Two triangles, back to back: they make a square.
HALF = [0.0, 0.0, 0.0]


def other_half() -> list[float]:
    """Where the second triangle lies: turned by half a turn about the longest side's middle."""
    own = MADE.task.layout.corners(np.array([HALF, FAR]))[:3]
    sides = np.linalg.norm(np.roll(own, -1, axis=0) - own, axis=1)
    i = int(sides.argmax())
    middle = (own[i] + own[(i + 1) % 3]) / 2.0
    centre = (
        2.0 * middle
        - MADE.task.layout.poses(MADE.task.layout.corners(np.array([HALF, FAR])))[0, :2]
    )
    return [float(centre[0]), float(centre[1]), float(np.pi)]


GOAL = np.array([HALF, other_half()])


def episode(*last: list[float]) -> Episodes:
    """The first triangle in its place, then the second where it is said."""
    ways = [np.array([FAR, FAR]), np.array([HALF, FAR]), np.array([HALF, *last])]
    return played_in(MADE, ways, GOAL)


def empty() -> FillReplay:
    return FillReplay(MADE.task.layout, capacity=8, copies=3)


def rows(replay: FillReplay) -> dict[str, Any]:
    return replay.state()


def test_a_solved_episode_gives_its_states_and_what_they_could_go_on_to() -> None:
    replay = empty()
    replay.insert(episode(other_half()), np.random.default_rng(0))
    state = rows(replay)
    assert (state["played"], state["filled"]) == ([2], [3])
    assert state["played_left"].tolist() == [[2], [1]]
    # Either diagonal, then the one triangle that is left; both states were filled by play.
    assert state["ends"].tolist() == [[FILLED, OPEN] + [0] * 6, [FILLED] + [0] * 7]
    corners = (state["played_part"] != UNUSED).sum(axis=1)
    assert corners.tolist() == [4, 3]
    # Hindsight: both triangles are a square, each alone a triangle.
    shape = {
        int(left[0]): int((part != UNUSED).sum())
        for left, part in zip(state["filled_left"], state["filled_part"], strict=True)
    }
    assert shape in ({1: 3, 2: 4}, {1: 3}, {2: 4})


def test_what_went_wrong_teaches_up_to_where_it_did() -> None:
    """The second triangle lies beside: its state is learned from, hindsight has the first alone."""
    replay = empty()
    replay.insert(episode([5.0, 5.0, 0.0]), np.random.default_rng(0))
    state = rows(replay)
    assert (state["played"], state["filled"]) == ([2], [3])
    assert state["ends"].tolist() == [[OPEN] * 2 + [0] * 6, [FILLED] + [0] * 7]
    assert set(state["filled_left"].ravel().tolist()) == {1}


def test_nothing_is_learned_after_a_token_lay_beside() -> None:
    ways = [
        np.array([FAR, FAR]),
        np.array([[5.0, 5.0, 0.0], FAR]),
        np.array([[5.0, 5.0, 0.0], HALF]),
    ]
    replay = empty()
    replay.insert(played_in(MADE, ways, GOAL), np.random.default_rng(0))
    assert (rows(replay)["played"], rows(replay)["filled"]) == ([1], [3])


PILED = [np.array([FAR, FAR]), np.array([HALF, FAR]), np.array([HALF, HALF])]


def test_tokens_that_lie_on_each_other_are_no_outline_that_they_fill() -> None:
    replay, generator = empty(), np.random.default_rng(1)
    for _ in range(4):
        replay.insert(played_in(MADE, PILED, GOAL), generator)
    assert set(rows(replay)["filled_left"].ravel().tolist()) == {1}


def test_what_no_tokens_fill_is_never_marked_as_filled() -> None:
    """Both lie where there is room for one: nothing is left to fill, but it was none of theirs."""
    replay = empty()
    replay.insert(played_in(MADE, PILED, np.array([HALF, HALF])), np.random.default_rng(0))
    state = rows(replay)
    assert state["played"] >= 1
    assert not state["ends"].any()


def test_episodes_that_nothing_is_learned_from_do_not_count() -> None:
    replay, nowhere = empty(), [np.array([FAR, FAR])] * 3
    assert replay.insert(played_in(MADE, nowhere, GOAL), np.random.default_rng(0)) == 0
    assert (rows(replay)["played"], rows(replay)["filled"]) == ([0], [0])
    assert replay.insert(episode([5.0, 5.0, 0.0]), np.random.default_rng(0)) == 2


def test_a_full_ring_forgets_the_oldest_and_comes_back_whole() -> None:
    replay, generator = empty(), np.random.default_rng(0)
    for _ in range(6):
        replay.insert(episode(other_half()), generator)
    assert len(replay) == 8
    again = empty()
    again.load_state({name: column.copy() for name, column in replay.state().items()})
    for name, column in replay.state().items():
        assert (again.state()[name] == column).all(), name
    one, other = (r.sample(6, np.random.default_rng(1)) for r in (replay, again))
    assert (one.played.points == other.played.points).all()
    assert (one.ends == other.ends).all()
    assert len(one.filled) == len(one.played) == 3
    assert len(one.places) == 3 * MOST_PLACES


@pytest.mark.parametrize(
    ("column", "value", "reason"),
    [
        ("played_points", np.nan, "within -3"),
        ("filled_follow", 200, "within 0 and 7"),
        ("ends", 7, "within 0 and 2"),
    ],
)
def test_a_damaged_replay_is_refused(column: str, value: float, reason: str) -> None:
    replay = empty()
    replay.insert(episode(other_half()), np.random.default_rng(0))
    state = {name: part.copy() for name, part in replay.state().items()}
    state[column].flat[0] = value
    with pytest.raises(RunError, match=reason):
        empty().load_state(state)


def test_an_empty_replay_cannot_be_sampled() -> None:
    with pytest.raises(ValueError, match="empty"):
        empty().sample(4, np.random.default_rng(0))


def learned() -> tuple[FillLearner, FillReplay]:
    replay = empty()
    replay.insert(episode(other_half()), np.random.default_rng(0))
    replay.insert(episode([5.0, 5.0, 0.0]), np.random.default_rng(0))
    return learner_of(MADE), replay


def test_a_state_is_worth_the_best_that_it_can_go_on_to() -> None:
    """Eq. 5 by hand: 1 where a place fills all, else the target's value, 0 where there is none."""
    learner, replay = learned()
    batch = replay.sample(64, np.random.default_rng(2))
    batch.ends[0] = 0
    targets = learner.values(batch)
    assert targets[0] == 0.0
    for row, ends in enumerate(batch.ends):
        wanted = 0.0
        for i, end in enumerate(ends.tolist()):
            if end == FILLED:
                wanted = max(wanted, 1.0)
            if end == OPEN:
                one = batch.places.at(slice(row * MOST_PLACES + i, row * MOST_PLACES + i + 1))
                with torch.no_grad():
                    wanted = max(
                        wanted, float(learner.targets["critic"](Corners.of(one)).sigmoid()[0])
                    )
        assert float(targets[row]) == pytest.approx(wanted, abs=1e-6)
    assert {0.0, 1.0} < set(targets.tolist())


def test_it_learns_what_can_be_filled() -> None:
    """A square and its half can be, a square with one triangle left, or a strip, cannot."""
    learner, replay = learned()
    generator = np.random.default_rng(4)
    strip = np.zeros((1, 8), np.uint8)
    filling = Filling(outline_setup(TWO).task.layout)
    bar = shapely.box(0, 0, 4 * LEG, LEG / 4)
    for _ in range(150):
        batch = replay.sample(8, generator)
        bad = filling.seen(bar, (2,))
        batch = type(batch)(
            batch.filled,
            Rests.joined([batch.played, bad]),
            Rests.joined([batch.places, *[bad] * MOST_PLACES]),
            np.concatenate([batch.ends, strip]),
        )
        numbers = learner.learn(batch)
    assert numbers["critic_loss"] < 0.2
    with torch.no_grad():
        value = learner.acting(Corners.of(Rests.joined([replay.sample(2, generator).filled, bad])))
    assert value[0] > 1.0
    assert value[1] < -1.0


def test_numbers_that_are_not_finite_are_told() -> None:
    learner, replay = learned()
    with torch.no_grad():
        next(iter(learner.value.parameters())).fill_(np.inf)
    with pytest.raises(NotFiniteError, match="update 1"):
        learner.learn(replay.sample(8, np.random.default_rng(0)))


def test_geometry_that_a_library_trips_over_teaches_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def trip(*_: object) -> None:
        raise GEOSException("TopologyException: side location conflict")

    replay = empty()
    monkeypatch.setattr(Filling, "places", trip)
    replay.insert(episode(other_half()), np.random.default_rng(0))
    monkeypatch.undo()
    replay.insert(episode(other_half()), np.random.default_rng(0))
    assert len(replay) == 2


def test_a_state_in_a_mirror_or_turned_is_as_large_and_its_corners_as_sharp() -> None:
    """Corners, sides and areas stay, and rings still run around what is left."""
    filling = Filling(MADE.task.layout)
    house = shapely.Polygon([(0, 0), (1.3, 0), (1, 0.4), (0.5, 0.9), (0, 0.4)])
    one = Rests.joined([filling.seen(house, (2,))] * 200)
    other = one.turned(np.random.default_rng(0))
    assert len({tuple(np.round(points.ravel(), 3)) for points in other.points}) == 16
    before, after = (features(Corners.of(rests)) for rests in (one, other))
    for column in (8, 9, 10, 11):  # cosine, sine, area, parts
        assert after[..., column] == pytest.approx(before[..., column].numpy(), abs=1e-5)
    sides = (rows[..., 6:8].sum(dim=(1, 2)) for rows in (before, after))
    assert next(sides) == pytest.approx(next(sides).numpy(), abs=1e-5)
