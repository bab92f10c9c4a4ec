"""What experiments consist of: trainings over seeds and tests of them, each done once.

A study folder holds all of them: `plan.json`, a run folder for every training and seed, and in it
a file for every test.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import msgspec

from tangram_agent.messages import MAX_SEED
from tangram_agent.setup import SECTIONS
from tangram_sim.errors import ConfigError
from tangram_sim.settings import (
    Settings,
    check_choice,
    check_folder,
    check_range,
    declared,
    setting,
)

FORMAT = 4
Kind = Literal["curves", "complexity", "tests", "rewards", "ranking", "game", "worlds"]
KINDS: tuple[str, ...] = get_args(Kind)
PLAN = "plan.json"
# What a training comes to; the rest is where it runs.
KEPT = (*SECTIONS, "service", "workers", "max_updates", "max_episodes", "max_hours")
UNREADABLE = (
    *(OSError, OverflowError, ValueError, KeyError, TypeError, AttributeError, RecursionError),
    msgspec.ValidationError,
)
JOINED = ("experiments", "trainings", "tests", "fingerprints")  # of all commands in a folder


@dataclass(frozen=True)
class TrainingConfig:
    """One setting, trained once for every seed.

    Attributes:
        label: for figures and tables.
        family: what it has in common with others; budgets are given by family.
        overrides: of tangram-train, after those of family and budget.
        after: a training whose networks this one begins with, seed by seed.
    """

    label: str
    family: str
    overrides: tuple[str, ...] = ()
    after: str | None = None


@dataclass(frozen=True)
class TestConfig:
    """One test of a trained agent.

    Attributes:
        label: for figures and tables.
        overrides: of tangram-eval.
    """

    __test__ = False  # pytest collects classes of this name

    label: str
    overrides: tuple[str, ...] = ()


@dataclass(frozen=True)
class ExperimentConfig:
    """One figure or table.

    Attributes:
        title, note: for the report.
        source: where the paper has it.
        kind: of figure and table: one of KINDS.
        trainings, tests: names in the catalogue; every test is made of every training, and the
            first one's scores are what figures and tables show where they show one.
        labels: of trainings that are called otherwise here than in the catalogue.
        main: whether README shows it: its trainings have all of the budget's main seeds.
    """

    title: str
    source: str
    kind: str
    note: str
    trainings: tuple[str, ...]
    tests: tuple[str, ...] = ()
    labels: dict[str, str] = field(default_factory=dict)
    main: bool = False

    def __post_init__(self) -> None:
        check_choice("kind", self.kind, KINDS)
        for name in self.labels:
            check_choice("labels", name, self.trainings)


@dataclass(frozen=True)
class BudgetConfig:
    """How long everything is trained.

    Attributes:
        name: of the preset.
        note: for the report: what is smaller than in the paper.
        seeds: of every training.
        main_seeds: of those that README shows.
        test_episodes: of every test.
        test_seed: of these episodes: those that no decision was made on, but where nothing is
            learned anyway.
        overrides: of tangram-train, by family; `all` holds for every family.
    """

    name: str
    note: str
    seeds: tuple[int, ...]
    main_seeds: tuple[int, ...]
    test_episodes: int
    test_seed: int
    overrides: dict[str, tuple[str, ...]]

    def __post_init__(self) -> None:
        check_range("budget.test_episodes", self.test_episodes, 1)
        check_range("budget.test_seed", self.test_seed, 0)
        for name, seeds in (("seeds", self.seeds), ("main_seeds", self.main_seeds)):
            if not seeds or len(set(seeds)) < len(seeds):
                raise ConfigError(f"budget.{name} must be different numbers, got {list(seeds)}")
            for seed in seeds:
                check_range(f"budget.{name}", seed, 0, MAX_SEED)


@dataclass(frozen=True)
class StudyConfig(Settings):
    """Experiments, and where and how they are run.

    Attributes:
        budget: of every training.
        families: overrides that the trainings of a family share.
        trainings, tests: the catalogue.
        experiments: what to run.
    """

    run_dir: str = field(metadata=declared("folder of all trainings; experiments share them"))
    budget: BudgetConfig
    families: dict[str, tuple[str, ...]]
    trainings: dict[str, TrainingConfig]
    tests: dict[str, TestConfig]
    experiments: dict[str, ExperimentConfig] = field(default_factory=dict)
    jobs: int = setting(2, "trainings at a time; a learner keeps one core busy", low=1, high=1024)
    keep: str | None = setting(
        None,
        "folder of an earlier report: of its runs those are kept that this code would train alike, "
        "by their settings and 20 updates; that it would test them alike is not looked at",
    )
    dry: bool = setting(False, "only list what would be done")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_folder("run_dir", self.run_dir)
        if self.keep is not None:
            check_folder("keep", self.keep)
        for name, experiment in self.experiments.items():
            for kind, wanted in (("trainings", experiment.trainings), ("tests", experiment.tests)):
                _check_known(f"experiment {name}: {kind}", wanted, getattr(self, kind))
        for name, training in self.trainings.items():
            _check_known(f"training {name}: family", (training.family,), self.families)
            if training.after is not None:
                _check_known(f"training {name}: after", (training.after,), self.trainings)

    def command(self, name: str) -> list[str]:
        """Everything that tangram-train is told, each setting once: the last word counts."""
        training = self.trainings[name]
        budget = self.budget.overrides
        said = (
            *self.families[training.family],
            *budget.get("all", ()),
            *budget.get(training.family, ()),
            *training.overrides,
        )
        return list({text.partition("=")[0]: text for text in said}.values())

    def test_command(self, name: str) -> list[str]:
        """Everything that tangram-eval is told; puzzles are as many as there are."""
        overrides = self.tests[name].overrides
        seed = f"seed={self.budget.test_seed}"
        if any(text.startswith("puzzle=") for text in overrides):
            return [seed, *overrides]
        return [f"episodes={self.budget.test_episodes}", seed, *overrides]

    def seeds(self, training: str) -> list[int]:
        """Of a training: those of all experiments that need it."""
        found = set[int]()
        for experiment in self.experiments.values():
            if any(training in self._sources(wanted) for wanted in experiment.trainings):
                found.update(self.seeds_of(experiment))
        return sorted(found)

    def seeds_of(self, experiment: ExperimentConfig) -> tuple[int, ...]:
        """Of all trainings of an experiment."""
        return self.budget.main_seeds if experiment.main else self.budget.seeds

    def wanted(self) -> list[str]:
        """The trainings of all experiments, those that others begin with before them."""
        names: dict[str, None] = {}
        for experiment in self.experiments.values():
            for name in experiment.trainings:
                for source in reversed(list(self._sources(name))):
                    names[source] = None
        return list(names)

    def _sources(self, name: str) -> Iterator[str]:
        """A training, the one that it begins with, and so on."""
        seen: list[str] = []
        current: str | None = name
        while current is not None:
            if current in seen:
                raise ConfigError(f"training {name} begins with itself: {' <- '.join(seen)}")
            seen.append(current)
            yield current
            current = self.trainings[current].after

    def tests_of(self, training: str, seed: int | None = None) -> list[str]:
        """The tests of a training, or of one of its seeds, in all experiments."""
        found = [
            e.tests
            for e in self.experiments.values()
            if training in e.trainings and (seed is None or seed in self.seeds_of(e))
        ]
        return list(dict.fromkeys(name for tests in found for name in tests))


def _check_known(what: str, names: tuple[str, ...], known: Mapping[str, Any]) -> None:
    for name in names:
        if name not in known:
            raise ConfigError(f"{what} '{name}' is not in the catalogue: use {', '.join(known)}")


def seed_folder(study: Path, training: str, seed: int) -> Path:
    """The run folder of one training with one seed."""
    return training_folder(study, training) / f"seed_{seed}"


def training_folder(study: Path, training: str) -> Path:
    """The folder of all seeds of a training."""
    return study / "trainings" / training


def test_file(run_dir: Path, test: str) -> Path:
    """The scores of a test of a run."""
    return run_dir / "tests" / f"{test}.json"


test_file.__test__ = False  # type: ignore[attr-defined] # pytest collects functions of this name


def plan_content(
    config: StudyConfig, source: Mapping[str, Any], resolved: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """What plan.json says of this command: everything that a report needs to know.

    Args:
        config: the study.
        source: where its numbers come from.
        resolved: the whole config of each training that is wanted.
    """
    budget = {
        "name": config.budget.name,
        "note": config.budget.note,
        "test_episodes": config.budget.test_episodes,
        "test_seed": config.budget.test_seed,
    }
    wanted = config.wanted()
    tests = {test: None for name in wanted for test in config.tests_of(name)}
    return {
        "format": FORMAT,
        **source,
        "budget": budget,
        "experiments": {name: asdict(e) for name, e in config.experiments.items()},
        "trainings": {
            name: {
                "label": config.trainings[name].label,
                "family": config.trainings[name].family,
                "overrides": config.command(name),
                "after": config.trainings[name].after,
                "settings": {key: resolved[name][key] for key in KEPT if key in resolved[name]},
                "seeds": config.seeds(name),
            }
            for name in wanted
        },
        "tests": {name: asdict(config.tests[name]) for name in tests},
        "fingerprints": {},
    }


def joined_plan(path: Path, content: dict[str, Any]) -> dict[str, Any]:
    """A plan together with what earlier commands put into the same folder, their seeds too.

    Raises:
        ConfigError: the folder was made with another budget or by another version, or its plan
            cannot be read.
    """
    if not path.exists():
        return content
    try:
        earlier = json.loads(path.read_text(encoding="utf-8"))
        if (found := earlier["format"]) != FORMAT:
            raise ConfigError(
                f"{path} is of format {found}, and this version writes {FORMAT}: choose another "
                "run_dir"
            )
        known = {name: dict(earlier[name]) for name in (*JOINED, "budget")}
        planned = {name: {*map(int, one["seeds"])} for name, one in known["trainings"].items()}
        msgspec.convert(known["fingerprints"], dict[str, dict[str, float]])
    except UNREADABLE:
        raise ConfigError(f"cannot read {path}: remove it, or choose another run_dir") from None
    for name in ("name", "test_episodes", "test_seed"):
        earlier, now = known["budget"].get(name), content["budget"][name]
        if earlier != now:
            raise ConfigError(
                f"{path.parent} was made with budget.{name}={earlier}, now it is {now}: choose "
                "another run_dir"
            )
    merged = {name: known[name] | content[name] for name in JOINED}
    for name, seeds in planned.items():
        every = sorted({*seeds, *merged["trainings"][name]["seeds"]})
        merged["trainings"][name] = merged["trainings"][name] | {"seeds": every}
    return content | merged
