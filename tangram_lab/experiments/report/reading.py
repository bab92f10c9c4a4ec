"""Reading the folder of a study: what is there must be in order, what is not is told."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from tangram_lab.experiments.plan import FORMAT, KINDS, PLAN, seed_folder, test_file
from tangram_lab.experiments.report.records import Record, Row, read_record, read_records, without
from tangram_lab.experiments.report.study import Experiment, Seed, Study, Training, Trial
from tangram_sim.errors import RunError

RESULT, CURVE = "result.json", "curve.jsonl"
PRIVATE = ("host", "run_dir")  # say nothing to anybody else
PLAIN = re.compile(r"[A-Za-z0-9][\w.-]*", re.ASCII)
AXES = ("updates", "episodes", "train_s")
SCORES = ("mean_reward", "mean_reward_dense", "angle_error_deg_median", "position_error_median")
COUNTS = ("updates", "episodes", "train_s", "wall_s", "parameters")
REMAKE = "run its tangram-experiment command again, or name another folder with runs=..."
RETRAIN = "delete this folder of the seed and train it again, or leave it out"
RETEST = "delete the file and run tangram-experiment again"

Named = TypeVar("Named", Training, Trial)


def read_study(folder: Path) -> Study:
    """A study with all that its runs have left so far.

    Raises:
        RunError: no plan is there, or a file of the plan or of a run is not what it should be.
    """
    if not (folder / PLAN).is_file():
        raise RunError(
            f"{folder / PLAN} is missing: name a folder that tangram-experiment made, or one "
            "whose folders are runs, runs=..."
        )
    plan = read_record(folder / PLAN, REMAKE)
    if plan.content.get("format") != FORMAT:
        raise RunError(
            f"{plan.path}: its format is {plan.content.get('format')!r}, but this version reads "
            f"{FORMAT}: use the version of tangram-report that fits, or make the study again"
        )
    return _study(folder, plan)


def _study(folder: Path, plan: Record) -> Study:
    budget = plan.record("budget")
    seeds = budget.integers("seeds")
    tests = {name: _test(name, record) for name, record in plan.records("tests").items()}
    trainings = {
        _plain(name, plan.path): _training(folder, name, record, seeds, tests)
        for name, record in plan.records("trainings").items()
    }
    return Study(
        plan=plan.content,
        command=plan.text("command"),
        commit=plan.maybe_text("commit"),
        budget=budget.text("name"),
        budget_note=budget.text("note"),
        planned_seeds=seeds,
        test_episodes=budget.integer("test_episodes"),
        experiments=tuple(
            _experiment(_plain(name, plan.path), record, trainings, tests)
            for name, record in plan.records("experiments").items()
        ),
        trainings=tuple(trainings.values()),
        tests=tuple(tests.values()),
    )


def _plain(name: str, path: Path) -> str:
    """Names become names of files and folders."""
    if not PLAIN.fullmatch(name):
        raise RunError(
            f"{path}: '{name}' is no name of an experiment, a training or a test: use letters, "
            "digits, '.', '_' and '-'"
        )
    return name


def _experiment(
    name: str, record: Record, trainings: Mapping[str, Training], tests: Mapping[str, Trial]
) -> Experiment:
    kind = record.text("kind")
    if kind not in KINDS:
        raise RunError(
            f"{record.path}: experiment {name} is of the unknown kind '{kind}'; "
            f"use one of {', '.join(KINDS)}"
        )
    labels = record.record("labels").content if "labels" in record.content else {}
    return Experiment(
        name=name,
        title=record.text("title"),
        source=record.text("source"),
        kind=kind,
        note=record.text("note"),
        trainings=tuple(
            replace(one, label=labels.get(one.name, one.label))
            for one in _chosen(record, "trainings", trainings)
        ),
        tests=_chosen(record, "tests", tests),
    )


def _chosen(record: Record, key: str, known: Mapping[str, Named]) -> tuple[Named, ...]:
    names = record.texts(key)
    lacking = [name for name in names if name not in known]
    if lacking:
        raise RunError(
            f"{record.path}: its {key} lack '{lacking[0]}', which an experiment names; {REMAKE}"
        )
    return tuple(known[name] for name in names)


def _test(name: str, record: Record) -> Trial:
    actions = record.maybe_number("actions")
    return Trial(
        name=_plain(name, record.path),
        label=record.text("label"),
        actions=None if actions is None else record.integer("actions"),
        corner_noise=record.maybe_number("corner_noise"),
    )


def _training(
    folder: Path, name: str, record: Record, seeds: Sequence[int], tests: Mapping[str, Trial]
) -> Training:
    return Training(
        name=name,
        label=record.text("label"),
        family=record.text("family"),
        overrides=record.texts("overrides"),
        after=record.maybe_text("after") if "after" in record.content else None,
        seeds=tuple(read_seed(seed_folder(folder, name, seed), seed, tests) for seed in seeds),
    )


def read_seed(folder: Path, seed: int, tests: Mapping[str, Trial]) -> Seed:
    """What one run has left: nothing, a part, or all.

    Raises:
        RunError: a file that is there is not what it should be.
    """
    result = _result(folder / RESULT) if (folder / RESULT).exists() else {}
    curve = _curve(folder / CURVE) if (folder / CURVE).exists() else ()
    files = {name: test_file(folder, name) for name in tests}
    return Seed(
        number=seed,
        state=_state(folder, result),
        result=result,
        curve=curve,
        tests={name: _scores(path) for name, path in files.items() if path.exists()},
    )


def _state(folder: Path, result: Row) -> str:
    if not folder.exists():
        return "not started"
    if not result:
        return "not finished"
    if result["ended_by"].startswith("SIG"):
        return f"stopped by {result['ended_by']}"
    return "finished"


def _result(path: Path) -> Row:
    record = read_record(path, RETRAIN)
    for name in SCORES:
        record.maybe_number(name)
    for name in COUNTS:
        record.number(name)
    record.texts("tokens")
    for name in ("ended_by", "processor"):
        record.text(name)
    record.integer("cores")
    record.maybe_text("commit")
    versions = record.record("versions")
    for name in versions.content:
        versions.text(name)
    return without(record.content, *PRIVATE)


def _curve(path: Path) -> tuple[Row, ...]:
    points: list[Row] = []
    for record in read_records(path, RETRAIN):
        for name in (*AXES, "mean_reward"):
            record.number(name)
        for name in set(SCORES) & set(record.content):
            record.maybe_number(name)
        if points and any(record.content[name] < points[-1][name] for name in AXES):
            raise RunError(
                f"{path}: line {len(points) + 1} goes back in {', '.join(AXES)}; {RETRAIN}"
            )
        points.append(record.content)
    return tuple(points)


def _scores(path: Path) -> Row:
    record = read_record(path, RETEST)
    record.number("mean_reward")
    baselines = record.records("baselines") if "baselines" in record.content else {}
    for row in (record, *baselines.values()):
        for name in set(SCORES) & set(row.content):
            row.maybe_number(name)
    return without(record.content, *PRIVATE)
