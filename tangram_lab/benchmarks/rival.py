"""Trainings of Stable-Baselines3, each in a process of its own.

    python -m tangram_lab.benchmarks.rival '{"hidden": [64, 64], "seconds": 10}'

prints what came out as one JSON line, the last one. So its threads and memory are as clean as ours.
"""

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

from tangram_lab.benchmarks.sb3 import Rival, label, make_model, observation
from tangram_lab.benchmarks.setups import preset
from tangram_sim.arrays import Bools, Floats, Singles
from tangram_sim.batch import BatchedEnv
from tangram_sim.errors import TangramError
from tangram_sim.seeding import evaluation_generators
from worker.rollout import Generators, play

TESTS, AT_ONCE = 100, 25  # the tests that our evaluator plays
LOOK_S = 1.0
FOR_EVER = 10**9


def train_rival(rival: Rival) -> dict[str, Any]:
    """What a training of Stable-Baselines3 in a process of its own came to."""
    label()
    command = [sys.executable, "-m", "tangram_lab.benchmarks.rival", rival.text()]
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
    watch, exam = Watch(), _exam(model)
    curve: list[tuple[float, float]] = []

    def look(*_: object) -> bool:
        trained = watch.seconds()
        if trained >= min(rival.seconds, LOOK_S * (len(curve) + 1)):
            with watch.paused():
                curve.append((trained, exam()))
        return trained < rival.seconds and not (curve and curve[-1][1] >= rival.goal)

    model.learn(FOR_EVER, callback=look)
    return {"curve": curve, "transitions": model.num_timesteps, "updates": model._n_updates}


class Watch:
    """Counts seconds from the first look at it on."""

    def __init__(self) -> None:
        self._begun: float | None = None

    def seconds(self) -> float:
        """So far, without the pauses."""
        now = time.perf_counter()
        self._begun = now if self._begun is None else self._begun
        return now - self._begun

    @contextmanager
    def paused(self) -> Iterator[None]:
        """What happens meanwhile takes no time."""
        before = self.seconds()
        yield
        self._begun = time.perf_counter() - before


def _exam(model: Any) -> Callable[[], float]:
    """The mean overlap in our fixed tests, noise off."""
    setup = preset()
    env = BatchedEnv(setup.layout, setup.sim, setup.reward, AT_ONCE)

    def choose(corners: Floats, placed: Bools, goals: Floats, _: Generators) -> Singles:
        actions: Singles = model.predict(observation(corners, placed, goals), deterministic=True)[0]
        return actions

    def exam() -> float:
        generators = evaluation_generators(TESTS)
        return float(np.mean(play(env, choose, generators.__getitem__, TESTS).overlap))

    return exam


def main() -> None:
    """The command."""
    given = json.loads(sys.argv[1])
    rival = Rival(**(given | {"hidden": tuple(given.get("hidden", (64, 64)))}))
    print(json.dumps(train(rival)))


if __name__ == "__main__":
    main()
