"""How soon a training plays well: from the command to its scores, all processes' start included."""

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
        most_s: seconds that it may take to its scores.
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
    start_s: float  # from the command until the master could be joined
    train_s: float  # from the first weights to the last update
    scored_s: float  # from the command until the final weights were scored
    ended_s: float  # from the command until all its processes had ended


def measure_soon(seeds: int, cases: Sequence[Case] = CASES) -> list[Row]:
    """For each case the seconds of the whole and of its parts, and the least score."""
    return [row for case in cases for row in _rows(case, seeds)]


def _rows(case: Case, seeds: int) -> list[Row]:
    every = [_course(case, seed) for seed in range(seeds)]
    bound = None if case.most_s is None else Bound(most=case.most_s)
    whole = single((STAGE, case.told, "s"), [one.scored_s for one in every], bound)
    named = {
        "until it can be joined": "start_s",
        "learning": "train_s",
        "until all has ended": "ended_s",
    }
    parts = [
        single((STAGE, f"{case.name}: {name}", "s"), [getattr(one, key) for one in every])
        for name, key in named.items()
    ]
    scores, goal = [one.score for one in every], Bound(least=GOAL)
    score = single((STAGE, f"{case.name}: {case.score}, its least counts", ""), scores)
    return [whole, *parts, replace(score, target=str(goal), held=goal.holds(min(scores)))]


def _course(case: Case, seed: int) -> Course:
    with tempfile.TemporaryDirectory(prefix="tangram-") as name:
        folder = Path(name) / "run"
        begin, joined, scored = time.monotonic(), None, None
        launcher = start_training(folder, *case.settings, f"seed={seed}")
        while launcher.poll() is None:
            if joined is None and (folder / "connection.json").exists():
                joined = time.monotonic() - begin
            if scored is None and (folder / "result.json").exists():
                scored = time.monotonic() - begin
            if time.monotonic() - begin > PATIENCE_S:
                launcher.terminate()
            time.sleep(LOOK_S)
        ended = time.monotonic() - begin
        if launcher.returncode or joined is None or scored is None:
            raise TangramError(f"the training of {case.told} failed: {_last(folder)}")
        result = result_of(folder)
    return Course(float(result[case.score]), joined, float(result["train_s"]), scored, ended)


def _last(folder: Path) -> str:
    return (folder / "told").read_text(errors="replace").strip().splitlines()[-1]
