"""How soon a training is over that plays well: from the command to its end, processes and all."""

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from tangram_lab.benchmarks.measure import Bound, Row, single
from tangram_lab.benchmarks.trainings import result_of, start_training
from tangram_sim.errors import TangramError

STAGE = "soon"
GOAL = 0.99
PATIENCE_S = 1200.0
LOOK_S = 0.02


@dataclass(frozen=True)
class Case:
    """A training.

    Attributes:
        name: in the table.
        settings: of tangram-train.
        score: in result.json, which is to reach `GOAL`.
        most_s: seconds that it may take.
    """

    name: str
    settings: tuple[str, ...]
    score: str
    most_s: float | None = None

    @property
    def told(self) -> str:
        """What is typed."""
        return f"{self.name}, {' '.join(self.settings)}"


# Budgets after which all seeds of a trial had reached the goal; those measured are others.
CASES = (
    Case("square", ("agent=quick", "max_updates=600"), "mean_reward", 10.0),
    Case(
        "parallelogram",
        ("tokens=parallelogram", "agent=quick", "max_updates=600"),
        "mean_reward",
        10.0,
    ),
    Case(
        "seven tokens",
        ("tokens=tangram7", "agent=quick", "max_updates=700"),
        "raw_overlap",
        30.0,
    ),
    Case(
        "seven tokens, attention",
        ("tokens=tangram7", "agent=quick", "net=mha_narrow", "max_updates=400"),
        "raw_overlap",
        150.0,
    ),
)


@dataclass(frozen=True)
class Course:
    """How one training went: its score, and the seconds of its parts."""

    score: float
    start_s: float  # until the master could be joined
    train_s: float  # until the last update, from when the first weights were out
    rest_s: float  # the last scores, files, and the end of all processes

    @property
    def whole_s(self) -> float:
        """From the command to its end."""
        return self.start_s + self.train_s + self.rest_s


def measure_soon(seeds: int, cases: Sequence[Case] = CASES) -> list[Row]:
    """For each case the seconds of the whole and of its parts, and the least score."""
    return [row for case in cases for row in _rows(case, seeds)]


def _rows(case: Case, seeds: int) -> list[Row]:
    every = [_course(case, seed) for seed in range(seeds)]
    bound = None if case.most_s is None else Bound(most=case.most_s)
    whole = single((STAGE, case.told, "s"), [one.whole_s for one in every], bound)
    parts = [
        single((STAGE, f"{case.name}: {name}", "s"), [getattr(one, f"{key}_s") for one in every])
        for name, key in (("until it can be joined", "start"), ("learning", "train"))
    ]
    scores, goal = [one.score for one in every], Bound(least=GOAL)
    score = single((STAGE, f"{case.name}: {case.score}, its least counts", ""), scores)
    return [whole, *parts, replace(score, target=str(goal), held=goal.holds(min(scores)))]


def _course(case: Case, seed: int) -> Course:
    with tempfile.TemporaryDirectory(prefix="tangram-") as name:
        folder = Path(name) / "run"
        begin, joined = time.monotonic(), None
        launcher = start_training(folder, *case.settings, f"seed={seed}")
        while launcher.poll() is None:
            if joined is None and (folder / "connection.json").exists():
                joined = time.monotonic() - begin
            if time.monotonic() - begin > PATIENCE_S:
                launcher.terminate()
            time.sleep(LOOK_S)
        whole = time.monotonic() - begin
        if launcher.returncode or joined is None:
            raise TangramError(f"the training of {case.told} failed: {_last(folder)}")
        result = result_of(folder)
    train = float(result["train_s"])
    return Course(float(result[case.score]), joined, train, whole - joined - train)


def _last(folder: Path) -> str:
    return (folder / "told").read_text(errors="replace").strip().splitlines()[-1]
