"""tangram-eval: what a finished run scores on the fixed test set, or on puzzles."""

import json
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from tangram_agent.config import ORDERS
from tangram_agent.files import write_whole
from tangram_agent.runs import Run, load_run
from tangram_agent.setup import Setup
from worker.baselines import exact_policy, position_policy, random_policy
from worker.config import CHANGES, EvalConfig
from worker.puzzle_scores import of_several, score_puzzles, write_sheet
from worker.puzzles import find_figures
from worker.rollout import Choose
from worker.tables import RUN, Scores, print_faults, puzzles_table, scores_table
from worker.trials import Trials, adapted, greedy, with_actions, with_corner_noise

AT_ONCE = 32


def evaluate_run(config: EvalConfig) -> int:
    """Score a run, print tables and write the scores.

    Policies that learned nothing play the same episodes, to compare with: `exact` moves every
    token exactly onto its target, `position only` one token onto its centre and never turns it,
    `random` is chance. A run that learned which token is next also plays fixed orders.

    Returns:
        Exit status 0.

    Raises:
        RunError: a folder or a checkpoint that is missing or corrupt, or a file is not writable.
        ConfigError: puzzles or settings that the run cannot play.
    """
    torch.set_num_threads(1)
    began = time.monotonic()
    run = adapted(load_run(config.run), config.agent_changes)
    setup = with_corner_noise(with_actions(run.setup, config.actions), config.corner_noise)
    report = (_episodes if config.puzzles is None else _puzzles)(run, setup, config)
    if config.out is not None:
        report |= {"seconds": time.monotonic() - began}
        write_whole(Path(config.out), (json.dumps(report, indent=1) + "\n").encode())
        Console(highlight=False).print(f"written: {config.out}", markup=False, soft_wrap=True)
    return 0


def policies(run: Run, setup: Setup) -> dict[str, Choose]:
    """The run, and those to compare it with, by their names in tables and files."""
    layout, sim = setup.layout, setup.sim
    fixed = [order for order in ORDERS if order not in ("learned", run.setup.agent.order)]
    fixed = fixed if run.setup.pairs and layout.tokens > 1 else []
    result = {RUN: greedy(run.policy)}
    result |= {f"order={name}": greedy(run.with_agent(order=name).policy) for name in fixed}
    result["exact"] = exact_policy(layout, sim)
    if layout.tokens == 1:
        result["position only"] = position_policy(layout, sim)
    return result | {"random": random_policy(layout, sim)}


def score_policies(
    setup: Setup, players: Mapping[str, Choose], config: EvalConfig
) -> dict[str, Scores]:
    """Scores of each policy, on the same episodes."""
    with closing(Trials(setup, config.episodes, AT_ONCE, seed=config.seed)) as trials:
        return {name: _scored(trials, choose) for name, choose in players.items()}


def _scored(trials: Trials, choose: Choose) -> Scores:
    played = trials.play(choose)
    scores: Scores = dict(trials.scores(played))
    return scores | (of_several(played) if trials.setup.layout.tokens > 1 else {})


def _episodes(run: Run, setup: Setup, config: EvalConfig) -> dict[str, Any]:
    """Play the test episodes and print the scores; the file's content."""
    scores = score_policies(setup, policies(run, setup), config)
    tests = "fixed tests" if config.seed == 0 else f"tests of seed {config.seed}"
    caption = f"{config.episodes:,} {tests}, {_told(setup)}; positions in arena units"
    Console(highlight=False).print(scores_table(_title(run), caption, scores))
    return {**_report(run, setup, config, scores), "episodes": config.episodes}


def _puzzles(run: Run, setup: Setup, config: EvalConfig) -> dict[str, Any]:
    """Assemble the puzzles, print the scores and draw the sheet; the file's content."""
    source = str(config.puzzles)
    found = find_figures(source, setup, None, config.turns, config.skip_invalid)
    scores, lines, played = score_puzzles(setup, found.figures, policies(run, setup), config.seed)
    console = Console(highlight=False)
    count = len(found.figures)
    caption = f"{count:,} puzzles of {Path(source).name}, {_told(setup)}; positions in arena units"
    console.print(scores_table(_title(run), caption, scores))
    console.print(puzzles_table(lines, full=config.out))
    print_faults(console, found.faults)
    if config.sheet is not None:
        write_sheet(config.sheet, setup, found, played)
        console.print(f"written: {config.sheet}", markup=False, soft_wrap=True)
    return _report(run, setup, config, scores) | {
        "source": source,
        "turns": config.turns,
        "skipped": list(found.faults),
        "puzzles": lines,
    }


def _report(
    run: Run, setup: Setup, config: EvalConfig, scores: Mapping[str, Scores]
) -> dict[str, Any]:
    """The file's content: the run's scores on top, by the same names as in result.json."""
    agent = asdict(run.setup.agent)
    return {
        **scores[RUN],
        "actions": setup.sim.actions_per_token,
        "corner_noise": setup.sim.corner_noise,
        "test_seed": config.seed,
        "run_dir": str(run.folder),
        "updates": run.updates,
        "tokens": [shape.name for shape in setup.layout.shapes],
        "agent": agent["name"],
        **{name: agent[name] for name in CHANGES},
        "backend": setup.sim.backend,
        "motion": setup.sim.motion,
        "baselines": {name: values for name, values in scores.items() if name != RUN},
    }


def _title(run: Run) -> str:
    return f"{run.folder.name} after {run.updates:,} updates"


def _told(setup: Setup) -> str:
    """How was played, in words."""
    sim = setup.sim
    noise = sim.corner_noise
    parts = [
        f"{sim.actions_per_token} action{'s' * (sim.actions_per_token > 1)} a token",
        "exploration off",
        f"corners with noise {noise:g}" if noise else "exact corners",
        sim.backend if setup.layout.tokens == 1 else f"{sim.backend}, {sim.motion}",
    ]
    return ", ".join(parts)
