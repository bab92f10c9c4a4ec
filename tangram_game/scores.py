"""What a run scores on puzzles, and who learned nothing beside it.

Legend: E puzzles, K tokens, V corners.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tangram_agent.runs import Run
from tangram_core.agent import AT_ONCE
from tangram_core.arrays import Floats
from tangram_core.errors import ConfigError
from tangram_game.figures.puzzles import Figure, Player, play_figures
from tangram_sim.rewards import scaled_overlap
from tangram_tasks.metrics import SOLVED, assembled, pose_errors, summarise
from tangram_tasks.place import Place
from tangram_tasks.played import Played
from tangram_tasks.rivals.baselines import exact_policy

if TYPE_CHECKING:  # needs OpenCV and shapely
    from tangram_game.figures.hidden import Hidden, Laid

RUN = "this run"
Scores = dict[str, Any]  # numbers, and `coverage_each` of the episodes

# What is told of filled outlines: nothing of where a piece should lie.
OF_AREAS = (
    *("mean_reward", "raw_overlap", "raw_overlap_p10"),
    *("coverage", "iou", "blocked", "refused", "actions_used"),
)
_COUNTS = ("wrong", "doubly_used", "refused", "blocked", "actions_used")
_OF_PIECES = ("wrong", "doubly_used", "position_errors", "angle_errors_deg")  # not of outlines


@dataclass(frozen=True, eq=False)
class Scored:
    """Scores of several policies on E puzzles.

    Attributes:
        means: over all puzzles, by the policies' names.
        puzzles: what the run made of each.
        titles: of the puzzles.
        ends: (E, V, 2) corners of the tokens as the run left them.
        goals: (E, V, 2) corners of the puzzles' pieces.
        told: what is to be known of the scores.
    """

    means: dict[str, Scores]
    puzzles: list[dict[str, Any]]
    titles: list[str]
    ends: Floats
    goals: Floats
    told: str


def score_puzzles(
    task: Place,
    figures: Sequence[Figure],
    players: Mapping[str, Player],
    seed: int,
    at_once: int = AT_ONCE,
) -> Scored:
    """Scores of each policy on the same starts; who sees outlines fills them itself."""
    played = {
        name: play_figures(task, figures, player, seed, at_once=at_once)
        for name, player in players.items()
    }
    scores = {name: _of_puzzles(task, own, at_once) for name, own in played.items()}
    run, titles = played[RUN], [figure.title for figure in figures]
    told = "positions in arena units"
    if task.outlines:
        told = "played by the run itself; any dissection counts, so no errors of position and angle"
    return Scored(scores, _one_by_one(task, figures, run), titles, run.ends, run.goals, told)


def _of_puzzles(task: Place, played: Played, at_once: int) -> Scores:
    if task.outlines:
        return of_outlines(task, played, at_once)
    own: Scores = {**summarise(task.layout, task.sim, played, own_reward=False)}
    return own | {"episodes": float(len(played.overlap))} | of_several(played, at_once)


def of_outlines(task: Place, played: Played, at_once: int) -> Scores:
    """Scores of filled outlines; any dissection counts, so none tells of single pieces."""
    found = assembled(task.layout, played)
    means = {key: value for key, value in found.means().items() if key in OF_AREAS}
    areas = {
        "mean_reward": float(np.mean(scaled_overlap(found.coverage))),
        "share_solved_iou": float(np.mean(found.iou >= SOLVED)),
        "episodes": float(len(found.coverage)),
    }
    return means | areas | of_several(played, at_once)


def score_hidden(
    task: Place,
    figures: Sequence[Figure],
    players: Mapping[str, Player],
    seed: int,
    at_once: int = AT_ONCE,
) -> Scored:
    """Scores of each policy that lays what was found in the silhouettes.

    Raises:
        ConfigError: OpenCV or shapely is not installed.
    """
    try:
        # Only here and below: other puzzles need neither.
        from tangram_game.figures.hidden import hide, play_hidden  # noqa: PLC0415
        from tangram_game.figures.methods import together  # noqa: PLC0415
    except ImportError as error:
        raise _no_library(task, error) from error
    hidden = hide(task, figures, seed, together(task.layout))
    laid = {name: play_hidden(hidden, player, seed, at_once) for name, player in players.items()}
    return _of_hidden({name: (hidden, own) for name, own in laid.items()})


def score_pictured(run: Run, figures: Sequence[Figure], seed: int) -> Scored:
    """Scores of an agent of outlines that is shown pictures, and of who fills them otherwise.

    What each finds is laid alike, by the formula: the motion of tokens that are lifted is known.

    Raises:
        ConfigError: OpenCV or shapely is not installed.
    """
    task = run.task
    try:
        from tangram_game.figures.hidden import hide, play_hidden  # noqa: PLC0415
        from tangram_game.figures.methods import learned_method  # noqa: PLC0415
        from tangram_vision.silhouettes.silhouettes import UNLEARNED  # noqa: PLC0415
    except ImportError as error:
        raise _no_library(task, error) from error
    own, policy = learned_method(run), exact_policy(task.layout, task.sim)
    methods = {RUN: own, "largest first": replace(own, values=None), "search": UNLEARNED}
    every = {name: hide(task, figures, seed, method) for name, method in methods.items()}
    laid = {name: play_hidden(hidden, lambda _: policy, seed) for name, hidden in every.items()}
    return _of_hidden({name: (hidden, laid[name]) for name, hidden in every.items()})


def _of_hidden(every: "Mapping[str, tuple[Hidden, Laid]]") -> Scored:
    """Scores of what each policy laid."""
    from tangram_game.figures.hidden import means, one_by_one  # noqa: PLC0415

    hidden, laid = every[RUN]
    told = (
        f"{hidden.filled} of {len(hidden.figures)} filled ({_by(hidden.filled_by)}); any "
        "dissection counts, so no errors of position and angle, and no pieces under others"
    )
    scores = {name: means(*own) for name, own in every.items()}
    each = one_by_one(hidden, laid)
    return Scored(scores, each, hidden.titles, laid.ends, hidden.goals, told)


def _no_library(task: Place, error: ImportError) -> ConfigError:
    return ConfigError(
        f"sim.observe={task.sim.observe} needs OpenCV and shapely ({error}): install "
        "opencv-python-headless and shapely, or set sim.observe=corners"
    )


def _by(counts: Mapping[str, int]) -> str:
    """Who filled how many, in words."""
    return ", ".join(f"{count} by the {who}" for who, count in counts.items())


def of_each(played: Played) -> Scores:
    """Every coverage, for differences that are paired by episode."""
    return {"coverage_each": np.round(played.overlap, 6).tolist()}


def of_several(played: Played, at_once: int) -> Scores:
    """What only evaluations tell of several tokens: time, and every coverage."""
    seconds = float(np.mean(played.seconds))
    scores: Scores = {
        "seconds_per_puzzle": seconds,
        "ms_per_decision": 1e3 * seconds / played.refused.shape[1],
        **of_each(played),
    }
    if at_once == 1:
        scores["ms_slowest"] = 1e3 * float(played.slowest.max())
    return scores


def _one_by_one(task: Place, figures: Sequence[Figure], played: Played) -> list[dict[str, Any]]:
    found = assembled(task.layout, played)
    position, angle = pose_errors(task.layout, played.ends, played.goals)
    solved = found.iou >= SOLVED if task.outlines else found.solved
    lines = [
        {
            "name": figure.name,
            "degrees": figure.degrees,
            "coverage": float(found.coverage[e]),
            "iou": float(found.iou[e]),
            "solved": bool(solved[e]),
            **{name: int(getattr(found, name)[e]) for name in _COUNTS},
            "position_errors": position[e].tolist(),
            "angle_errors_deg": angle[e].tolist(),
            "seconds": float(played.seconds[e]),
        }
        for e, figure in enumerate(figures)
    ]
    left_out = _OF_PIECES if task.outlines else ()
    return [{key: one[key] for key in one if key not in left_out} for one in lines]
