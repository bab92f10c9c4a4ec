"""The work of a study as processes: trainings and tests, and whether each is done."""

import json
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.plan import StudyConfig, seed_folder, test_file
from master.children import override
from tangram_agent.files import write_whole
from tangram_agent.runs import CONFIG
from tangram_sim.errors import ConfigError

RESULT = "result.json"
# What it says of a run that used up its budget.
BOUNDS = ("max_updates", "max_episodes", "max_hours")


@dataclass(frozen=True)
class Job:
    """One process that leaves one file.

    Attributes:
        name: for people.
        command: a console script of this installation, and its arguments.
        run_dir: the run folder that it works on.
        needs: files that must be there before it can start.
        leaves: its file.
        overrides: of a training; None for a test.
    """

    name: str
    command: tuple[str, ...]
    run_dir: Path
    needs: tuple[Path, ...]
    leaves: Path
    overrides: tuple[str, ...] | None = None

    @property
    def log(self) -> Path:
        """Where its output goes."""
        return self.run_dir / ("training.log" if self.overrides is not None else "tests.log")

    @property
    def ready(self) -> bool:
        """Whether it can start."""
        return all(finished(path) for path in self.needs)

    @property
    def done(self) -> bool:
        """Whether its file is there and says that it came to its end."""
        return finished(self.leaves)

    @property
    def arguments(self) -> list[str]:
        """Of this Python."""
        script, *rest = self.command
        return [str(Path(sys.executable).with_name(script)), *rest]

    def prepare(self) -> None:
        """Make its folders, and note the settings of a training before it starts."""
        self.leaves.parent.mkdir(parents=True, exist_ok=True)
        if self.overrides is not None:
            content = json.dumps({"overrides": list(self.overrides)}, indent=1) + "\n"
            write_whole(settings_file(self.run_dir), content.encode())

    def check(self) -> None:
        """Raise ConfigError if the folder holds a training with other settings."""
        path, begun = settings_file(self.run_dir), (self.run_dir / CONFIG).exists()
        if self.overrides is None or not begun:
            return
        stored = read_object(path).get("overrides")
        if stored != list(self.overrides):
            odd = sorted(set(map(str, stored or [])) ^ set(self.overrides))
            raise ConfigError(
                f"{self.run_dir} was trained with other settings ({', '.join(odd)}): remove it, or "
                "choose another run_dir"
            )


def settings_file(run_dir: Path) -> Path:
    """The settings that a training was started with."""
    return run_dir / "training.json"


def read_object(path: Path) -> dict[str, Any]:
    """A JSON object; empty where the file is missing or cannot be read."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def finished(path: Path) -> bool:
    """Whether a result file is there; that of a training must have ended by its budget."""
    content = read_object(path)
    ended_by = content.get("ended_by")
    if path.name != RESULT:
        return bool(content)
    return isinstance(ended_by, str) and ended_by.startswith(BOUNDS)


def make_jobs(config: StudyConfig) -> list[Job]:
    """All trainings seed by seed, each followed by its tests."""
    jobs: list[Job] = []
    for seed in config.budget.seeds:
        for name in config.wanted():
            training = _training(config, name, seed)
            jobs += [training, *(_test(config, training, t) for t in config.tests_of(name))]
    return jobs


def _training(config: StudyConfig, name: str, seed: int) -> Job:
    study = Path(config.run_dir)
    run_dir = seed_folder(study, name, seed)
    overrides = config.overrides(config.trainings[name])
    source = config.trainings[name].after
    begun = [] if source is None else [seed_folder(study, source, seed)]
    command = (
        "tangram-train",
        override("run_dir", str(run_dir)),
        f"seed={seed}",
        "resume=auto",
        *overrides,
        *(override("warm_start", str(folder)) for folder in begun),
    )
    needs = tuple(folder / RESULT for folder in begun)
    return Job(f"{name}, seed {seed}", command, run_dir, needs, run_dir / RESULT, tuple(overrides))


def _test(config: StudyConfig, training: Job, name: str) -> Job:
    test, out = config.tests[name], test_file(training.run_dir, name)
    settings = {"actions": test.actions, "corner_noise": test.corner_noise}
    command = (
        "tangram-eval",
        override("run_dir", str(training.run_dir)),
        override("out", str(out)),
        f"episodes={config.budget.test_episodes}",
        *(f"{key}={value}" for key, value in settings.items() if value is not None),
    )
    label = f"{training.name}, test {name}"
    return Job(label, command, training.run_dir, (training.leaves,), out)


def shown(command: Sequence[str]) -> str:
    """A command as it can be pasted into a shell."""
    return shlex.join(command)
