"""What a run and others score on puzzles, all together and one by one, and how it looks."""

from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from tangram_agent.files import write_whole
from tangram_agent.setup import Setup
from tangram_sim.game_drawing import figure_sheet
from worker.assembly import assembled
from worker.puzzles import Figure, Figures, play_figures
from worker.rollout import Choose, Played
from worker.scores import pose_errors, summarise
from worker.tables import RUN, Scores

MAX_PICTURES = 100
_COUNTS = ("wrong", "doubly_used", "refused", "blocked", "actions_used")


def score_puzzles(
    setup: Setup, figures: Sequence[Figure], players: Mapping[str, Choose], seed: int
) -> tuple[dict[str, Scores], list[dict[str, Any]], Played]:
    """Scores of each policy on the same starts; those of the run also one by one.

    Returns:
        Means over all figures by the policies' names; a mapping for each figure; how the run
        played them.
    """
    scores, played = dict[str, Scores](), dict[str, Played]()
    for name, choose in players.items():
        played[name] = play_figures(setup, figures, choose, seed)
        means = summarise(setup.layout, setup.sim, played[name], own_reward=False)
        scores[name] = means | of_several(played[name])
    return scores, _one_by_one(setup, figures, played[RUN]), played[RUN]


def of_several(played: Played) -> Scores:
    """What only evaluations tell: time, and every coverage, for tests on pairs of episodes."""
    return {
        "seconds_per_puzzle": float(np.mean(played.seconds)),
        "coverage_each": np.round(played.overlap, 6).tolist(),
    }


def write_sheet(path: str, setup: Setup, found: Figures, played: Played) -> None:
    """Write a picture of every figure's end, of at most `MAX_PICTURES`.

    Raises:
        RunError: the file is not writable.
    """
    picture = BytesIO()
    ends, goals = played.ends[:MAX_PICTURES], played.goals[:MAX_PICTURES]
    sheet = figure_sheet(setup.layout, setup.sim.arena, ends, goals, found.titles[:MAX_PICTURES])
    sheet.save(picture, format="PNG")
    write_whole(Path(path), picture.getvalue())


def _one_by_one(setup: Setup, figures: Sequence[Figure], played: Played) -> list[dict[str, Any]]:
    found = assembled(setup.layout, played)
    position, angle = pose_errors(setup.layout, played.ends, played.goals)
    return [
        {
            "name": figure.name,
            "degrees": figure.degrees,
            "coverage": float(found.coverage[e]),
            "iou": float(found.iou[e]),
            "solved": bool(found.solved[e]),
            **{name: int(getattr(found, name)[e]) for name in _COUNTS},
            "position_errors": position[e].tolist(),
            "angle_errors_deg": angle[e].tolist(),
            "seconds": float(played.seconds[e]),
        }
        for e, figure in enumerate(figures)
    ]
