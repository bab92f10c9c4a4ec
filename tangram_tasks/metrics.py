"""Scores of played episodes: coverage, errors of position and angle, and faults in figures.

Legend: E episodes, T steps, K tokens, V corners.
"""

from dataclasses import dataclass

import numpy as np

from tangram_core.arrays import Bools, Floats, Ints
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import covered_share, outlines, shared_areas, union_area
from tangram_sim.rewards import make_reward
from tangram_tasks.pairing import alike, paired
from tangram_tasks.played import Played

SOLVED = 0.95  # share of the target that must be covered
# Share of a piece that a token must cover to count; neighbours reach over it by less.
TOUCHED = 0.05
USED = 0.25
_ROUNDING = 1e-9


def pose_errors(layout: Layout, ends: Floats, goals: Floats) -> tuple[Floats, Floats]:
    """Errors of position and angle of tokens; `ends` and `goals` are corners (E, V, 2).

    Equal tokens may change places: each is compared with the piece that it is paired with.

    Returns:
        (E, K) distances of the centres of area, in arena units; (E, K) angles in degrees between
        the orientations, modulo the shape's symmetry, from 0 to 180 / symmetry. A token on the
        wrong side has the largest angle.
    """
    pairing = paired(layout, ends, goals)
    position: Floats = np.linalg.norm(pairing.way[..., :2], axis=-1)
    largest = 180.0 / layout.symmetries
    turn = np.degrees(np.abs(pairing.way[..., 2]))
    return position, np.where(pairing.other_side, largest, turn)


def summarise(
    layout: Layout, sim: SimConfig, played: Played, own_reward: bool, outlines: bool = False
) -> dict[str, float]:
    """Scores of E episodes; percentiles are taken at the worse end.

    Args:
        own_reward: also report the mean reward of the last action, if training uses another reward
            than Eq. 14 of exact polygons.
        outlines: see `assembled`.

    Returns:
        mean_reward (always Eq. 14 of exact polygons, in [-1, 1]), mean_reward_dense (Eq. 15),
        coverage (in [0, 1]) and its 10th percentile. Medians and 90th percentiles of the errors
        over all tokens and episodes. mean_reward_camera and mean_train_reward where they exist.
        With several tokens also the means of `Assembled`.
    """
    position, angle = pose_errors(layout, played.ends, played.goals)
    dense = make_reward(RewardConfig("dense"), layout, sim)
    scores = {
        "mean_reward": float(np.mean(2.0 * played.coverage - 1.0)),
        "mean_reward_dense": float(np.mean(dense(played.ends, played.goals))),
        "coverage": float(np.mean(played.coverage)),
        "coverage_p10": float(np.percentile(played.coverage, 10)),
        "angle_error_deg_median": float(np.median(angle)),
        "angle_error_deg_p90": float(np.percentile(angle, 90)),
        "position_error_median": float(np.median(position)),
        "position_error_p90": float(np.percentile(position, 90)),
    }
    if played.camera is not None:
        scores["mean_reward_camera"] = float(np.mean(played.camera))
    if own_reward:
        scores["mean_train_reward"] = float(
            np.mean(played.episodes.rewards[:, -1], dtype=np.float64)
        )
    if layout.tokens > 1:
        scores |= assembled(layout, played, outlines).means()
    return scores


@dataclass(frozen=True, eq=False)
class Assembled:
    """Scores of E assembled figures.

    Attributes:
        coverage: (E,) share of the target that the tokens cover, in [0, 1].
        iou: (E,) intersection over union of tokens and target, in [0, 1].
        solved: (E,) whether the target is reached, see `assembled`.
        wrong: (E,) pieces of the target that a token of another shape covers most, and by more
            than `TOUCHED`; a chiral token on its other side counts as another shape.
        doubly_used: (E,) pieces that two or more tokens cover by more than `USED` each.
        refused: (E,) actions that chose a placed token.
        blocked: (E,) tokens that could not be set down because others were in the way.
        actions_used: (E,) actions that were not refused.
    """

    coverage: Floats
    iou: Floats
    solved: Bools
    wrong: Ints
    doubly_used: Ints
    refused: Ints
    blocked: Ints
    actions_used: Ints

    def means(self) -> dict[str, float]:
        """Each score's mean over the episodes."""
        return {name: float(np.mean(column)) for name, column in vars(self).items()}


def assembled(layout: Layout, played: Played, outlines: bool = False) -> Assembled:
    """Scores of the figures at the end of played episodes.

    A target is reached from a coverage of `SOLVED` on, an outline from an IoU of `SOLVED` on.
    """
    coverage = covered_share(played.ends, played.goals, layout)
    shares = iou(layout, played.ends, coverage)
    covered = covered_shares(layout, played.ends, played.goals)
    refused = played.refused.sum(axis=1)
    return Assembled(
        coverage=coverage,
        iou=shares,
        solved=(shares if outlines else coverage) >= SOLVED,
        wrong=_wrong(layout, played, covered),
        doubly_used=((covered > USED + _ROUNDING).sum(axis=2) > 1).sum(axis=1),
        refused=refused,
        blocked=played.blocked.sum(axis=1),
        actions_used=played.refused.shape[1] - refused,
    )


def covered_shares(layout: Layout, ends: Floats, goals: Floats) -> Floats:
    """(E, K, K) the share of each piece of the target that each token covers.

    Args:
        layout: the tokens.
        ends: (E, V, 2) corners of the tokens.
        goals: (E, V, 2) corners of the target.
    """
    shared = shared_areas(outlines(goals, layout), outlines(ends, layout))
    shares: Floats = shared / layout.areas[:, None]
    return shares


def iou(layout: Layout, ends: Floats, coverage: Floats) -> Floats:
    """(E,) intersection over union, of tokens at `ends` (E, V, 2) and their `coverage` (E,)."""
    whole = layout.areas.sum()
    common = coverage * whole
    share: Floats = common / (whole + union_area(ends, layout) - common)
    return share


def _wrong(layout: Layout, played: Played, covered: Floats) -> Ints:
    """(E,) wrong pieces, see `Assembled`."""
    sides = layout.flipped(played.goals)[:, :, None] == layout.flipped(played.ends)[:, None]
    same = alike(layout) & sides
    # A piece that a right and a wrong token cover equally counts as right.
    right = np.where(same, covered, 0.0).max(axis=2)
    other = np.where(same, 0.0, covered).max(axis=2)
    wrong: Ints = ((other > right + _ROUNDING) & (other > TOUCHED)).sum(axis=1)
    return wrong
