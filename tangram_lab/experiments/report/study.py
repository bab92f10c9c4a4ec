"""What a study is, and reading it: what is there must be in order, what is not there is told."""

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec

from tangram_agent.runs import CONFIG, read_config
from tangram_lab.experiments.plan import FORMAT, PLAN, Kind, seed_folder, test_file
from tangram_sim.errors import RunError

Row = dict[str, Any]
Checked = TypeVar("Checked")
Named = TypeVar("Named", "Training", "Trial")

PRIVATE = ("host", "run_dir")  # say nothing to anybody else
PLAIN = re.compile(r"[A-Za-z0-9][\w.-]*", re.ASCII)
AXES = ("updates", "episodes", "train_s")
REMAKE = "run its tangram-experiment command again, or name another folder with runs=..."
RETRAIN = "delete this folder of the seed and train it again, or leave it out"
RETEST = "delete the file and run tangram-experiment again"
# What may differ between the runs of one setting, where nobody planned them.
APART = ("seed", "run_dir", "resume")
AGENT = "agent.name"
NOTE = (
    "Runs that differ in nothing but their seed make one row. Their scores are those of the last "
    "evaluation, on the same test episodes for all of them."
)


@dataclass(frozen=True)
class Seed:
    """One run of a training.

    Attributes:
        number: the seed.
        state: `finished`, or why there is no result.
        result: content of result.json without the host's name; empty unless it is finished.
        curve: evaluations in the order of training, also of a run that is not finished.
        tests: name of a test -> content of its file.
    """

    number: int
    state: str
    result: Row
    curve: tuple[Row, ...]
    tests: dict[str, Row]

    @property
    def finished(self) -> bool:
        """Whether it trained to its bound."""
        return self.state == "finished"


@dataclass(frozen=True)
class Training:
    """One setting, trained with several seeds.

    Attributes:
        label: for people.
        family: the paper's architecture or another group that it belongs to.
        overrides: arguments of tangram-train.
        after: the training whose networks it began with, or None.
        name: in the plan, in folders and files.
        seeds: every planned one, in the plan's order.
    """

    label: str
    family: str
    overrides: tuple[str, ...]
    after: str | None = None
    name: str = ""
    seeds: tuple[Seed, ...] = ()

    @property
    def finished(self) -> tuple[Seed, ...]:
        """The seeds that trained to their bound."""
        return tuple(seed for seed in self.seeds if seed.finished)

    @property
    def tokens(self) -> str:
        """The shapes that it plays with, such as `large triangle`; empty while none is finished."""
        names = self.finished[0].result["tokens"] if self.finished else []
        return ", ".join(names).replace("_", " ")

    def values(self, key: str) -> dict[int, float]:
        """Seed -> a number of its result, where there is one."""
        return self.each(lambda seed: seed.result.get(key))

    def scores(self, test: str, key: str) -> dict[int, float]:
        """Seed -> a score in a test, where there is one."""
        return self.each(lambda seed: seed.tests.get(test, {}).get(key))

    def each(self, number: Callable[[Seed], float | None]) -> dict[int, float]:
        """Seed -> what a function makes of it, where it makes a number."""
        pairs = ((seed.number, number(seed)) for seed in self.finished)
        return {seed: float(value) for seed, value in pairs if value is not None}


@dataclass(frozen=True)
class Trial:
    """A test of the plan.

    Attributes:
        label: for people.
        overrides: arguments of tangram-eval.
        name: in the plan and of its files.
    """

    label: str
    overrides: tuple[str, ...] = ()
    name: str = ""

    @property
    def actions(self) -> int | None:
        """For each token; None as trained."""
        asked = self._asked("sim.actions_per_token")
        return None if asked is None else int(asked)

    @property
    def corner_noise(self) -> float | None:
        """Deviation of the noise on the corners that the agent sees, in arenas; None as trained."""
        asked = self._asked("sim.corner_noise")
        return None if asked is None else float(asked)

    def _asked(self, name: str) -> str | None:
        told = (text.partition("=") for text in self.overrides)
        return {key: value for key, _, value in told}.get(name)


@dataclass(frozen=True)
class Experiment:
    """A question, and the trainings and tests that answer it.

    Attributes:
        name: in the plan and in the names of files.
        title: for people.
        source: where it stands in the paper, such as `Fig. 4`.
        kind: one of `tangram_lab.experiments.plan.KINDS`.
        note: one or two sentences.
        trainings: in the order to show; a ranking compares with the first.
        tests: in the order to show.
    """

    name: str
    title: str
    source: str
    kind: str
    note: str
    trainings: tuple[Training, ...]
    tests: tuple[Trial, ...]


@dataclass(frozen=True)
class Study:
    """A folder of tangram-experiment that was read.

    Attributes:
        plan: content of plan.json; empty for runs that nobody planned.
        command: that made it.
        commit: of the source tree that planned it, or None.
        budget: name of the budget.
        budget_note: how it differs from the paper's.
        test_episodes: of every test.
        experiments: in the plan's order, as are trainings and tests.
    """

    plan: Row
    command: str
    commit: str | None
    budget: str
    budget_note: str
    planned_seeds: tuple[int, ...]
    test_episodes: int
    experiments: tuple[Experiment, ...]
    trainings: tuple[Training, ...]
    tests: tuple[Trial, ...]


# What the files must hold; what they hold beyond it is kept as it is


@dataclass(frozen=True)
class _Budget:
    name: str
    note: str
    seeds: tuple[Annotated[int, msgspec.Meta(ge=0)], ...]
    test_episodes: Annotated[int, msgspec.Meta(ge=0)]


@dataclass(frozen=True)
class _Experiment:
    title: str
    source: str
    kind: Kind
    note: str
    trainings: tuple[str, ...]
    tests: tuple[str, ...]
    labels: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Plan:
    command: str
    commit: str | None
    budget: _Budget
    experiments: dict[str, _Experiment]
    trainings: dict[str, Training]
    tests: dict[str, Trial]


@dataclass(frozen=True)
class _Result:
    mean_reward: float | None
    mean_reward_dense: float | None
    angle_error_deg_median: float | None
    position_error_median: float | None
    updates: float
    episodes: float
    train_s: float
    wall_s: float
    parameters: float
    tokens: tuple[str, ...]
    ended_by: str
    processor: str
    cores: Annotated[int, msgspec.Meta(ge=0)]
    commit: str | None
    versions: dict[str, str]


@dataclass(frozen=True)
class _Scores:
    mean_reward_dense: float | None = None
    angle_error_deg_median: float | None = None
    position_error_median: float | None = None


@dataclass(frozen=True)
class _Baseline(_Scores):
    mean_reward: float | None = None


@dataclass(frozen=True, kw_only=True)
class _Point(_Scores):
    updates: float
    episodes: float
    train_s: float
    mean_reward: float


@dataclass(frozen=True, kw_only=True)
class _Test(_Scores):
    mean_reward: float
    baselines: dict[str, _Baseline] = field(default_factory=dict)


def _read(path: Path, remedy: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise RunError(f"{path}: cannot be read ({error.strerror}); {remedy}") from None


def _parsed(
    text: bytes, kind: type[Checked], path: Path, remedy: str, line: int = 0
) -> tuple[Row, Checked]:
    """A JSON mapping as it stands, and what must be in it, checked."""
    at = f"line {line}: " if line else ""
    try:
        row = msgspec.json.decode(text, type=Row)
        return row, msgspec.convert(row, kind)
    except msgspec.ValidationError as error:
        raise RunError(f"{path}: {at}{error}; {remedy}") from None
    except (ValueError, RecursionError) as error:
        raise RunError(f"{path}: {at}it is not JSON ({error}); {remedy}") from None


def _without_private(row: Row) -> Row:
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
    content, _ = _parsed(_read(path, REMAKE), Row, path, REMAKE)
    if content.get("format") != FORMAT:
        raise RunError(
            f"{path}: its format is {content.get('format')!r}, but this version reads "
            f"{FORMAT}: use the version of tangram-report that fits, or make the study again"
        )
    _, plan = _parsed(_read(path, REMAKE), _Plan, path, REMAKE)
    for name in (*plan.experiments, *plan.trainings, *plan.tests):
        if not PLAIN.fullmatch(name):  # it becomes the name of files and folders
            raise RunError(
                f"{path}: '{name}' is no name of an experiment, a training or a test: use letters, "
                "digits, '.', '_' and '-'"
            )
    tests = {name: replace(one, name=name) for name, one in plan.tests.items()}
    trainings = {
        name: replace(
            one,
            name=name,
            seeds=tuple(
                read_seed(seed_folder(folder, name, seed), seed, tests)
                for seed in plan.budget.seeds
            ),
        )
        for name, one in plan.trainings.items()
    }
    return Study(
        plan=content,
        command=plan.command,
        commit=plan.commit,
        budget=plan.budget.name,
        budget_note=plan.budget.note,
        planned_seeds=plan.budget.seeds,
        test_episodes=plan.budget.test_episodes,
        experiments=tuple(
            _experiment(path, name, one, trainings, tests) for name, one in plan.experiments.items()
        ),
        trainings=tuple(trainings.values()),
        tests=tuple(tests.values()),
    )


def _experiment(
    path: Path,
    name: str,
    planned: _Experiment,
    trainings: Mapping[str, Training],
    tests: Mapping[str, Trial],
) -> Experiment:
    chosen = _chosen(path, "trainings", planned.trainings, trainings)
    return Experiment(
        name=name,
        title=planned.title,
        source=planned.source,
        kind=planned.kind,
        note=planned.note,
        trainings=tuple(replace(o, label=planned.labels.get(o.name, o.label)) for o in chosen),
        tests=_chosen(path, "tests", planned.tests, tests),
    )


def _chosen(
    path: Path, key: str, names: Sequence[str], known: Mapping[str, Named]
) -> tuple[Named, ...]:
    for name in names:
        if name not in known:
            raise RunError(f"{path}: its {key} lack '{name}', which an experiment names; {REMAKE}")
    return tuple(known[name] for name in names)


def read_seed(folder: Path, seed: int, tests: Iterable[str]) -> Seed:
    """What one run has left: nothing, a part, or all.

    Raises:
        RunError: a file that is there is not what it should be.
    """
    result: Row = {}
    state = "not finished" if folder.exists() else "not started"
    path, curve = folder / "result.json", folder / "curve.jsonl"
    if path.exists():
        result, checked = _parsed(_read(path, RETRAIN), _Result, path, RETRAIN)
        stopped = checked.ended_by.startswith("SIG")
        state = f"stopped by {checked.ended_by}" if stopped else "finished"
    files = {name: test_file(folder, name) for name in tests}
    return Seed(
        number=seed,
        state=state,
        result=_without_private(result),
        curve=tuple(_curve(curve)) if curve.exists() else (),
        tests={
            name: _without_private(_parsed(_read(file, RETEST), _Test, file, RETEST)[0])
            for name, file in files.items()
            if file.exists()
        },
    )


def _curve(path: Path) -> Iterator[Row]:
    """The points of a curve; a last line without its end is still being written."""
    last: Row = dict.fromkeys(AXES, 0)
    for number, line in enumerate(_read(path, RETRAIN).split(b"\n")[:-1], 1):
        row, _ = _parsed(line, _Point, path, RETRAIN, number)
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
        key = json.dumps(settings, sort_keys=True, default=str)
        runs = groups.setdefault(key, (settings, {}))[1]
        if seed in runs:
            raise RunError(
                f"{runs[seed]} and {path.parent} have the same settings and seed {seed}: take one "
                "of them out of the folder"
            )
        runs[seed] = path.parent
    settings_of_all = [settings for settings, _ in groups.values()]
    trainings = tuple(
        Training(
            label=_label(settings, settings_of_all),
            family=str(settings.get(AGENT)),
            overrides=tuple(_told(settings, _differing(settings_of_all))),
            name=f"setting_{number}",
            seeds=tuple(read_seed(runs[seed], seed, ()) for seed in sorted(runs)),
        )
        for number, (settings, runs) in enumerate(groups.values())
    )
    seeds = tuple(sorted({seed for _, runs in groups.values() for seed in runs}))
    only = Experiment("runs", f"Runs of {folder.name}", "", "ranking", NOTE, trainings, ())
    return Study({}, "", None, "", NOTE, seeds, 0, (only,), trainings, ())


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


def _label(own: Row, settings: Sequence[Row]) -> str:
    """The agent, and what tells this setting from the others of that agent."""
    alike = [other for other in settings if other.get(AGENT) == own.get(AGENT)]
    return ", ".join([str(own.get(AGENT)), *_told(own, _differing(alike))])


def _told(own: Row, names: Sequence[str]) -> list[str]:
    shown = {
        name: own[name]
        if isinstance(own[name], str)
        else json.dumps(own[name], separators=(",", ":"))
        for name in names
        if name in own
    }
    return [f"{name}={value}" for name, value in shown.items()]


def _differing(settings: Sequence[Row]) -> list[str]:
    """The settings that are not the same everywhere, in the config's order."""
    names = dict.fromkeys(name for one in settings for name in one)
    first = settings[0]
    return [name for name in names if any(one.get(name) != first.get(name) for one in settings)]
