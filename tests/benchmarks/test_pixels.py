"""DDPG on pixels: what its environment shows and rewards, and how pictures are shifted."""

from contextlib import closing

import numpy as np
import pytest
import torch

from tangram_lab.benchmarks.pixels import PIXELS, SHIFT, PictureEnv, shifted

pytestmark = pytest.mark.fast


def test_a_goal_that_is_made_up_of_the_end_is_reached() -> None:
    with closing(PictureEnv(0)) as env:
        start, _ = env.reset()
        end, reward, terminated, truncated, _ = env.step(np.array([0.2, -0.1, 0.3], np.float32))
        assert (terminated, truncated) == (True, False)
        assert env.observation_space.contains(end)
        states = np.stack([start["achieved_goal"], end["achieved_goal"]])
        assert (states[0] != states[1]).any()
        played, made_up = np.stack([end["desired_goal"]] * 2), np.stack([states[1]] * 2)
        assert env.compute_reward(states, played, {})[1] == pytest.approx(reward)
        found = env.compute_reward(states, made_up, {})
        assert found[1] == 1.0 > found[0]
        assert (env.compute_reward(states, np.full_like(states, states.max()), {}) == -1.0).all()


def test_pictures_are_shifted_both_alike_and_one_by_one() -> None:
    pictures = torch.arange(2 * 2 * PIXELS * PIXELS).reshape(2, 2, PIXELS, PIXELS).float()
    way = torch.tensor([[SHIFT, SHIFT], [SHIFT + 2, SHIFT - 1]])
    found = shifted(pictures, way)
    assert torch.equal(found[0], pictures[0])
    assert torch.equal(found[1, :, :-2, 1:], pictures[1, :, 2:, :-1])
    assert torch.equal(found[1, :, :-2, 0], pictures[1, :, 2:, 0])  # its edge goes on
