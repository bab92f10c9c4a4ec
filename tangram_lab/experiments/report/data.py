"""data.json: everything that the report was drawn from, so that the runs may be deleted."""

import json
import math
from typing import Any

from tangram_lab.experiments.report.numbers import thinned
from tangram_lab.experiments.report.records import Row
from tangram_lab.experiments.report.study import Seed, Study

FORMAT = 1
DIGITS = 6


def study_data(study: Study) -> Row:
    """The plan, and of every run its state, result, tests and a curve of at most 60 points."""
    return {
        "format": FORMAT,
        "plan": study.plan,
        "runs": {one.name: [_seed(seed) for seed in one.seeds] for one in study.trainings},
    }


def to_json(data: Row) -> bytes:
    """JSON with a line for each innermost collection, so that changes can be read."""
    return (_lines(data, "") + "\n").encode()


def _seed(seed: Seed) -> Row:
    points = thinned(seed.curve)
    names = dict.fromkeys(name for point in points for name in point)
    return {
        "seed": seed.number,
        "state": seed.state,
        "result": seed.result,
        "tests": seed.tests,
        "curve": {name: [_short(point.get(name)) for point in points] for name in names},
    }


def _short(value: Any) -> Any:
    """Curves keep six digits."""
    if not isinstance(value, float) or not math.isfinite(value):
        return value
    return float(f"{value:.{DIGITS}g}")


def _lines(value: Any, indent: str) -> str:
    inner = indent + " "
    if isinstance(value, dict) and any(isinstance(one, dict | list) for one in value.values()):
        pairs = (f"{inner}{json.dumps(k)}: {_lines(v, inner)}" for k, v in value.items())
        return "{\n" + ",\n".join(pairs) + f"\n{indent}}}"
    if isinstance(value, list) and any(isinstance(one, dict | list) for one in value):
        return "[\n" + ",\n".join(inner + _lines(one, inner) for one in value) + f"\n{indent}]"
    return json.dumps(value, ensure_ascii=False)
