"""tangram-eval: what a finished run scores on the fixed test set, or on puzzles."""

import json
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from io import BytesIO
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from tangram_agent.agents.outline.agent import Outline
from tangram_agent.runs import Run, load_changed
from tangram_core.agent import AT_ONCE
from tangram_core.run.outcome import plural
from tangram_core.store.files import write_whole
from tangram_game.config import EvalConfig, source_and_names
from tangram_game.figures.puzzles import find_figures
from tangram_game.playing import Player, by
from tangram_game.rivals.fitted import fitted_policy
from tangram_game.scores import (
    RUN,
    Scored,
    Scores,
    of_each,
    of_outlines,
    of_several,
    score_hidden,
    score_outlines,
    score_pictured,
    score_puzzles,
)
from tangram_sim.config import SILHOUETTES, SimConfig
from tangram_sim.drawing.game_drawing import figure_sheet
from tangram_tasks.place import Place
from tangram_tasks.played import Played
from worker.score.test_set import FixedTests

MAX_PICTURES = 100  # on a sheet
MAX_PADDED = 5  # policies in a table
MAX_LINES = 40  # of puzzles and of faults on the screen

# Scores in the order of the table, with their labels and digits; the rest is only in the file.
_REWARDS = {
    "mean_reward": ("mean reward, polygons [-1, 1]", 3),
    "mean_reward_camera": ("mean reward, camera [-1, 1]", 3),
    "mean_train_reward": ("mean reward, as trained on", 3),
}
_ERRORS = {
    "position_error_median": ("position error, median", 4),
    "position_error_p90": ("position error, 90th percentile", 4),
    "angle_error_deg_median": ("angle error, median (degrees)", 2),
    "angle_error_deg_p90": ("angle error, 90th percentile", 2),
}
_ONE_TOKEN = {
    **_REWARDS,
    "raw_overlap": ("raw overlap [0, 1]", 3),
    "raw_overlap_p10": ("raw overlap, 10th percentile", 3),
    **_ERRORS,
}
# Short: a table of six policies should fit into 80 columns.
_SEVERAL = {
    "coverage": ("covered [0, 1]", 3),
    "raw_overlap_p10": ("covered, 10th perc.", 3),
    "iou": ("IoU", 3),
    "share_solved": ("solved, 95 % covered", 3),
    "share_solved_iou": ("solved, IoU 0.95", 3),
    "mean_train_reward": ("reward as trained on", 3),
    "position_error_median": ("position, median", 4),
    "position_error_p90": ("position, 90th perc.", 4),
    "angle_error_deg_median": ("angle (°), median", 2),
    "angle_error_deg_p90": ("angle (°), 90th perc.", 2),
    "wrong": ("under another shape", 2),
    "doubly_used": ("under two tokens", 2),
    "refused": ("refused: was placed", 2),
    "blocked": ("blocked by others", 2),
    "actions_used": ("actions", 2),
    "seconds_per_puzzle": ("seconds", 3),
    "search_seconds": ("of them the search", 3),
    "ms_per_decision": ("ms for each action", 1),
    "ms_slowest": ("CPU ms of the slowest", 0),
}


def evaluate_run(config: EvalConfig) -> int:
    """Score a run, print tables and write the scores.

    Policies that learned nothing play the same episodes, to compare with: `exact` moves every
    token exactly onto its target, `position only` one token onto its centre and never turns it,
    `random` is chance. Where tokens slide, `sweep rule` is `exact` in the order that pushes the
    least out of place. Where a world moves tokens otherwise than actions say, or several noisy
    looks at them can be put together, `fitted` is `exact` by a model of motion that has seen some
    random commands, and `oracle` knows that world and its noise.

    Returns:
        Exit status 0.

    Raises:
        RunError: a folder or a checkpoint that is missing or corrupt, or a file is not writable.
        ConfigError: puzzles or settings that the run cannot play.
    """
    torch.set_num_threads(1)
    began = time.monotonic()
    run = load_changed(config.run, config.changes)
    if not isinstance(run.setup.task, Place) and config.puzzle is None:
        report = _any_task(run, config)
    else:
        report = (_episodes if config.puzzle is None else _puzzles)(run, config)
    if config.out is not None:
        report |= {"seconds": time.monotonic() - began}
        write_whole(Path(config.out), (json.dumps(report, indent=1) + "\n").encode())
        Console(highlight=False).print(f"written: {config.out}", markup=False, soft_wrap=True)
    return 0


def policies(run: Run) -> dict[str, Player]:
    """The run, and those to compare it with, by their names in tables and files."""
    result, rivals = {RUN: by(run.actor)}, dict(run.task.rivals())
    agent, task = run.setup.agent, run.task
    if isinstance(agent, Outline):
        if agent.config.beam > 1:
            result["beam=1"] = by(run.with_settings({"agent": {"beam": 1}}).actor)
        # Of places that are worth the same the first is taken: that of the largest token.
        return {**result, "largest first": by(run.unlearned().actor), **rivals}
    first: dict[str, Player] = {
        name: rivals.pop(name) for name in ("exact", "sweep rule") if name in rivals
    }
    if task.sim.inexact or (task.sim.corner_noise and task.horizon > 1):
        first["fitted"] = fitted_policy
    return {**result, **first, **rivals}


def score_policies(
    task: Place, players: Mapping[str, Player], config: EvalConfig, at_once: int = AT_ONCE
) -> dict[str, Scores]:
    """Scores of each policy, on the same episodes."""
    with closing(FixedTests(task, config.episodes, at_once, seed=config.seed)) as tests:
        return {name: _scored(tests, player, at_once) for name, player in players.items()}


def _scored(tests: FixedTests, player: Player, at_once: int) -> Scores:
    whole, task = tests.play(player(tests.env)), tests.task
    played = Played.of(whole)
    scores: Scores = {**task.score(whole), "episodes": float(whole.episodes.count)}
    if not isinstance(task, Place):
        return scores
    if task.outlines:
        return scores | of_outlines(task, played, at_once)
    several = task.layout.tokens > 1
    return scores | (of_several(played, at_once) if several else of_each(played))


def _episodes(run: Run, config: EvalConfig) -> dict[str, Any]:
    """Play the test episodes and print the scores; the file's content."""
    scores = score_policies(run.task, policies(run), config, run.actor.at_once)
    tests = "fixed tests" if config.seed == 0 else f"tests of seed {config.seed}"
    caption = f"{config.episodes:,} {tests}, {_told(run.task)}; positions in arena units"
    Console(highlight=False).print(scores_table(_title(run), caption, scores))
    return {**_report(run, config, scores), "episodes": config.episodes}


def _any_task(run: Run, config: EvalConfig) -> dict[str, Any]:
    """Play test episodes of a task that is not of tokens, and print what it declares."""
    task, scores = run.setup.task, dict[str, Scores]()
    players: dict[str, Player] = {RUN: by(run.actor), **task.rivals()}
    with closing(FixedTests(task, config.episodes, run.actor.at_once, seed=config.seed)) as tests:
        for name, player in players.items():
            scores[name] = dict(task.score(tests.play(player(tests.env))))
    table = Table(title=_title(run), caption=f"{config.episodes:,} tests of seed {config.seed}")
    for name in ("", *scores):
        table.add_column(name, justify="right" if name else "left")
    for score in task.scores:
        table.add_row(score.label, *(score.shown(own.get(score.name)) for own in scores.values()))
    Console(highlight=False).print(table)
    rivals = {name: own for name, own in scores.items() if name != RUN}
    told = {"test_seed": config.seed, "run_dir": str(run.folder), "updates": run.updates}
    return {**scores[RUN], **told, "episodes": config.episodes, "baselines": rivals}


def _puzzles(run: Run, config: EvalConfig) -> dict[str, Any]:
    """Assemble the puzzles, print the scores and draw the sheet; the file's content."""
    source, names = source_and_names(config.puzzle or ())
    task = run.task
    figures = find_figures(source, task, names, config.turns)
    if task.outlines and task.sim.observe == "silhouette_pictures":
        scored = score_pictured(run, figures, config.seed)
    else:
        shown = score_hidden if task.sim.observe in SILHOUETTES else score_puzzles
        score = score_outlines if task.outlines else shown
        scored = score(task, figures, policies(run), config.seed, run.actor.at_once)
    scores, lines = scored.means, scored.puzzles
    console = Console(highlight=False)
    count = len(figures)
    which = f"{plural(count, 'puzzle')} of {Path(source or 'the library').name}"
    caption = f"{which}, {_told(task)}; {scored.told}"
    console.print(scores_table(_title(run), caption, scores))
    console.print(puzzles_table(lines, full=config.out))
    if config.sheet is not None:
        write_sheet(config.sheet, task, scored)
        console.print(f"written: {config.sheet}", markup=False, soft_wrap=True)
    return _report(run, config, scores) | {
        "puzzle": list(config.puzzle or ()),
        "turns": config.turns,
        "puzzles": lines,
    }


def _report(run: Run, config: EvalConfig, scores: Mapping[str, Scores]) -> dict[str, Any]:
    """The file's content: the run's scores on top, by the same names as in result.json."""
    task = run.task
    return {
        **scores[RUN],
        "test_seed": config.seed,
        "run_dir": str(run.folder),
        "updates": run.updates,
        "tokens": [shape.name for shape in task.layout.shapes],
        "sim": asdict(task.sim),
        "agent": run.setup.config()["agent"],
        "baselines": {name: values for name, values in scores.items() if name != RUN},
    }


def _title(run: Run) -> str:
    return f"{run.folder.name} after {plural(run.updates, 'update')}"


def _told(task: Place) -> str:
    """The settings of the test, in words."""
    sim = task.sim
    parts = [
        f"{sim.actions_per_token} action{'s' * (sim.actions_per_token > 1)} a token",
        "exploration off",
        _observed(sim),
        sim.backend if task.layout.tokens == 1 else f"{sim.backend}, {sim.motion}",
    ]
    parts += [f"world {sim.world}"] if sim.inexact else []
    return ", ".join(parts)


def _observed(sim: SimConfig) -> str:
    """What agents see, in words."""
    if sim.looks:
        pieces = "" if sim.observe == "pictures" else ", pieces hidden"
        return f"{sim.picture} pictures of {sim.pixels} px{pieces}"
    if sim.observe == "silhouette":
        noise = f", corners with noise {sim.corner_noise:g}" if sim.corner_noise else ""
        return f"exact outlines, pieces hidden{noise}"
    return f"corners with noise {sim.corner_noise:g}" if sim.corner_noise else "exact corners"


def write_sheet(path: str, task: Place, scored: Scored) -> None:
    """Write a picture of every figure's end, of at most `MAX_PICTURES`.

    Raises:
        RunError: the file is not writable.
    """
    picture = BytesIO()
    ends, goals = scored.ends[:MAX_PICTURES], scored.goals[:MAX_PICTURES]
    sheet = figure_sheet(task.layout, task.sim.arena, ends, goals, scored.titles[:MAX_PICTURES])
    sheet.save(picture, format="PNG")
    write_whole(Path(path), picture.getvalue())


def scores_table(title: str, caption: str, scores: Mapping[str, Scores]) -> Table:
    """One column for each policy, one row for each score."""
    # More than five fit into 80 columns without the blanks.
    table = Table(title=title, caption=caption, padding=(0, int(len(scores) <= MAX_PADDED)))
    table.add_column("", no_wrap=True)
    for name in scores:
        table.add_column(
            name.replace("=", " "), justify="right", style="bold" if name == RUN else "dim"
        )
    rows = _SEVERAL if "coverage" in scores[RUN] else _ONE_TOKEN
    for key, (label, digits) in rows.items():
        if key in scores[RUN]:
            table.add_row(label, *(f"{values[key]:.{digits}f}" for values in scores.values()))
    return table


def puzzles_table(puzzles: Sequence[Mapping[str, Any]], full: str | None) -> Table:
    """One line for each puzzle that the run played, the first `MAX_LINES` of them.

    Args:
        puzzles: scores of each.
        full: file that has all of them, if any.
    """
    left = len(puzzles) - MAX_LINES
    rest = f"and {left:,} more: all are in {full or 'the file that out= names'}"
    table = Table(caption=rest if left > 0 else None)
    counts = [name for name in ("wrong", "blocked") if all(name in one for one in puzzles)]
    for name in ("puzzle", "covered", "IoU", *counts, ""):
        table.add_column(name, justify="left" if name in ("puzzle", "") else "right")
    for one in puzzles[:MAX_LINES]:
        name = f"{one['name']} {one['degrees']:g}°" if one["degrees"] else str(one["name"])
        shares = (f"{one[key]:.3f}" for key in ("coverage", "iou"))
        unfilled = "" if one.get("filled", True) else "not filled"
        end = "solved" if one["solved"] else unfilled
        table.add_row(name, *shares, *(str(one[count]) for count in counts), end)
    return table
