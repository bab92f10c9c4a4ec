"""Reading a study: what is there must be in order, what is not there is told."""

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec

from tangram_agent.runs import CONFIG, read_config
from tangram_lab.experiments.fingerprints import Fingerprint
from tangram_lab.experiments.plan import (
    FORMAT,
    PLAN,
    ExperimentConfig,
    TestConfig,
    TrainingConfig,
    seed_folder,
    test_file,
)
from tangram_lab.experiments.report.study import (
    FINISHED,
    Budget,
    Count,
    Experiment,
    Row,
    Seed,
    Study,
    Training,
    Trial,
)
from tangram_sim.errors import ConfigError, RunError

CURVE = "curve.jsonl"
PRIVATE = ("host", "run_dir")  # say nothing to anybody else
PLAIN = re.compile(r"[A-Za-z0-9][\w.-]*", re.ASCII)
AXES = ("updates", "episodes", "train_s")
REMAKE = "run its tangram-experiment command again, or name another folder with runs=..."
RETRAIN = "delete this folder of the seed and train it again, or leave it out"
RETEST = "delete the file and run tangram-experiment again"
# What may differ between the runs of one setting, where nobody planned them.
APART = ("seed", "run_dir", "resume")
AGENT = "agent.name"
EACH = "coverage_each"  # of a test's file: the coverage of every episode
NOTE = (
    "Runs that differ in nothing but their seed make one row. Their scores are those of the last "
    "evaluation, on the same test episodes for all of them."
)


# What the files must hold; what they hold beyond it is kept as it is


@dataclass(frozen=True)
class Planned(TrainingConfig):
    """A training, its seeds, and the settings that its overrides came to."""

    settings: dict[str, Any] = field(default_factory=dict)
    seeds: tuple[Count, ...] = ()

    def __post_init__(self) -> None:
        if len({*self.seeds}) < max(len(self.seeds), 1):
            raise ConfigError(f"seeds must be different numbers, got {list(self.seeds)}")


@dataclass(frozen=True)
class Plan:
    """What plan.json must hold."""

    command: str
    commit: str | None
    budget: Budget
    experiments: dict[str, ExperimentConfig]
    trainings: dict[str, Planned]
    tests: dict[str, TestConfig]
    fingerprints: dict[str, Fingerprint]


_SCORES = ("mean_reward_dense", "angle_error_deg_median", "position_error_median")
_SHOWN = (  # of several tokens
    *("coverage", "share_solved", "share_solved_iou", "iou", "wrong", "doubly_used", "blocked"),
    "seconds_per_puzzle",
)
_MAY = [(name, float | None, None) for name in (*_SCORES, *_SHOWN)]
_BASELINE: Any = msgspec.defstruct(
    "_BASELINE",
    [("mean_reward", float | None, None), ("coverage_each", tuple[float, ...], ()), *_MAY],
)
TEST = msgspec.defstruct(
    "TEST",
    [
        ("mean_reward", float),
        ("baselines", dict[str, _BASELINE], {}),
        ("coverage_each", tuple[float, ...], ()),
        *_MAY,
    ],
)
POINT = msgspec.defstruct("POINT", [*((name, float) for name in (*AXES, "mean_reward")), *_MAY])
RESULT = msgspec.defstruct(
    "RESULT",
    [
        *((name, float | None) for name in ("mean_reward", *_SCORES)),
        *((name, float) for name in (*AXES, "wall_s", "parameters")),
        *(("tokens", tuple[str, ...]), ("ended_by", str), ("processor", str), ("cores", Count)),
        *(("commit", str | None), ("versions", dict[str, str])),
    ],
)


def read_bytes(path: Path, remedy: str) -> bytes:
    """A file's content; RunError with the remedy where it cannot be read."""
    if path.is_fifo():  # it would never end
        raise RunError(f"{path}: cannot be read (it is a pipe); {remedy}")
    try:
        return path.read_bytes()
    except OSError as error:
        if isinstance(error, PermissionError):
            remedy = "make it readable"
        raise RunError(f"{path}: cannot be read ({error.strerror}); {remedy}") from None


def parsed(text: bytes, kind: Any, place: str, remedy: str) -> tuple[Row, Any]:
    """A JSON mapping as it stands, and what must be in it, checked."""
    try:
        row = msgspec.json.decode(text, type=Row)
    except msgspec.ValidationError as error:
        raise RunError(f"{place}: {error}; {remedy}") from None
    except (ValueError, RecursionError) as error:
        raise RunError(f"{place}: it is not JSON ({error}); {remedy}") from None
    return row, converted(row, kind, place, remedy)


def converted(row: Row, kind: Any, place: str, remedy: str) -> Any:
    """What must be in a mapping, checked."""
    try:
        return msgspec.convert(row, kind)
    except (msgspec.ValidationError, ConfigError) as error:
        raise RunError(f"{place}: {error}; {remedy}") from None


def checked_test(row: Row, place: str, remedy: str) -> Row:
    """The scores of a test, checked: single episodes are as many as it says."""
    converted(row, TEST, place, remedy)
    for scores in (row, *row.get("baselines", {}).values()):
        if len(scores.get(EACH, ())) not in (0, row.get("episodes")):
            raise RunError(f"{place}: {EACH} is not of its episodes; {remedy}")
    return row


def _content(path: Path, kind: Any, remedy: str) -> Row:
    """The content of a file, checked, without what nobody else is told."""
    row, _ = parsed(read_bytes(path, remedy), kind, str(path), remedy)
    return {name: value for name, value in row.items() if name not in PRIVATE}


def read_runs(folder: Path) -> Study:
    """A study, with or without a plan, with all that its runs have left so far.

    Raises:
        RunError: neither a plan nor runs are there, or a file is not what it should be.
    """
    configs = sorted(folder.glob(f"*/{CONFIG}"), key=lambda path: _by_number(path.parent.name))
    if configs and not (folder / PLAN).exists():
        return _unplanned(folder, configs)
    if not (folder / PLAN).is_file():
        raise RunError(
            f"{folder / PLAN} is missing: name a folder that tangram-experiment made, or one "
            "whose folders are runs, runs=..."
        )
    return _planned(folder)


def _planned(folder: Path) -> Study:
    path = folder / PLAN
    content, _ = parsed(read_bytes(path, REMAKE), Row, str(path), REMAKE)
    plan = checked_plan(content, str(path))
    return make_study(
        content,
        plan,
        lambda name, seed: read_seed(seed_folder(folder, name, seed), seed, plan.tests),
    )


def make_study(content: Row, plan: "Plan", read: Callable[[str, int], Seed]) -> Study:
    """A study of a plan whose runs are read by a training's name and a seed."""
    tests = {name: Trial(**vars(one), name=name) for name, one in plan.tests.items()}
    trainings = {
        name: Training(
            **vars(one)
            | {
                "name": name,
                "seeds": tuple(read(name, seed) for seed in one.seeds),
            },
        )
        for name, one in plan.trainings.items()
    }
    experiments = tuple(
        Experiment(
            *(name, one.title, one.source, one.kind, one.note),
            trainings=tuple(
                replace(
                    trainings[t],
                    label=one.labels.get(t, trainings[t].label),
                    seeds=_common(trainings[t], [trainings[name] for name in one.trainings]),
                )
                for t in one.trainings
            ),
            tests=tuple(tests[t] for t in one.tests),
        )
        for name, one in plan.experiments.items()
    )
    known = (experiments, tuple(trainings.values()), tuple(tests.values()))
    return Study(content, plan.command, plan.commit, plan.budget, *known, plan.fingerprints)


def _common(training: Training, others: Sequence[Training]) -> tuple[Seed, ...]:
    """The seeds of a training that others have, too: what is compared is of the same."""
    every = set.intersection(*({seed.number for seed in one.seeds} for one in others))
    return tuple(seed for seed in training.seeds if seed.number in every)


def checked_plan(content: Row, place: str) -> Plan:
    """A plan, checked; RunError where it lacks what it names, or is of another format."""
    if content.get("format") != FORMAT:
        raise RunError(
            f"{place}: its format is {content.get('format')!r}, but this version reads "
            f"{FORMAT}: use the version of tangram-report that fits, or make the study again"
        )
    plan: Plan = converted(content, Plan, place, REMAKE)
    for name in (*plan.experiments, *plan.trainings, *plan.tests):
        if not PLAIN.fullmatch(name):  # it becomes the name of files and folders
            raise RunError(
                f"{place}: '{name}' is no name of an experiment, a training or a test: use "
                "letters, digits, '.', '_' and '-'"
            )
    for one in plan.experiments.values():
        for key, names in (("trainings", one.trainings), ("tests", one.tests)):
            for name in names:
                if name not in content[key]:
                    raise RunError(
                        f"{place}: its {key} lack '{name}', which an experiment names; {REMAKE}"
                    )
    return plan


def read_seed(folder: Path, seed: int, tests: Iterable[str]) -> Seed:
    """What one run has left: nothing, a part, or all.

    Raises:
        RunError: a file that is there is not what it should be.
    """
    result: Row = {}
    state = "not finished" if folder.exists() else "not started"
    if (path := folder / "result.json").exists():
        result = _content(path, RESULT, RETRAIN)
        stopped = result["ended_by"].startswith("SIG")
        state = f"stopped by {result['ended_by']}" if stopped else FINISHED
    curve = folder / CURVE
    files = {name: test_file(folder, name) for name in tests}
    return Seed(
        number=seed,
        state=state,
        result=result,
        curve=tuple(_curve(curve)) if curve.exists() else (),
        tests={
            name: checked_test(_content(file, TEST, RETEST), str(file), RETEST)
            for name, file in files.items()
            if file.exists()
        },
    )


def _curve(path: Path) -> Iterator[Row]:
    """The points of a curve; a last line without its end is still being written."""
    last: Row = dict.fromkeys(AXES, 0)
    for number, line in enumerate(read_bytes(path, RETRAIN).split(b"\n")[:-1], 1):
        row, _ = parsed(line, POINT, f"{path}: line {number}", RETRAIN)
        if any(row[axis] < last[axis] for axis in AXES):
            raise RunError(f"{path}: line {number} goes back in {', '.join(AXES)}; {RETRAIN}")
        last = row
        yield row


# Runs that lie in one folder without a plan, as `tangram-train --multirun` leaves them


def _unplanned(folder: Path, configs: Iterable[Path]) -> Study:
    groups: dict[str, tuple[Row, dict[int, Path]]] = {}
    for path in configs:
        settings = dict(_flat(read_config(path)))
        seed = settings.get("seed")
        if not isinstance(seed, int):
            raise RunError(f"{path}: seed must be a number, got {seed!r}: is this a run's config?")
        settings = {key: value for key, value in settings.items() if key not in APART}
        key = repr(sorted(settings.items()))
        runs = groups.setdefault(key, (settings, {}))[1]
        if seed in runs:
            raise RunError(
                f"{runs[seed]} and {path.parent} have the same settings and seed {seed}: take one "
                "of them out of the folder"
            )
        runs[seed] = path.parent
    everything = [settings for settings, _ in groups.values()]
    trainings: list[Training] = []
    for settings, runs in groups.values():
        agent = str(settings.get(AGENT))
        alike = [other for other in everything if other.get(AGENT) == settings.get(AGENT)]
        trainings.append(
            Training(
                label=", ".join([agent, *_told(settings, alike)]),
                family=agent,
                overrides=tuple(_told(settings, everything)),
                name=f"setting_{len(trainings)}",
                seeds=tuple(read_seed(runs[seed], seed, ()) for seed in sorted(runs)),
            )
        )
    budget = Budget("", NOTE)
    rows = tuple(trainings)
    only = Experiment("runs", f"Runs of {folder.name}", "", "ranking", NOTE, rows, ())
    return Study({}, "", None, budget, (only,), rows, (), {})


def _by_number(name: str) -> tuple[int, str]:
    """The jobs of a sweep are numbered: 10 comes after 9."""
    return (int(name) if name.isdecimal() else 0, name)


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every setting with its dotted name."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _told(own: Row, others: Sequence[Row]) -> Iterator[str]:
    """The settings that are not the same in all the others, in the config's order."""
    for name in dict.fromkeys(name for one in others for name in one):
        if name in own and any(one.get(name) != others[0].get(name) for one in others):
            value = own[name]
            text = (
                value
                if isinstance(value, str)
                else json.dumps(value, separators=(",", ":"), default=str)
            )
            yield f"{name}={text}"
