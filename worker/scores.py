"""What played episodes are worth: overlaps, and errors of position and angle.

Legend: E episodes, K tokens, V corners.
"""

import numpy as np

from tangram_sim.arrays import Floats
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.layout import Layout
from tangram_sim.rewards import make_reward
from worker.assembly import assembled
from worker.pairing import paired
from worker.rollout import Played


def pose_errors(layout: Layout, ends: Floats, goals: Floats) -> tuple[Floats, Floats]:
    """How far each token is from its place in the target, both as corners (E, V, 2).

    Equal tokens may change places: they are measured against the pieces that they are paired with.

    Returns:
        (E, K) distances of the centres of area, in arena units; (E, K) angles between the
        orientations modulo the shape's symmetry, in degrees, from 0 to 180 / symmetry, which is
        also the error of a token that lies on the wrong side.
    """
    pairing = paired(layout, ends, goals)
    position: Floats = np.linalg.norm(pairing.way[..., :2], axis=-1)
    largest = 180.0 / np.array([shape.symmetry for shape in layout.shapes])
    turn = np.degrees(np.abs(pairing.way[..., 2]))
    return position, np.where(pairing.other_side, largest, turn)


def summarise(layout: Layout, sim: SimConfig, played: Played, own_reward: bool) -> dict[str, float]:
    """Scores of E episodes; percentiles look at the bad end of each distribution.

    Args:
        own_reward: report the mean of the last action's reward, too: training is not on Eq. 14 of
            exact polygons.

    Returns:
        mean_reward (Eq. 14 of exact polygons, in [-1, 1], whatever is trained on),
        mean_reward_dense (Eq. 15 at the default sharpness), raw_overlap and its 10th percentile,
        medians and 90th percentiles of the errors over all tokens, episodes; mean_reward_camera
        and mean_train_reward where they exist; with several tokens the means of `Assembled`.
    """
    position, angle = pose_errors(layout, played.ends, played.goals)
    dense = make_reward(RewardConfig("dense"), layout, sim)
    scores = {
        "mean_reward": float(np.mean(2.0 * played.overlap - 1.0)),
        "mean_reward_dense": float(np.mean(dense(played.ends, played.goals))),
        "raw_overlap": float(np.mean(played.overlap)),
        "raw_overlap_p10": float(np.percentile(played.overlap, 10)),
        "angle_error_deg_median": float(np.median(angle)),
        "angle_error_deg_p90": float(np.percentile(angle, 90)),
        "position_error_median": float(np.median(position)),
        "position_error_p90": float(np.percentile(position, 90)),
        "episodes": float(len(played.overlap)),
    }
    if played.camera is not None:
        scores["mean_reward_camera"] = float(np.mean(played.camera))
    if own_reward:
        scores["mean_train_reward"] = float(np.mean(played.rewards[:, -1]))
    if layout.tokens > 1:
        scores |= assembled(layout, played).means()
    return scores
