"""Runs that lie in one folder without a plan, as `tangram-train --multirun` leaves them."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tangram_agent.runs import CONFIG, read_config
from tangram_lab.experiments.plan import PLAN
from tangram_lab.experiments.report.reading import read_seed, read_study
from tangram_lab.experiments.report.study import Experiment, Study, Training
from tangram_sim.errors import RunError

# What may differ between the runs of one setting.
APART = ("seed", "run_dir", "resume")
AGENT = "agent.name"
NOTE = (
    "Runs that differ in nothing but their seed make one row. Their scores are those of the last "
    "evaluation, on the same test episodes for all of them."
)

Settings = dict[str, Any]


def read_runs(folder: Path) -> Study:
    """A study, or the runs of a folder that nobody planned.

    Raises:
        RunError: neither is there, or a file is not what it should be.
    """
    configs = sorted(folder.glob(f"*/{CONFIG}"), key=lambda path: _by_number(path.parent.name))
    if (folder / PLAN).exists() or not configs:
        return read_study(folder)
    groups: dict[str, tuple[Settings, dict[int, Path]]] = {}
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
    return _study(folder, list(groups.values()))


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


def _study(folder: Path, groups: Sequence[tuple[Settings, dict[int, Path]]]) -> Study:
    settings = [group for group, _ in groups]
    trainings = tuple(
        Training(
            name=f"setting_{number}",
            label=_label(group, settings),
            family=str(group.get(AGENT)),
            overrides=tuple(_told(group, _differing(settings))),
            after=None,
            seeds=tuple(read_seed(runs[seed], seed, {}) for seed in sorted(runs)),
        )
        for number, (group, runs) in enumerate(groups)
    )
    title = f"Runs of {folder.name}"
    return Study(
        plan={},
        command="",
        commit=None,
        budget="",
        budget_note=NOTE,
        planned_seeds=tuple(sorted({seed for _, runs in groups for seed in runs})),
        test_episodes=0,
        experiments=(Experiment("runs", title, "", "ranking", NOTE, trainings, ()),),
        trainings=trainings,
        tests=(),
    )


def _label(own: Settings, settings: Sequence[Settings]) -> str:
    """The agent, and what tells this setting from the others of that agent."""
    alike = [other for other in settings if other.get(AGENT) == own.get(AGENT)]
    return ", ".join([str(own.get(AGENT)), *_told(own, _differing(alike))])


def _told(own: Settings, names: Sequence[str]) -> list[str]:
    return [f"{name}={_short(own[name])}" for name in names if name in own]


def _short(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))


def _differing(settings: Sequence[Settings]) -> list[str]:
    """The settings that are not the same everywhere, in the config's order."""
    names = dict.fromkeys(name for one in settings for name in one)
    first = settings[0]
    return [name for name in names if any(one.get(name) != first.get(name) for one in settings)]
