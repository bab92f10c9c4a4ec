"""The work of a study as processes: trainings and tests, and whether each is done."""

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from master.children import command, override
from tangram_agent.checkpoints import CHECKPOINTS
from tangram_agent.runs import CONFIG, read_config
from tangram_agent.setup import SECTIONS
from tangram_lab.experiments.plan import StudyConfig, seed_folder, test_file
from tangram_sim.errors import ConfigError

RESULT = "result.json"
# Settings of a test that its file calls otherwise.
IN_FILES = {"seed": "test_seed"}
BOUNDS = ("max_updates", "max_episodes", "max_hours")


@dataclass(frozen=True)
class Job:
    """One process that leaves one file.

    Attributes:
        name: for people.
        training: its name in the catalogue.
        command: the name of one of our commands, and its arguments.
        run_dir: the run folder that it works on.
        leaves: its file.
        needs: the training that must be done before it can start.
        settings: of a training: its whole config; of a test: what its file must say.
        trains: whether it is a training.
    """

    name: str
    training: str
    command: tuple[str, ...]
    run_dir: Path
    leaves: Path
    needs: "Job | None" = None
    settings: Mapping[str, Any] = field(default_factory=dict, hash=False)
    trains: bool = True

    @property
    def log(self) -> Path:
        """Where its output goes."""
        return self.run_dir / ("training.log" if self.trains else "tests.log")

    @property
    def ready(self) -> bool:
        """Whether it can start."""
        return self.needs is None or self.needs.done

    @property
    def done(self) -> bool:
        """Whether its file is there and is that of this job, come to its end."""
        return self.fits(read_object(self.leaves), read_object(self.run_dir / RESULT))

    def fits(self, content: Mapping[str, Any], trained: Mapping[str, Any]) -> bool:
        """Whether a file's content is that of this job, come to its end.

        Args:
            content: of a training its result, of a test its scores.
            trained: the result of the training: a test is of the final weights.
        """
        if self.trains:
            return _trained(content)
        told = {IN_FILES.get(name, name): value for name, value in self.settings.items()}
        return bool(content) and _says(content, {**told, "updates": trained.get("updates")})

    @property
    def arguments(self) -> list[str]:
        """Of this Python."""
        name, *rest = self.command
        return [*command(name), *rest]

    def prepare(self) -> None:
        """Make its folders."""
        self.leaves.parent.mkdir(parents=True, exist_ok=True)

    def check(self) -> None:
        """Raise ConfigError if the folder holds other settings, or no weights that are needed."""
        source = self.needs
        if source and source.done and not (source.run_dir / CHECKPOINTS).exists() and not self.done:
            raise ConfigError(
                f"{self.name} needs the weights of {source.run_dir}, which was kept of a report "
                "and has none: remove it, so that it is trained"
            )
        if not self.trains or not (self.run_dir / CONFIG).exists():
            return
        stored = read_config(self.run_dir / CONFIG)
        found = changed_settings(stored, self.settings, (*SECTIONS, *BOUNDS))
        if found:
            raise ConfigError(
                f"{self.run_dir} was trained with other settings ({', '.join(found)}): remove it, "
                "or choose another run_dir"
            )


def _says(content: object, wanted: object) -> bool:
    """Whether a file's content has all that is wanted, and perhaps more."""
    if isinstance(content, Mapping) and isinstance(wanted, Mapping):
        return all(_says(content.get(name), value) for name, value in wanted.items())
    # JSON knows no tuples.
    return content == (list(wanted) if isinstance(wanted, tuple) else wanted)


def _trained(content: Mapping[str, Any]) -> bool:
    """Whether a run used up its budget, and its final weights were scored."""
    ended_by, scored = content.get("ended_by"), content.get("scored_updates")
    by_budget = isinstance(ended_by, str) and ended_by.startswith(BOUNDS)
    return by_budget and scored is not None and scored == content.get("updates")


def changed_settings(
    stored: Mapping[str, Any], now: Mapping[str, Any], names: Iterable[str]
) -> list[str]:
    """Which of these settings are others now; of those that only one of both knows none."""
    return [text for name in names for text in _differences(name, stored, now)]


def _differences(name: str, one: object, other: object) -> Iterator[str]:
    """Where two configs disagree below a name; what only one of them knows does not count."""
    key = name.rpartition(".")[2]
    if not (isinstance(one, Mapping) and isinstance(other, Mapping)):
        return
    if key not in one or key not in other:
        return
    here, there = one[key], other[key]
    if isinstance(here, Mapping) and isinstance(there, Mapping):
        for inner in sorted(set(here) & set(there)):
            yield from _differences(f"{name}.{inner}", here, there)
    elif here != there:
        yield f"{name}={here}, now {there}"


def read_object(path: Path) -> dict[str, Any]:
    """A JSON object; empty where the file is missing or cannot be read."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def make_jobs(
    config: StudyConfig,
    resolved: Mapping[str, Mapping[str, Any]],
    asked: Mapping[str, Mapping[str, Any]],
    presets: str | None = None,
) -> list[Job]:
    """All trainings seed by seed, each followed by its tests.

    Args:
        config: the study.
        resolved: the whole config of each training that is wanted.
        asked: the settings of each test of them.
        presets: the folder of the user's own presets, where the study was given one.
    """
    jobs: list[Job] = []
    seeds = {name: config.seeds(name) for name in config.wanted()}
    for seed in sorted({seed for own in seeds.values() for seed in own}):
        trainings: dict[str, Job] = {}
        for name in (name for name, own in seeds.items() if seed in own):
            source = config.trainings[name].after
            needs = None if source is None else trainings[source]
            trainings[name] = _training(config, name, seed, needs, resolved[name], presets)
            tests = (
                _test(config, trainings[name], test, asked[test])
                for test in config.tests_of(name, seed)
            )
            jobs += [trainings[name], *tests]
    return jobs


def _training(
    config: StudyConfig,
    name: str,
    seed: int,
    needs: Job | None,
    settings: Mapping[str, Any],
    presets: str | None,
) -> Job:
    run_dir = seed_folder(Path(config.run_dir), name, seed)
    told = (
        "train",
        *([] if presets is None else [f"--config-dir={presets}"]),
        override("run_dir", str(run_dir)),
        f"seed={seed}",
        "resume=auto",
        *config.command(name),
        *([] if needs is None else [override("warm_start", str(needs.run_dir))]),
    )
    return Job(f"{name}, seed {seed}", name, told, run_dir, run_dir / RESULT, needs, settings)


def _test(config: StudyConfig, training: Job, name: str, asked: Mapping[str, Any]) -> Job:
    out = test_file(training.run_dir, name)
    told = (
        "eval",
        override("run_dir", str(training.run_dir)),
        override("out", str(out)),
        *config.test_command(name),
    )
    label = f"{training.name}, test {name}"
    return Job(label, training.training, told, training.run_dir, out, training, asked, trains=False)
