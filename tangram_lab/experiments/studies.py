"""The studies of conf/studies.yaml: their trainings, seeds, tests and figures."""

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
    """How long every training and test of a study is.

    Attributes:
        seeds: largest number of seeds of a training.
        tests: episodes of every test.
        test_seed: seed of the test episodes.
        set: settings of every training.
    """

    seeds: int
    tests: int
    test_seed: int
    set: Overrides


class Training(msgspec.Struct, forbid_unknown_fields=True):
    """One configuration of an agent, trained once for every seed.

    Attributes:
        label: name in tables and figures.
        family: name of the family whose settings the training uses.
        tests: names of its tests.
        set: settings of this training alone.
        seeds: number of seeds instead of the study's; at most as many as `after` has.
        after: an earlier training; its agent of the same seed is trained further.
    """

    label: str
    family: str
    tests: tuple[str, ...]
    set: Overrides = ()
    seeds: int | None = None
    after: str | None = None


class Figure(msgspec.Struct, forbid_unknown_fields=True):
    """A figure drawn from the rows of a study.

    Attributes:
        kind: "curves": learning curves; "tests": scores in several tests; "seeds": the score of
            every seed in one test.
        title: text above the figure.
        trainings: names of the trainings, in the order of drawing.
        measure: the column that is drawn.
        tests: names of the tests, for kind "tests".
        test: name of the test, for kind "seeds".
        reported: scores that others report: name -> one score, or one for each test.
        job: how many of our episodes make one of the paper's; the axes of curves are then paper
            episodes and simulations. 0: the axes are our episodes and seconds.
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
    """Trainings that share one CSV file of results.

    Attributes:
        title: title of the page.
        seeds: number of seeds of a training, unless the training has its own.
        trainings: name -> training.
        figures: name of the file -> figure.
    """

    title: str
    seeds: int
    trainings: dict[str, Training]
    figures: dict[str, Figure] = {}


class Studies(msgspec.Struct, forbid_unknown_fields=True):
    """The content of conf/studies.yaml.

    Attributes:
        budgets: name -> budget.
        families: name -> settings: those under "set", and more under the name of a budget.
        tests: name -> settings of tangram-eval.
        studies: name -> study.
    """

    budgets: dict[str, Budget]
    families: dict[str, dict[str, Overrides]]
    tests: dict[str, Overrides]
    studies: dict[str, Study]


def read_studies(path: Path = FILE) -> Studies:
    """Read and check a file of studies.

    Raises:
        ConfigError: the file is invalid, or a training names something that does not exist.
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
    """Settings of tangram-experiment."""

    run_dir: str = field(metadata=declared("folder of all runs; unfinished runs in it are resumed"))
    study: str = setting("paper", "a study of conf/studies.yaml: paper, token, parts, game, ...")
    budget: str = setting("laptop", "smoke (a minute), laptop or paper (hours)")
    seeds: int | None = setting(
        None, "largest number of seeds of a training; null: that of the budget", low=1
    )
    out: str | None = setting(
        None, "folder of STUDY.csv; tests with a row there are not run again; null: run_dir"
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
        training, label, seed: values for these columns of the rows.
        told: settings for tangram-train.
        tests: name -> settings for tangram-eval.
        drawn: whether a figure shows the learning curve.
        after: name of the training whose agent is trained further; None to begin anew.
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
        """Name of the training with its seed, for messages."""
        return f"{self.training}, seed {self.seed}"


def jobs_of(config: StudyConfig, known: Studies) -> Iterator[Job]:
    """All jobs of a study, seed by seed.

    Raises:
        ConfigError: the study or the budget does not exist.
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
    """Settings of a training, each once; a later setting replaces an earlier one.

    The order is: family, budget, family in this budget, training.
    """
    family = known.families[training.family]
    said = (*family["set"], *known.budgets[budget].set, *family.get(budget, ()), *training.set)
    return tuple({text.partition("=")[0]: text for text in said}.values())


def _test(told: Overrides, budget: Budget) -> Overrides:
    """Settings of tangram-eval for a test; a test on puzzles always plays all of them."""
    puzzles = any(text.startswith("puzzle=") for text in told)
    count = () if puzzles else (f"episodes={budget.tests}",)
    return (*count, f"seed={budget.test_seed}", *told)
