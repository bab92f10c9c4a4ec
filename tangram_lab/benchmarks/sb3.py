"""Stable-Baselines3's DDPG with hindsight on our environment; loaded late, as it is optional."""

import importlib
import json
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from tangram_sim.arrays import Bools, Floats

LIBRARY = "stable_baselines3"
NOISE = 0.1
CAPACITY = 200_000  # as in our presets


@dataclass(frozen=True)
class Rival:
    """One training.

    Attributes:
        hidden: layers of actor and critic.
        seconds: of training; without a goal, those after the first updates.
        goal: raw overlap at which it ends; 0 measures the speed only.
        envs: played at a time, in one process.
        updates: for each transition; below 1 a share of the environments' steps.
        twins: goals made up for each transition.
        batch: transitions in one update.
        starts: transitions played before the first update.
        gamma, tau: discount, and the share of the new weights in the targets.
        seed: of everything random.
    """

    hidden: tuple[int, ...] = (64, 64)
    seconds: float = 10.0
    goal: float = 0.0
    envs: int = 1
    updates: float = 1.0
    twins: int = 1
    batch: int = 256
    starts: int = 256
    gamma: float = 0.98
    tau: float = 0.05
    seed: int = 0

    def text(self) -> str:
        """As the command line has it."""
        return json.dumps(asdict(self))


def label() -> str:
    """The library's name and version; ModuleNotFoundError where it is missing."""
    try:
        return f"Stable-Baselines3 {version('stable-baselines3')}"
    except PackageNotFoundError:
        raise ModuleNotFoundError(
            "Stable-Baselines3, which this compares with, is missing: "
            "pip install 'tangram-rl[peers]'"
        ) from None


def make_model(rival: Rival) -> Any:
    """DDPG with hindsight, its environments around ours, and nothing logged."""
    label()
    # Late: it is no dependency of ours, and loads for seconds.
    library = importlib.import_module(LIBRARY)
    logger = importlib.import_module(f"{LIBRARY}.common.logger").Logger(None, [])
    noise = importlib.import_module(f"{LIBRARY}.common.noise").NormalActionNoise
    model = library.DDPG(
        "MultiInputPolicy",
        make_envs(rival.envs),
        action_noise=noise(np.zeros(3), np.full(3, NOISE)),
        batch_size=rival.batch,
        buffer_size=CAPACITY,
        device="cpu",
        gamma=rival.gamma,
        gradient_steps=max(1, round(rival.updates * rival.envs)),
        learning_starts=rival.starts,
        policy_kwargs={"net_arch": list(rival.hidden)},
        replay_buffer_class=library.HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": rival.twins, "goal_selection_strategy": "final"},
        seed=rival.seed,
        tau=rival.tau,
        train_freq=(1, "step"),
    )
    model.set_logger(logger)  # its own would leave a folder behind
    return model


def make_envs(count: int) -> Any:
    """So many of our environments, one square, in Stable-Baselines3's own loop over them."""
    from tangram_sim.env import TangramEnv  # noqa: PLC0415 - loads the engine

    vector = importlib.import_module(f"{LIBRARY}.common.vec_env").DummyVecEnv
    return vector([TangramEnv] * count)


def observation(corners: Floats, placed: Bools, goals: Floats) -> dict[str, Floats]:
    """A batch as `TangramEnv` shows it."""
    achieved = corners.reshape(len(corners), -1)
    return {
        "observation": np.concatenate([achieved, placed], axis=1),
        "achieved_goal": achieved,
        "desired_goal": goals.reshape(len(goals), -1),
    }
