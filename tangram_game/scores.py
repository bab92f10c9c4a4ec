"""Scores of a run and its rivals on puzzles.

Legend: E puzzles, K tokens, V corners.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tangram_game.figures.puzzles import Figure, Player, play_figures
from tangram_tasks.metrics import Assembled, assembled, pose_errors, summarise
from tangram_tasks.place import Place
from tangram_tasks.played import Played

RUN = "this run"
Scores = dict[str, Any]  # numbers, and the list `coverage_each`

_SHARES = ("coverage", "iou")
_ACTIONS = ("refused", "blocked", "actions_used")
_PIECES = ("wrong", "doubly_used")  # not reported of silhouettes: any dissection counts


@dataclass(frozen=True, eq=False)
class Scored:
    """Scores of several policies on E puzzles.

    Attributes:
        means: mean scores over all puzzles, by the policies' names.
        puzzles: scores of the run on each puzzle.
        told: remark on the scores, for a caption.
    """

    means: dict[str, Scores]
    puzzles: list[dict[str, Any]]
    told: str


def score_puzzles(
    task: Place, figures: Sequence[Figure], players: Mapping[str, Player], seed: int
) -> Scored:
    """Score each policy on the same puzzles and starts."""
    played = {name: play_figures(task, figures, player, seed) for name, player in players.items()}
    scores = {name: _of_puzzles(task, own) for name, own in played.items()}
    told = "positions in arena units"
    if task.outlines:
        told = "any dissection counts, so no errors of position and angle"
    return Scored(scores, _one_by_one(task, figures, played[RUN]), told)


def _of_puzzles(task: Place, played: Played) -> Scores:
    """The scores that the task declares."""
    every = summarise(task.layout, task.sim, played, own_reward=False, outlines=task.outlines)
    own: Scores = {one.name: every[one.name] for one in task.scores if one.name in every}
    return own | {"episodes": float(len(played.coverage))} | of_several(played)


def of_each(played: Played) -> Scores:
    """The coverage of each episode, to compare policies episode by episode."""
    return {"coverage_each": np.round(played.coverage, 6).tolist()}


def of_several(played: Played) -> Scores:
    """Times and the coverage of each episode, which only evaluations report."""
    return {
        "seconds_per_puzzle": float(np.mean(played.seconds)),
        "ms_per_choice": 1e3 * float(np.mean(played.chose)) / played.refused.shape[1],
        **of_each(played),
    }


def _one_by_one(task: Place, figures: Sequence[Figure], played: Played) -> list[dict[str, Any]]:
    found = assembled(task.layout, played, task.outlines)
    counts = (*(() if task.outlines else _PIECES), *_ACTIONS)
    lines = [
        _line(figure, found, e, counts) | {"seconds": float(played.seconds[e])}
        for e, figure in enumerate(figures)
    ]
    if task.outlines:
        return lines
    position, angle = pose_errors(task.layout, played.ends, played.goals)
    return [
        one | {"position_errors": position[e].tolist(), "angle_errors_deg": angle[e].tolist()}
        for e, one in enumerate(lines)
    ]


def _line(figure: Figure, found: Assembled, e: int, counts: Sequence[str]) -> dict[str, Any]:
    """Scores of puzzle number `e`, with the named counts."""
    return {
        "name": figure.name,
        "degrees": figure.degrees,
        **{name: float(getattr(found, name)[e]) for name in _SHARES},
        "solved": bool(found.solved[e]),
        **{name: int(getattr(found, name)[e]) for name in counts},
    }
