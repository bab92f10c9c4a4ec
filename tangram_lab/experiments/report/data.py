"""data.json: everything that a report is drawn from, so that the runs may be deleted."""

import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tangram_agent.files import write_whole
from tangram_lab.experiments.report.numbers import thinned
from tangram_lab.experiments.report.reading import (
    EACH,
    POINT,
    RESULT,
    checked_plan,
    checked_test,
    converted,
    make_study,
    parsed,
    read_bytes,
)
from tangram_lab.experiments.report.study import FINISHED, SETTINGS, Count, Row, Seed, Study
from tangram_sim.errors import RunError

DATA = "data.json"
FORMAT = 3
DIGITS = 6  # of its numbers
EACH_DIGITS = 4  # of the coverage of every episode
REPORT = "make it again with tangram-report runs=... out=..."


@dataclass(frozen=True)
class _Run:
    seed: Count
    state: str
    result: Row
    tests: dict[str, Row]
    curve: dict[str, list[float | None]]


@dataclass(frozen=True)
class _Data:
    plan: Row
    figures: dict[str, str]
    runs: dict[str, list[_Run]]


def write_data(path: Path, study: Study, figures: Mapping[str, str]) -> None:
    """The plan, and of every run its state, result, tests and a curve of at most 60 points.

    Args:
        path: of the file.
        study: what it is of.
        figures: file -> SHA-256 of the pictures that were drawn of it.

    Raises:
        RunError: it cannot be written.
    """
    runs = {one.name: [_seed_data(seed) for seed in one.seeds] for one in study.trainings}
    plan = study.plan | ({"command": _without_paths(study.command)} if study.plan else {})
    content = {"format": FORMAT, "plan": plan, "figures": figures, "runs": runs}
    write_whole(path, (_json(content, "") + "\n").encode())


def _without_paths(command: str) -> str:
    """A command without a folder of this machine, which tells nothing to anybody else."""
    try:
        words = shlex.split(command)
    except ValueError:
        return command
    kept = [word for word in words if not word.startswith(("run_dir=/", "keep=/"))]
    return command if kept == words else shlex.join(kept)


def _seed_data(seed: Seed) -> Row:
    points = thinned(seed.curve)
    names = dict.fromkeys(name for point in points for name in point)
    return {
        "seed": seed.number,
        "state": seed.state,
        "result": _rounded(seed.result),
        "tests": {name: _test_data(test) for name, test in seed.tests.items()},
        "curve": {name: [_rounded(point.get(name)) for point in points] for name in names},
    }


def _test_data(test: Row) -> Row:
    """A test's scores; of policies without learning the single episodes only in the game."""
    kept = {name: value for name, value in test.items() if name not in SETTINGS}
    if "coverage" not in test:
        kept["baselines"] = {
            name: {key: value for key, value in scores.items() if key != EACH}
            for name, scores in kept.get("baselines", {}).items()
        }
    rounded: Row = _rounded(kept)
    return rounded


def _rounded(value: Any, digits: int = DIGITS) -> Any:
    if isinstance(value, float):
        return float(f"{value:.{digits}g}")
    if isinstance(value, dict):
        return {k: _rounded(v, EACH_DIGITS if k == EACH else digits) for k, v in value.items()}
    return [_rounded(one, digits) for one in value] if isinstance(value, list) else value


def _json(value: Any, indent: str) -> str:
    """JSON with a line for each innermost collection, so that changes can be read."""
    inner = indent + " "
    if isinstance(value, dict) and any(isinstance(one, dict | list) for one in value.values()):
        pairs = (f"{inner}{json.dumps(k)}: {_json(v, inner)}" for k, v in value.items())
        return "{\n" + ",\n".join(pairs) + f"\n{indent}}}"
    if isinstance(value, list) and any(isinstance(one, dict | list) for one in value):
        return "[\n" + ",\n".join(inner + _json(one, inner) for one in value) + f"\n{indent}]"
    return json.dumps(value, ensure_ascii=False)


def read_data(path: Path) -> tuple[Study, dict[str, str]]:
    """The study of a data.json, and the sums of its figures.

    Raises:
        RunError: the file is not what it should be.
    """
    place = str(path)
    content, _ = parsed(read_bytes(path, REPORT), Row, place, REPORT)
    if content.get("format") != FORMAT:
        raise RunError(
            f"{place}: its format is {content.get('format')!r}, but this version reads {FORMAT}: "
            f"{REPORT}"
        )
    data: _Data = converted(content, _Data, place, REPORT)
    plan = checked_plan(data.plan, place)
    runs = dict[tuple[str, int], _Run]()
    for name, run in ((name, run) for name, own in data.runs.items() for run in own):
        told = f"{place}: {name}, seed {run.seed}"
        if (name, run.seed) in runs:
            raise RunError(f"{told} is there twice; {REPORT}")
        if name not in plan.trainings or run.seed not in plan.trainings[name].seeds:
            raise RunError(f"{told} is not in its plan; {REPORT}")
        if others := run.tests.keys() - plan.tests.keys():
            raise RunError(f"{told}: its plan has no test {min(others)}; {REPORT}")
        runs[name, run.seed] = run

    def read(name: str, seed: int) -> Seed:
        if (name, seed) not in runs:
            raise RunError(f"{place}: {name}, seed {seed} of its plan is missing; {REPORT}")
        return _read_seed(runs[name, seed], f"{place}: {name}, seed {seed}")

    return make_study(data.plan, plan, read), data.figures


def _read_seed(run: _Run, place: str) -> Seed:
    if run.state == FINISHED:
        converted(run.result, RESULT, place, REPORT)
    for name, test in run.tests.items():
        checked_test(test, f"{place}, test {name}", REPORT)
    if len({len(column) for column in run.curve.values()}) > 1:
        raise RunError(f"{place}: the columns of its curve are not of one length; {REPORT}")
    rows = zip(*run.curve.values(), strict=True)
    curve = tuple(dict(zip(run.curve, row, strict=True)) for row in rows)
    for point in curve:
        converted(point, POINT, f"{place}: its curve", REPORT)
    return Seed(run.seed, run.state, run.result, curve, run.tests)
