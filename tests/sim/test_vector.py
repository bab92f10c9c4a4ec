"""What make_vec makes plays and tells as gymnasium's own vector of single environments does."""

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode

from tangram_core.errors import ConfigError
from tangram_sim.register import ENV_ID, GAME_ID
from tangram_sim.vector import TangramVectorEnv

pytestmark = pytest.mark.fast

NOISY = {"corner_noise": 0.02, "pixels": 32}


@pytest.fixture
def made() -> Iterator[list[Any]]:
    envs: list[Any] = []
    yield envs
    for env in envs:
        env.close()


def pair(name: str, mode: str, made: list[Any], **settings: Any) -> list[Any]:
    """Ours, and single environments that gymnasium puts together."""
    kwargs = {"vector_kwargs": {"autoreset_mode": mode}, "vectorization_mode": "sync"}
    made.append(gymnasium.make_vec(name, 3, autoreset_mode=mode, **settings))
    made.append(gymnasium.make_vec(name, 3, **kwargs, **settings))
    return made


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        (ENV_ID, {}),
        (ENV_ID, NOISY | {"actions_per_token": 3, "horizon": 3, "max_episode_steps": 3}),
        (ENV_ID, {"actions_per_token": 4, "horizon": 4, "max_episode_steps": 2}),
        (GAME_ID, {"backend": "kinematic"}),
    ],
)
@pytest.mark.parametrize("seed", [5, [9, 3, 7]])
def test_same_episodes_in_the_same_words(
    name: str, settings: dict[str, Any], mode: str, seed: Any, made: list[Any]
) -> None:
    ours, theirs = pair(name, mode, made, **settings)
    assert isinstance(ours, TangramVectorEnv)
    assert ours.metadata["autoreset_mode"] is AutoresetMode(mode)
    for space in ("single_observation_space", "single_action_space", "observation_space"):
        assert getattr(ours, space) == getattr(theirs, space)
    ours.action_space.seed(0)
    told = [env.reset(seed=seed) for env in made]
    ends = 0
    for step in range(17):
        assert data_equivalence(*told)  # numpy sums a batch in another order: the last bit
        assert ours.observation_space.contains(told[0][0])
        actions = ours.action_space.sample()
        told = [env.step(actions) for env in made]
        ends += told[0][3].any()
        if step == 9:  # in the middle of an episode, and the streams go on
            told = [env.reset() for env in made]
    assert ends >= 1


def test_what_it_gives_is_the_readers_own(made: list[Any]) -> None:
    ours, _ = pair(ENV_ID, "NextStep", made)
    first, _ = ours.reset(seed=0)
    kept = {name: entry.copy() for name, entry in first.items()}
    ours.step(ours.action_space.sample())
    ours.step(ours.action_space.sample())
    assert data_equivalence(first, kept, exact=True)


def test_pictures(made: list[Any]) -> None:
    ours, theirs = pair(ENV_ID, "NextStep", made, render_mode="rgb_array", render_size=60)
    for env in made:
        env.reset(seed=0)
        env.step(np.full((3, 3), 0.2, dtype=np.float32))
    np.testing.assert_array_equal(ours.render(), theirs.render())
    made.append(gymnasium.make_vec(ENV_ID, 2))
    assert made[-1].render() is None


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"num_envs": 0}, "num_envs must be between 1 and 4096, got 0"),
        ({"num_envs": 10**7}, "num_envs must be between 1 and 4096, got 10000000"),
        ({"num_envs": "2"}, "num_envs must be a finite number, between 1 and 4096, got 2"),
        ({"max_episode_steps": 0}, "max_episode_steps must be at least 1, got 0"),
        ({"autoreset_mode": "Disabled"}, "autoreset_mode must be NextStep or SameStep, got Disab"),
        ({"render_mode": "human"}, "render_mode must be None or rgb_array, got 'human'"),
        ({"gravity": 1.0}, "unknown setting 'gravity' of the environment"),
        ({"actions_per_token": 2}, "an episode of these settings has 2 steps"),
    ],
)
def test_refused_settings(settings: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        gymnasium.make_vec(ENV_ID, **settings)


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"seed": [1]}, "seed must be an int or list 3 seeds, got 1"),
        ({"seed": np.arange(3)}, "seed must be an int or list 3 seeds, got a ndarray"),
        ({"options": {"reset_mask": np.array([True, False, True])}}, "reset_mask leaves .* out"),
    ],
)
def test_refused_resets(given: dict[str, Any], reason: str, made: list[Any]) -> None:
    made.append(gymnasium.make_vec(ENV_ID, 3, backend="kinematic"))
    made[0].reset(seed=0, options={"reset_mask": np.ones(3, dtype=np.bool_)})
    with pytest.raises(ConfigError, match=reason):
        made[0].reset(**given)
