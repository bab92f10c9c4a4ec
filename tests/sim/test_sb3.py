"""The environment with a learner that knows nothing of this project."""

import gymnasium
import pytest

from tangram_sim.register import ENV_ID

pytestmark = pytest.mark.slow


def test_stable_baselines3_runs_unchanged() -> None:
    pytest.importorskip("torch").set_num_threads(1)
    sb3 = pytest.importorskip("stable_baselines3", reason="pip install '.[peers]'")
    env = gymnasium.make(
        ENV_ID,
        shapes=["square", "small_triangle"],
        actions_per_token=2,
        horizon=4,
        max_episode_steps=4,
    )
    model = sb3.DDPG(
        "MultiInputPolicy",
        env,
        replay_buffer_class=sb3.HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        learning_starts=40,
        batch_size=32,
        policy_kwargs={"net_arch": [32]},
        seed=0,
        device="cpu",
    )
    model.learn(240)
    assert model.num_timesteps >= 240
    assert model._n_updates > 100
    observation, _ = env.reset(seed=0)
    action, _ = model.predict(observation, deterministic=True)
    assert env.action_space.contains(action)
    env.close()
