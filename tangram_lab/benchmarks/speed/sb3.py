"""Stable-Baselines3's DDPG with hindsight on our environment; loaded late, as it is optional.

    python -m tangram_lab.benchmarks.speed.sb3 '{"hidden": [64, 64], "seconds": 10}'

trains in a process of its own, so that its threads and memory are as clean as ours, and prints what
came out as one JSON line, the last one.
"""

import importlib
import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
import torch

from tangram_core.arrays import Bools, Floats, Singles
from tangram_core.errors import TangramError
from tangram_core.seeding import evaluation_generators
from tangram_core.spec import Arrays
from tangram_core.task import Generators, History
from tangram_lab.benchmarks.setups import place, preset
from tangram_tasks.played import Played, as_seen
from worker.play.rollout import play

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
        actions: of an episode, whose one token takes them all.
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
    actions: int = 1
    updates: float = 1.0
    twins: int = 1
    batch: int = 256
    starts: int = 256
    gamma: float = 0.98
    tau: float = 0.05
    seed: int = 0


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
        make_envs(rival.envs, rival.actions),
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


def make_envs(count: int, actions: int = 1) -> Any:
    """Our environments with one square, in Stable-Baselines3's own loop over them.

    Args:
        count: of environments.
        actions: of an episode.
    """
    from tangram_sim.env import TangramEnv  # noqa: PLC0415 - loads the engine

    vector = importlib.import_module(f"{LIBRARY}.common.vec_env").DummyVecEnv
    return vector([partial(TangramEnv, actions_per_token=actions)] * count)


def observation(corners: Floats, placed: Bools, goals: Floats) -> dict[str, Floats]:
    """A batch as `TangramEnv` shows it."""
    achieved = corners.reshape(len(corners), -1)
    return {
        "observation": np.concatenate([achieved, placed], axis=1),
        "achieved_goal": achieved,
        "desired_goal": goals.reshape(len(goals), -1),
    }


# A rival's training in a process of its own


TESTS, AT_ONCE = 100, 25  # the tests that our evaluator plays
LOOK_S = 1.0
FOR_EVER = 10**9


def train_rival(rival: Rival) -> dict[str, Any]:
    """What a training of Stable-Baselines3 in a process of its own came to."""
    label()
    command = [sys.executable, "-m", "tangram_lab.benchmarks.speed.sb3", json.dumps(asdict(rival))]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise TangramError(f"Stable-Baselines3 failed: {done.stderr.strip()[-500:]}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def train(rival: Rival) -> dict[str, Any]:
    """Train, and say how fast, or how well after what time."""
    torch.set_num_threads(1)
    model = make_model(rival)
    if rival.goal:
        return _until_good(rival, model)
    return _speed(rival, model)


def _speed(rival: Rival, model: Any) -> dict[str, Any]:
    """Transitions in a second, from some updates after the first on."""
    marks: list[tuple[float, int, int]] = []

    def look(*_: object) -> bool:
        if model.num_timesteps > 2 * rival.starts:
            marks.append((time.perf_counter(), model.num_timesteps, model._n_updates))
        return not marks or marks[-1][0] - marks[0][0] < rival.seconds

    model.learn(FOR_EVER, callback=look)
    passed, steps, updates = (end - begin for begin, end in zip(marks[0], marks[-1], strict=True))
    return {"rate": steps / passed, "updates": updates / steps}


def _until_good(rival: Rival, model: Any) -> dict[str, Any]:
    """The overlap after so many seconds of training; what the tests take does not count."""
    exam, begun = _exam(model), 0.0
    curve: list[tuple[float, float]] = []

    def look(*_: object) -> bool:
        nonlocal begun
        begun = begun or time.perf_counter()  # the first look is the start
        trained = time.perf_counter() - begun
        if trained >= min(rival.seconds, LOOK_S * (len(curve) + 1)):
            curve.append((trained, exam()))
            begun = time.perf_counter() - trained
        return trained < rival.seconds and not (curve and curve[-1][1] >= rival.goal)

    model.learn(FOR_EVER, callback=look)
    return {"curve": curve, "transitions": model.num_timesteps, "updates": model._n_updates}


def _exam(model: Any) -> Callable[[], float]:
    """The mean overlap in our fixed tests, noise off."""
    task = place(preset())
    env = task.make(AT_ONCE)

    def choose(seen: Arrays, _past: History, _: Generators) -> Singles:
        actions: Singles = model.predict(observation(*as_seen(seen)), deterministic=True)[0]
        return actions

    def exam() -> float:
        generators = evaluation_generators(TESTS)
        number = generators.__getitem__
        played = play(env, task.spec, choose, number, TESTS, facts=True)
        return float(np.mean(Played.of(played).overlap))

    return exam


def main() -> None:
    """The command."""
    given = json.loads(sys.argv[1])
    rival = Rival(**(given | {"hidden": tuple(given.get("hidden", (64, 64)))}))
    print(json.dumps(train(rival)))


if __name__ == "__main__":
    main()
