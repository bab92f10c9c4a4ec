"""Films of several tokens: who is in the hand, how high, where, and on which side."""

from dataclasses import replace

import numpy as np
import pytest

from tangram_game.show.film import film, frames_per_action
from tangram_tasks.place import Place
from tangram_tasks.played import Played
from tests.agent.builders import setup
from tests.sim.builders import layout_of
from tests.worker.builders import ended

pytestmark = pytest.mark.fast

TWO = {"shapes": ["square", "parallelogram"], "scale": 0.8}
LAYOUT = layout_of(*TWO["shapes"], scale=0.8)
STARTS = np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])
COUNT = frames_per_action(2)


def played(
    second: tuple[float, float, float],
    flip: bool = False,
    refused: bool = False,
    blocked: bool = False,
) -> tuple[Place, Played]:
    """The square is moved up by 0.4; then the parallelogram, by the second action."""
    made = setup(TWO, allow_flip=True).task
    actions = np.array([[-0.5, -1.0, 0.0, 0.2, 0.0], [0.5, 1.0 if flip else -1.0, *second]])
    middle = STARTS + [[0.0, 0.4, 0.0], [0.0, 0.0, 0.0]]
    way = np.array(second) * [2.0, 2.0, np.pi] * (not (refused or blocked))
    end = middle + [[0.0, 0.0, 0.0], way]
    sides = np.array([[False, False], [False, False], [False, flip and not blocked]])
    corners = LAYOUT.corners(np.stack([STARTS, middle, end]), sides)[None]
    stops = {
        "refused": np.array([[False, refused]]),
        "blocked": np.array([[False, blocked]]),
        "actions": actions[None].astype(np.float32),
    }
    return made, ended(LAYOUT, corners, corners[:, -1], **stops)


def test_one_token_after_the_other_is_in_the_hand_and_none_at_the_ends() -> None:
    frames = film(*played((0.1, -0.2, 0.5)))
    held = [int(frame.held[0]) for frame in frames]
    assert held == [-1, *[0] * COUNT, *[1] * COUNT, -1]
    assert [frame.done for frame in frames] == [0] * COUNT + [1] * COUNT + [2] * 2


def test_frames_begin_and_end_where_the_episode_did() -> None:
    made, episode = played((0.1, -0.2, 0.9))
    frames = film(made, episode)
    for frame, step in ((frames[0], 0), (frames[COUNT], 1), (frames[-1], 2)):
        np.testing.assert_allclose(frame.corners(LAYOUT), episode.corners[:, step], atol=1e-9)
    half = frames[COUNT + COUNT // 2]
    expected = (episode.corners[:, 1] + episode.corners[:, 2]).mean(axis=1) / 2.0
    centre = half.corners(LAYOUT)[0].mean(axis=0)
    np.testing.assert_allclose(centre, expected[0], atol=1e-2)


def test_what_is_carried_rises_and_comes_down() -> None:
    heights = [frame.height for frame in film(*played((0.1, -0.2, 0.5)))]
    assert max(heights) == pytest.approx(1.0, abs=0.01)
    assert [heights[i] for i in (0, COUNT, 2 * COUNT, -1)] == [0.0] * 4


def test_others_wait_for_what_is_carried() -> None:
    made, episode = played((0.0, 0.2, 0.0))
    corners = episode.corners.copy()
    corners[:, 1, LAYOUT.corners_of(1)] += 0.1  # the square's landing pushes the parallelogram
    pushed = replace(episode, corners=corners)
    other = LAYOUT.corners_of(1)
    before, landed = (film(made, pushed)[i].corners(LAYOUT)[0, other] for i in (COUNT - 1, COUNT))
    np.testing.assert_allclose(before, corners[0, 0, other], atol=1e-9)
    np.testing.assert_allclose(landed, corners[0, 1, other], atol=1e-9)


def test_a_refused_action_shows_nothing_in_the_hand() -> None:
    frames = film(*played((0.1, -0.2, 0.5), refused=True))[COUNT + 1 :]
    assert all(frame.held[0] == -1 for frame in frames)


@pytest.mark.parametrize("flip", [False, True])
def test_a_blocked_token_goes_there_and_back(flip: bool) -> None:
    made, episode = played((0.1, -0.2, 0.5), flip=flip, blocked=True)
    frames = film(made, episode)[COUNT + 1 :]
    there = frames[COUNT // 2 - 1]
    assert [bool(frame.stopped[0]) for frame in frames] == [True] * COUNT + [False]
    np.testing.assert_allclose(there.poses[0, 1], [0.7, -0.4, np.pi / 2.0], atol=1e-5)
    assert np.cos(there.rolls[0, 1]) == pytest.approx(-1.0 if flip else 1.0)
    np.testing.assert_allclose(frames[-1].corners(LAYOUT), episode.corners[:, 2], atol=1e-9)


def test_a_token_that_is_turned_over_gets_narrow_and_wide_again() -> None:
    made, episode = played((0.0, 0.0, 0.0), flip=True)
    own = LAYOUT.corners_of(1)
    frames = film(made, episode)[COUNT:]
    widths = [float(np.ptp(frame.corners(LAYOUT)[0, own, 1])) for frame in frames]
    assert widths[COUNT // 2] == pytest.approx(0.0, abs=1e-9)
    assert widths[0] == pytest.approx(widths[-1])
    assert LAYOUT.flipped(frames[-1].corners(LAYOUT))[0].tolist() == [False, True]


@pytest.mark.parametrize(("horizon", "count"), [(1, 20), (5, 20), (6, 16), (50, 2), (500, 1)])
def test_long_episodes_get_fewer_frames_for_each_action(horizon: int, count: int) -> None:
    assert frames_per_action(horizon) == count
