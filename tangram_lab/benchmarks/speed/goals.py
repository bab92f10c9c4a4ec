"""Our goal agent and Stable-Baselines3's TD3 with hindsight on one environment, side by side.

Each has half of the cores, at the same time. Both have inputs normalised, networks [256, 256],
batches of 512 and an update for five steps; the rest of theirs is RL Zoo's for Fetch and Panda. RL
Zoo's own networks (3 x 512) and batches of 2,048, an update a step, are no match for a few cores.
"""

import importlib
import json
import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tangram_core.errors import TangramError
from tangram_lab.benchmarks.measure import Row, told
from tangram_lab.benchmarks.trainings import start_training

STAGE, LIBRARY = "goals", "stable_baselines3"
TESTS = 50
LOOK_S = 60.0  # between two tests
GOOD = 0.9
ENVS = 4
BATCH, HIDDEN, NOISE = 512, (256, 256), 0.2
# Seconds of training, steps of the environment, updates, share of tests that succeed.
Curve = list[tuple[float, int, int, float]]


def label() -> str:
    """The library's name and version; ModuleNotFoundError where it is missing."""
    try:
        return f"Stable-Baselines3 {version('stable-baselines3')}"
    except PackageNotFoundError:
        raise ModuleNotFoundError(
            "Stable-Baselines3, which this compares with, is missing: "
            "pip install 'tangram-rl[peers]'"
        ) from None


def measure_goals(id: str, minutes: float) -> list[Row]:  # noqa: A002 - as gymnasium calls it
    """Success after so many minutes, and what it took."""
    name, cores = label(), sorted(os.sched_getaffinity(0))
    half = max(1, len(cores) // 2)
    given = json.dumps({"id": id, "seconds": minutes * 60.0, "cores": cores[half:] or cores})
    with tempfile.TemporaryDirectory(prefix="tangram-") as scratch:
        command = [sys.executable, "-m", "tangram_lab.benchmarks.speed.goals", given]
        with Path(scratch, "theirs").open("w+") as said:
            rival = subprocess.Popen(command, stdout=said, stderr=subprocess.STDOUT)
            try:
                ours = _ours(id, minutes, Path(scratch) / "run", cores[:half])
                rival.wait()
            finally:
                rival.kill()
            said.seek(0)
            lines = said.read().splitlines()
        if rival.returncode:
            raise TangramError(f"{name} failed: {' '.join(lines[-3:])}")
    theirs = [tuple(json.loads(line)) for line in lines if line.startswith("[")]
    if not (ours and theirs):
        raise TangramError(f"{id}: no test within {minutes:g} minutes: give it more")
    for mine, other in zip(ours, theirs, strict=False):
        print(f"{mine[0]:6.0f} s  ours {mine[1:]}  theirs {other[1:]}", file=sys.stderr)
    return list(_rows(f"{id}, {minutes:g} min", ours, name, theirs))


def _rows(case: str, ours: Curve, name: str, theirs: Curve) -> list[Row]:
    def row(what: str, unit: str, mine: float, other: float) -> Row:
        return told(Row(STAGE, f"{case}: {what}", unit, float(mine), name, float(other)))

    return [
        row("success, mean of the last three tests", "share", _last(ours), _last(theirs)),
        row(f"seconds until {GOOD:g} (inf: never)", "s", _until(ours), _until(theirs)),
        row("steps", "steps", ours[-1][1], theirs[-1][1]),
        row("updates", "updates", ours[-1][2], theirs[-1][2]),
    ]


def _last(curve: Curve) -> float:
    return float(np.mean([success for *_, success in curve[-3:]]))


def _until(curve: Curve) -> float:
    return next((s for s, _, _, success in curve if success >= GOOD), float("inf"))


def module_of(id: str) -> str:  # noqa: A002
    """The module that registers an environment."""
    return "panda_gym" if id.startswith("Panda") else "gymnasium_robotics"


def _ours(id: str, minutes: float, folder: Path, cores: list[int]) -> Curve:  # noqa: A002
    """Our training, on its cores; workers and master take turns where there are fewer."""
    settings = (
        *("task=gym", f"task.id={id}", f"task.imports=[{module_of(id)}]", "agent=goal"),
        *(f"workers={max(2, len(cores) - 1)}", "service.device=cpu"),
        *(f"service.eval_seconds={LOOK_S}", f"service.eval_episodes={TESTS}"),
        *(f"max_hours={minutes / 60.0}", "max_updates=0"),
    )
    every = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)  # children inherit it
    try:
        launcher = start_training(folder, *settings)
    finally:
        os.sched_setaffinity(0, every)
    if launcher.wait():
        raise TangramError(f"our training failed: {(folder / 'told').read_text()[-500:]}")
    horizon = json.loads((folder / "result.json").read_text())
    steps = horizon["transitions"] // max(1, horizon["episodes"])
    lines = [json.loads(line) for line in (folder / "curve.jsonl").read_text().splitlines()]
    return [
        (one["train_s"], one["episodes"] * steps, one["updates"], one["success"]) for one in lines
    ]


# Theirs, in a process of its own


def train(id: str, seconds: float) -> None:  # noqa: A002
    """Train, and print each test; what they take does not count."""
    import gymnasium  # noqa: PLC0415 - an extra

    importlib.import_module(module_of(id))
    library = importlib.import_module(LIBRARY)
    common = partial(lambda name: importlib.import_module(f"{LIBRARY}.common.{name}"))
    vector = common("vec_env")
    env = vector.VecNormalize(
        vector.DummyVecEnv([partial(gymnasium.make, id)] * ENVS), norm_reward=False, clip_obs=5.0
    )
    size = env.action_space.shape[0]
    model = library.TD3(
        "MultiInputPolicy",
        env,
        action_noise=common("noise").NormalActionNoise(np.zeros(size), np.full(size, NOISE)),
        batch_size=BATCH,
        buffer_size=1_000_000,
        device="cpu",
        gamma=0.95,
        gradient_steps=ENVS,
        learning_rate=1e-3,
        learning_starts=1000,
        policy_kwargs={"net_arch": list(HIDDEN)},
        replay_buffer_class=library.HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        seed=0,
        tau=0.05,
        train_freq=(5, "step"),
    )
    model.set_logger(common("logger").Logger(None, []))
    test, begun, due = gymnasium.make(id), time.perf_counter(), LOOK_S

    def look(*_: object) -> bool:
        nonlocal begun, due
        passed = time.perf_counter() - begun
        if passed >= due:
            due += LOOK_S
            won = _successes(model, env, test)
            print(json.dumps([passed, model.num_timesteps, model._n_updates, won]), flush=True)
            begun = time.perf_counter() - passed
        return passed < seconds

    model.learn(10**9, callback=look)


def _successes(model: Any, env: Any, test: Any) -> float:
    won = 0
    for number in range(TESTS):
        (seen, _), over, info = test.reset(seed=10_000 + number), False, dict[str, Any]()
        while not over:
            rows = env.normalize_obs({name: part[None] for name, part in seen.items()})
            action = model.predict(rows, deterministic=True)[0][0]
            seen, _, ended, cut, info = test.step(action)
            over = ended or cut
        won += bool(info["is_success"])
    return won / TESTS


if __name__ == "__main__":
    asked = json.loads(sys.argv[1])
    os.sched_setaffinity(0, asked["cores"])
    torch.set_num_threads(len(asked["cores"]))
    train(asked["id"], asked["seconds"])
