"""tangram-eval: scores of a run on the fixed test set, or on puzzles."""

import json
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from tangram_agent.runs import Run, load_changed
from tangram_core.agent import AT_ONCE
from tangram_core.errors import ConfigError
from tangram_core.run.outcome import plural
from tangram_core.scores import Score, decimal
from tangram_core.store.files import write_whole
from tangram_core.task import Task
from tangram_game.config import ALL, EvalConfig, source_and_names
from tangram_game.figures.puzzles import Player, by, find_figures
from tangram_game.scores import (
    RUN,
    Scores,
    of_each,
    of_several,
    score_puzzles,
)
from tangram_sim.config import SimConfig
from tangram_tasks.place import Place
from tangram_tasks.played import Played
from worker.score.test_set import FixedTests

MAX_PADDED = 4  # policies in a table with blanks between its columns
MAX_LINES = 40  # puzzles on the screen

# Scores shown besides those that a task declares; all others are only in the file.
_BESIDE = (
    Score("seconds_per_puzzle", "seconds"),
    Score("ms_per_choice", "CPU ms for each action", 1),
)


def evaluate_run(config: EvalConfig) -> int:
    """Score a run and its task's rivals on the same episodes, print tables and write the scores.

    Returns:
        Exit status 0.

    Raises:
        RunError: a folder or a checkpoint is missing or corrupt, or a file is not writable.
        ConfigError: the run cannot play these puzzles or settings.
    """
    torch.set_num_threads(1)
    began = time.monotonic()
    run = load_changed(config.run, config.changes)
    report = (_episodes if config.puzzle is None else _puzzles)(run, config)
    if config.out is not None:
        report |= {"seconds": time.monotonic() - began}
        write_whole(Path(config.out), (json.dumps(report, indent=1) + "\n").encode())
        Console(highlight=False).print(f"written: {config.out}", markup=False, soft_wrap=True)
    return 0


def policies(run: Run, rivals: Sequence[str] = ALL) -> dict[str, Player]:
    """The run and its rivals, by their names in tables and files.

    Raises:
        ConfigError: a rival is unknown, or has the name of the run's own scores.
    """
    others = dict(run.setup.task.rivals())
    if RUN in others:
        raise ConfigError(f"the task calls a rival '{RUN}', as the agent's own column: rename it")
    if tuple(rivals) != ALL:
        for name in rivals:
            if name not in others:
                raise ConfigError(f"rivals: no '{name}' here, choose from {', '.join(others)}")
        others = {name: others[name] for name in rivals}
    return {RUN: by(run.actor)} | others


def score_policies(
    task: Task, players: Mapping[str, Player], config: EvalConfig
) -> dict[str, Scores]:
    """Score each policy on the same episodes."""
    with closing(FixedTests(task, config.episodes, AT_ONCE, seed=config.seed)) as tests:
        return {name: _scored(tests, player) for name, player in players.items()}


def _scored(tests: FixedTests, player: Player) -> Scores:
    whole, task = tests.play(player(tests.env)), tests.task
    scores: Scores = {**task.score(whole), "episodes": float(whole.episodes.count)}
    if not isinstance(task, Place):
        ended = whole.episodes.terminated.cumsum(axis=1) - whole.episodes.terminated
        return scores | {"ms_per_choice": 1e3 * float(whole.chose.sum() / (ended == 0).sum())}
    played = Played.of(whole)
    several = task.layout.tokens > 1
    return scores | (of_several(played) if several else of_each(played))


def _episodes(run: Run, config: EvalConfig) -> dict[str, Any]:
    """Play the test episodes and print the scores; returns the content of the file."""
    task = run.setup.task
    scores = score_policies(task, policies(run, config.rivals), config)
    tests = "fixed tests" if config.seed == 0 else f"tests of seed {config.seed}"
    caption = f"{config.episodes:,} {tests}"
    if isinstance(task, Place):
        caption = f"{caption}, {_told(task)}; positions in arena units"
    Console(highlight=False).print(scores_table(_title(run), caption, task.scores, scores))
    return {**_report(run, config, scores), "episodes": config.episodes}


def _puzzles(run: Run, config: EvalConfig) -> dict[str, Any]:
    """Assemble the puzzles and print the scores; returns the content of the file."""
    source, names = source_and_names(config.puzzle or ())
    task = run.task
    figures = find_figures(source, task, names, config.turns)
    players = policies(run, config.rivals)
    scored = score_puzzles(task, figures, players, config.seed)
    scores, lines = scored.means, scored.puzzles
    console = Console(highlight=False)
    count = len(figures)
    which = f"{plural(count, 'puzzle')} of {Path(source or 'the library').name}"
    caption = f"{which}, {_told(task)}; {scored.told}"
    console.print(scores_table(_title(run), caption, task.scores, scores))
    console.print(puzzles_table(lines, full=config.out))
    return _report(run, config, scores) | {
        "puzzle": list(config.puzzle or ()),
        "turns": config.turns,
        "puzzles": lines,
    }


def _report(run: Run, config: EvalConfig, scores: Mapping[str, Scores]) -> dict[str, Any]:
    """Content of the file: first the run's scores, named as in result.json."""
    task, world = run.setup.task, dict[str, Any]()
    if isinstance(task, Place):
        world = {"tokens": [shape.name for shape in task.layout.shapes], "sim": asdict(task.sim)}
    return {
        **scores[RUN],
        "test_seed": config.seed,
        "run_dir": str(run.folder),
        "updates": run.updates,
        **world,
        "agent": run.setup.config()["agent"],
        "baselines": {name: values for name, values in scores.items() if name != RUN},
    }


def _title(run: Run) -> str:
    return f"{run.folder.name} after {plural(run.updates, 'update')}"


def _told(task: Place) -> str:
    """The settings of the test, in words."""
    sim = task.sim
    parts = (
        f"{sim.actions_per_token} action{'s' * (sim.actions_per_token > 1)} a token",
        "exploration off",
        _observed(sim),
        sim.backend,
    )
    return ", ".join(parts)


def _observed(sim: SimConfig) -> str:
    """What agents see, in words."""
    if sim.looks:
        return f"pictures of {sim.pixels} px"
    if sim.observe == "silhouette":
        return "exact outlines, pieces hidden"
    return "exact corners"


def scores_table(
    title: str, caption: str, declared: Sequence[Score], scores: Mapping[str, Scores]
) -> Table:
    """A table with one column for each policy and one row for each score."""
    # Without blanks, more than five policies fit into 80 characters.
    table = Table(title=title, caption=caption, padding=(0, int(len(scores) <= MAX_PADDED)))
    table.add_column("", no_wrap=True)
    for name in scores:
        table.add_column(
            name.replace("=", " "), justify="right", style="bold" if name == RUN else "dim"
        )
    for score in (*declared, *_BESIDE):
        if score.name in scores[RUN]:
            table.add_row(score.label, *(score.shown(own[score.name]) for own in scores.values()))
    return table


def puzzles_table(puzzles: Sequence[Mapping[str, Any]], full: str | None) -> Table:
    """A table with one line for each puzzle that the run played, `MAX_LINES` at most.

    Args:
        puzzles: scores of each puzzle.
        full: file with all of them, if there is one.
    """
    left = len(puzzles) - MAX_LINES
    rest = f"and {left:,} more: all are in {full or 'the file that out= names'}"
    table = Table(caption=rest if left > 0 else None)
    counts = [name for name in ("wrong", "blocked") if all(name in one for one in puzzles)]
    for name in ("puzzle", "coverage", "IoU", *counts, ""):
        table.add_column(name, justify="left" if name in ("puzzle", "") else "right")
    for one in puzzles[:MAX_LINES]:
        name = f"{one['name']} {one['degrees']:g}°" if one["degrees"] else str(one["name"])
        shares = (decimal(one[key]) for key in ("coverage", "iou"))
        unfilled = "" if one.get("filled", True) else "not filled"
        end = "solved" if one["solved"] else unfilled
        table.add_row(name, *shares, *(str(one[count]) for count in counts), end)
    return table
