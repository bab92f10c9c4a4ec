"""tangram-eval: what a finished run scores on the fixed test set."""

import json
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from tangram_agent.files import write_whole
from tangram_agent.runs import Run, load_run
from tangram_agent.setup import Setup
from worker.baselines import exact_policy, position_policy, random_policy
from worker.config import EvalConfig
from worker.rollout import Choose
from worker.trials import Trials, greedy, with_actions, with_corner_noise

AT_ONCE = 32
RUN = "this run"

# Scores in the order of the table, with their labels and digits; the rest is only in the file.
_ROWS = {
    "mean_reward": ("mean reward, polygons [-1, 1]", 3),
    "mean_reward_camera": ("mean reward, camera [-1, 1]", 3),
    "mean_train_reward": ("mean reward, as trained on", 3),
    "raw_overlap": ("raw overlap [0, 1]", 3),
    "raw_overlap_p10": ("raw overlap, 10th percentile", 3),
    "position_error_median": ("position error, median", 4),
    "position_error_p90": ("position error, 90th percentile", 4),
    "angle_error_deg_median": ("angle error, median (degrees)", 2),
    "angle_error_deg_p90": ("angle error, 90th percentile", 2),
}

Scores = dict[str, float]


def evaluate_run(config: EvalConfig) -> int:
    """Score a run, print a table and write the scores.

    Three policies that learned nothing play the same episodes, to compare with: `exact` moves
    every token exactly onto its target, `position only` onto its centre and never turns it,
    `random` is chance.

    Returns:
        Exit status 0.

    Raises:
        RunError: a folder or a checkpoint that is missing or corrupt, or `out` is not writable.
    """
    torch.set_num_threads(1)
    began = time.monotonic()
    run = load_run(config.run_dir)
    setup = with_corner_noise(with_actions(run.setup, config.actions), config.corner_noise)
    scores = score_policies(setup, greedy(run.policy), config)
    if config.out is not None:
        report = _report(run, setup, config, scores) | {"seconds": time.monotonic() - began}
        write_whole(Path(config.out), (json.dumps(report, indent=1) + "\n").encode())
    console = Console(highlight=False)
    console.print(_table(run, setup, config, scores))
    if config.out is not None:
        console.print(f"written: {config.out}", markup=False, soft_wrap=True)
    return 0


def score_policies(setup: Setup, choose: Choose, config: EvalConfig) -> dict[str, Scores]:
    """Scores of a policy and of those to compare with, on the same episodes."""
    policies = {
        RUN: choose,
        "exact": exact_policy(setup.layout, setup.sim.arena),
        "position only": position_policy(setup.layout, setup.sim.arena),
        "random": random_policy(setup.action_size),
    }
    with closing(Trials(setup, config.episodes, AT_ONCE, seed=config.seed)) as trials:
        return {name: trials.scores(trials.play(one)) for name, one in policies.items()}


def _report(
    run: Run, setup: Setup, config: EvalConfig, scores: dict[str, Scores]
) -> dict[str, Any]:
    """The file's content: the run's scores on top, by the same names as in result.json."""
    return {
        **scores[RUN],
        "episodes": config.episodes,
        "actions": setup.sim.actions_per_token,
        "corner_noise": setup.sim.corner_noise,
        "test_seed": config.seed,
        "run_dir": str(run.folder),
        "updates": run.updates,
        "tokens": [shape.name for shape in setup.layout.shapes],
        "agent": setup.agent.name,
        "backend": setup.sim.backend,
        "baselines": {name: values for name, values in scores.items() if name != RUN},
    }


def _table(run: Run, setup: Setup, config: EvalConfig, scores: dict[str, Scores]) -> Table:
    tests = "fixed tests" if config.seed == 0 else f"tests of seed {config.seed}"
    actions = setup.sim.actions_per_token
    noise = setup.sim.corner_noise
    seen = f"corners with noise {noise:g}" if noise else "exact corners"
    table = Table(
        title=f"{run.folder.name} after {run.updates:,} updates",
        caption=f"{config.episodes:,} {tests}, {actions} action{'s' * (actions > 1)} a token, "
        f"exploration off, {seen}, {setup.sim.backend}; positions in arena units",
    )
    table.add_column("")
    for name in scores:
        table.add_column(name, justify="right", style="bold" if name == RUN else "dim")
    for key, (label, digits) in _ROWS.items():
        if key in scores[RUN]:
            table.add_row(label, *(f"{values[key]:.{digits}f}" for values in scores.values()))
    return table
