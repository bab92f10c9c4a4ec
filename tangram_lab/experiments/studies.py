"""The studies of conf/studies.yaml: which agents are trained, over which seeds, and how tested."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import msgspec
import yaml

from tangram_core.errors import ConfigError
from tangram_core.settings import Settings, check_choice, check_folder, declared, setting

FILE = Path(__file__).parents[2] / "conf" / "studies.yaml"
Overrides = tuple[str, ...]


class Budget(msgspec.Struct, forbid_unknown_fields=True):
    """How long everything is trained and tested.

    Attributes:
        seeds: of every training, at most.
        tests: episodes of every test.
        test_seed: of these episodes.
        set: what every training is told.
    """

    seeds: int
    tests: int
    test_seed: int
    set: Overrides


class Training(msgspec.Struct, forbid_unknown_fields=True):
    """One setting, trained once for every seed.

    Attributes:
        label: for tables and figures.
        family: what it has in common with others.
        tests: names of tests.
        set: what it alone is told.
        seeds: how many, instead of the study's; not more than those of `after`.
        after: an earlier training, whose agent of the same seed it goes on with.
    """

    label: str
    family: str
    tests: tuple[str, ...]
    set: Overrides = ()
    seeds: int | None = None
    after: str | None = None


class Figure(msgspec.Struct, forbid_unknown_fields=True):
    """A figure of a study's rows.

    Attributes:
        kind: curves while learning; scores over several tests; or those of every seed in one test.
        title: above it.
        trainings: from the first to the last.
        measure: the column that is drawn.
        tests: of the kind `tests`.
        test: of the kind `seeds`.
        reported: what somebody else reports: name -> a level, or a score for each test.
        job: episodes of ours in one of the paper's, which the first panel of curves counts; 0: the
            second panel counts seconds.
    """

    kind: Literal["curves", "tests", "seeds"]
    title: str
    trainings: tuple[str, ...]
    measure: str = "mean_reward"
    tests: tuple[str, ...] = ()
    test: str = ""
    reported: dict[str, tuple[float, ...]] = {}
    job: int = 0


class Study(msgspec.Struct, forbid_unknown_fields=True):
    """Trainings whose rows stand in one CSV.

    Attributes:
        title: of its page.
        seeds: of a training that says nothing else.
        trainings: by name.
        figures: by the names of their files.
    """

    title: str
    seeds: int
    trainings: dict[str, Training]
    figures: dict[str, Figure] = {}


class Studies(msgspec.Struct, forbid_unknown_fields=True):
    """The whole file; a family has `set`, and what it is told in each budget."""

    budgets: dict[str, Budget]
    families: dict[str, dict[str, Overrides]]
    tests: dict[str, Overrides]
    studies: dict[str, Study]


def read_studies(path: Path = FILE) -> Studies:
    """The file, checked.

    Raises:
        ConfigError: it is no file of studies, or names what it has not.
    """
    try:
        found = msgspec.convert(yaml.safe_load(path.read_text(encoding="utf-8")), Studies)
    except (OSError, ValueError, msgspec.ValidationError, yaml.YAMLError) as error:
        raise ConfigError(f"cannot read the studies of {path}: {error}") from None
    for name, study in found.studies.items():
        earlier = list[str]()
        for key, training in study.trainings.items():
            for what, wanted, known in (
                ("family", (training.family,), found.families),
                ("test", training.tests, found.tests),
                ("earlier training", [training.after] if training.after else [], earlier),
            ):
                for one in wanted:
                    if one not in known:
                        raise ConfigError(f"{path}: {name}, {key}: there is no {what} '{one}'")
            earlier.append(key)
    return found


@dataclass(frozen=True)
class StudyConfig(Settings):
    """A study, and where and how it is run."""

    run_dir: str = field(metadata=declared("folder of all runs; what is there goes on"))
    study: str = setting("paper", "of conf/studies.yaml: paper, token, parts, game, ...")
    budget: str = setting("laptop", "smoke (a minute), laptop or paper (hours)")
    seeds: int | None = setting(None, "of every training, at most; null is the budget's", low=1)
    out: str | None = setting(
        None, "folder of STUDY.csv; rows that are there are not made again; null is run_dir"
    )
    jobs: int = setting(2, "trainings at a time; a learner keeps one core busy", low=1, high=1024)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_folder("run_dir", self.run_dir)
        if self.out is not None:
            check_folder("out", self.out)


@dataclass(frozen=True)
class Job:
    """One training with one seed, and its tests.

    Attributes:
        training, label, seed: of its rows.
        told: what tangram-train is told.
        tests: name -> what tangram-eval is told.
        drawn: whether a figure shows how it learned.
        after: the training that it goes on with.
    """

    training: str
    label: str
    seed: int
    told: Overrides
    tests: Mapping[str, Overrides]
    drawn: bool
    after: str | None

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.training}, seed {self.seed}"


def jobs_of(config: StudyConfig, known: Studies) -> Iterator[Job]:
    """Everything that a study consists of, seed by seed.

    Raises:
        ConfigError: there is no such study or budget.
    """
    check_choice("study", config.study, tuple(known.studies))
    check_choice("budget", config.budget, tuple(known.budgets))
    study, budget = known.studies[config.study], known.budgets[config.budget]
    most = config.seeds or budget.seeds
    counts = dict[str, int]()
    for name, one in study.trainings.items():
        most_here = counts[one.after] if one.after else most
        counts[name] = min(one.seeds or study.seeds, most_here)
    curves = [one.trainings for one in study.figures.values() if one.kind == "curves"]
    drawn = {name for names in curves for name in names}
    for seed in range(max(counts.values())):
        for name, training in study.trainings.items():
            if seed < counts[name]:
                tests = {test: _test(known.tests[test], budget) for test in training.tests}
                told = train_overrides(known, config.budget, training)
                yield Job(name, training.label, seed, told, tests, name in drawn, training.after)


def train_overrides(known: Studies, budget: str, training: Training) -> Overrides:
    """What a training is told, each setting once: the last word counts."""
    family = known.families[training.family]
    said = (*family["set"], *known.budgets[budget].set, *family.get(budget, ()), *training.set)
    return tuple({text.partition("=")[0]: text for text in said}.values())


def _test(told: Overrides, budget: Budget) -> Overrides:
    """What tangram-eval is told; puzzles are as many as there are."""
    puzzles = any(text.startswith("puzzle=") for text in told)
    count = () if puzzles else (f"episodes={budget.tests}",)
    return (*count, f"seed={budget.test_seed}", *told)
