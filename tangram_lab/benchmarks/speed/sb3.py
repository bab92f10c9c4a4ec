"""Stable-Baselines3's DDPG with hindsight on our environment; loaded late, as it is optional."""

import importlib
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

LIBRARY = "stable_baselines3"
NOISE = 0.1
CAPACITY = 200_000  # as in our presets


def label() -> str:
    """The library's name and version; ModuleNotFoundError where it is missing."""
    try:
        return f"Stable-Baselines3 {version('stable-baselines3')}"
    except PackageNotFoundError:
        raise ModuleNotFoundError(
            "Stable-Baselines3, which this compares with, is missing: "
            "pip install 'tangram-rl[peers]'"
        ) from None


def make_model(envs: int, batch: int, starts: int) -> Any:
    """A perceptron of [64, 64] on one square, and nothing logged.

    Args:
        envs: played at a time, and updates after each of their steps.
        batch: transitions in one update.
        starts: transitions played before the first update.
    """
    label()
    from tangram_sim.env import TangramEnv  # noqa: PLC0415 - loads the engine

    # Late: it is no dependency of ours, and loads for seconds.
    library = importlib.import_module(LIBRARY)
    common = {n: importlib.import_module(f"{LIBRARY}.common.{n}") for n in ("logger", "noise")}
    vector = importlib.import_module(f"{LIBRARY}.common.vec_env").DummyVecEnv
    model = library.DDPG(
        "MultiInputPolicy",
        vector([TangramEnv] * envs),
        action_noise=common["noise"].NormalActionNoise(np.zeros(3), np.full(3, NOISE)),
        batch_size=batch,
        buffer_size=CAPACITY,
        device="cpu",
        gamma=0.98,
        gradient_steps=envs,
        learning_starts=starts,
        policy_kwargs={"net_arch": [64, 64]},
        replay_buffer_class=library.HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 1, "goal_selection_strategy": "final"},
        seed=0,
        tau=0.05,
        train_freq=(1, "step"),
    )
    model.set_logger(common["logger"].Logger(None, []))  # its own would leave a folder behind
    return model
