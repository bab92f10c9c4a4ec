"""Whole trainings end to end, against Stable-Baselines3 on the same cores, one after the other.

Speed: the same networks, batches, hindsight and one update for each transition, on the paper's
square; the best of what each side can choose (how many workers, how many environments), and no
tests on either side. How soon it plays well: see `quality`.
"""

import json
import statistics
import time
from dataclasses import replace
from pathlib import Path

import zmq

from tangram_lab.benchmarks.measure import Bound, Row, compared, single
from tangram_lab.benchmarks.quality import STAGE, measure_quality
from tangram_lab.benchmarks.rival import train_rival
from tangram_lab.benchmarks.sb3 import Rival, label
from tangram_lab.benchmarks.trainings import LOOK_S, PATIENCE_S, running
from worker.status import ask_status

SPAN_S = 12.0
WARM_UPDATES = 300.0
WORKERS, ENVS = (1, 2), (1, 16)
SMALL, LARGE = (64, 64), (256, 256, 256)
FASTER = Bound(least=4.0)

Numbers = dict[str, float]


def measure_train(seeds: int, minutes: float) -> list[Row]:
    """Speed at equal sizes, and seconds until the overlap is reached.

    Args:
        seeds: trainings of each kind.
        minutes: after which one of Stable-Baselines3 for quality is given up.
    """
    label()  # says at once what is missing
    return [
        _equal(SMALL, seeds, FASTER),
        _equal(LARGE, 1, None),
        _attention(),
        *measure_quality(seeds, minutes * 60.0),
    ]


def _equal(hidden: tuple[int, ...], runs: int, bound: Bound | None) -> Row:
    """Transitions in a second with the same networks."""
    net = list(hidden)
    settings = ("agent=mlp", "agent.batch_size=256", "agent.learning_starts=256")
    sizes = f"net.hidden={json.dumps(net, separators=(',', ':'))}"
    rival = Rival(hidden=hidden, seconds=SPAN_S, twins=1)
    ours: dict[int, list[float]] = {workers: [] for workers in WORKERS}
    theirs: dict[int, list[float]] = {envs: [] for envs in ENVS}
    for seed in range(runs):
        for workers, found in ours.items():
            numbers = _pace(*settings, sizes, f"workers={workers}", f"seed={seed}")
            # One update for each transition; players may be some ahead, so updates count.
            found.append(numbers["updates"])
        for envs, found in theirs.items():
            found.append(train_rival(replace(rival, envs=envs, seed=seed))["rate"])
    workers, envs = (max(way, key=lambda n: statistics.median(way[n])) for way in (ours, theirs))
    case = f"perceptron {net}, batch 256, an update a transition, {workers} worker(s)"
    against = f"{label()}, {envs} environment(s)"
    return compared((STAGE, case, "transitions/s"), ours[workers], against, theirs[envs], bound)


def _attention() -> Row:
    """The default agent, for which there is no rival of its size."""
    found = _pace()["transitions"]
    return single((STAGE, "default agent, 0.1 updates a transition", "transitions/s"), [found])


def _pace(*settings: str) -> Numbers:
    """Transitions and updates in a second of our training, from some updates on."""
    with running(*settings, "max_updates=0", "service.eval_seconds=3600") as folder:
        while (first := _standing(folder))["updates"] < WARM_UPDATES:
            time.sleep(LOOK_S)
        time.sleep(SPAN_S)
        last = _standing(folder)
    passed = last["elapsed_s"] - first["elapsed_s"]
    return {name: (last[name] - first[name]) / passed for name in ("transitions", "updates")}


def _standing(folder: Path) -> Numbers:
    with zmq.Context() as context:
        return dict(ask_status(str(folder), context, PATIENCE_S).numbers)
