"""What a state is worth: pure functions of achieved and desired corners, vectorised.

Every reward lies in about [-1, 1] and is +1 exactly where the goal is reached. Legend as in
arrays.py: achieved and desired are (B, V, 2) corners, rewards are (B,).
"""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from tangram_core.arrays import Floats, Pixels
from tangram_core.errors import ConfigError
from tangram_core.run.code import load_code, read_code
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import overlap_share
from tangram_sim.sight.pictures import token_pixels

MAX_REWARD = 1e6  # of a user's own function
SHARPNESS = 100.0  # s: how steep the logarithm is near the target
RewardFn = Callable[[Floats, Floats], Floats]
UserReward = Callable[[Floats, Floats, Layout], Any]


def make_reward(config: RewardConfig, layout: Layout, sim: SimConfig) -> RewardFn:
    """The configured reward as a function (achieved, desired) -> (B,).

    With source=camera it is Eq. 14 on polygons too: a goal that was relabelled has no picture.
    `BatchedEnv` replaces it by the camera's value while playing.

    Raises:
        ConfigError: the camera is to be the source but is off, or a user's function that cannot
            be loaded; later, when called, one whose output has the wrong shape or is not finite.
    """
    if config.source == "camera" and not sim.pixels:
        raise ConfigError("reward.source=camera needs pictures: set sim.pixels=64")
    # The longest distance of two points of the arena.
    reach = sim.arena * np.sqrt(2.0)
    if config.own is not None:
        function = _load(config, *config.own)
        return lambda achieved, desired: _checked(config.name, function, achieved, desired, layout)
    if config.name == "overlap":
        return lambda achieved, desired: overlap(achieved, desired, layout)
    return lambda achieved, desired: dense(achieved, desired, layout, reach)


def check_reward(config: RewardConfig, layout: Layout, sim: SimConfig) -> None:
    """Call the configured reward once, so that a user's function fails before anything starts.

    Raises:
        ConfigError: see `make_reward`.
    """
    apart = np.zeros((2, layout.tokens, 3))
    apart[1, :, 0] = sim.arena / 4.0
    corners = layout.corners(apart)
    make_reward(config, layout, sim)(corners, corners[::-1])


def overlap(achieved: Floats, desired: Floats, layout: Layout) -> Floats:
    """Eq. 14 on exact polygons, from [0, 1] to [-1, 1]: r = 2 * covered share of the target - 1."""
    return scaled_overlap(overlap_share(achieved, desired, layout))


def scaled_overlap(share: Floats) -> Floats:
    """The reward (B,) in [-1, 1] of a raw overlap (B,) in [0, 1]."""
    return 2.0 * share - 1.0


class TargetPictures:
    """Pictures (B, P, P) of the targets, as Eq. 14 compares others with them."""

    def __init__(self, targets: Pixels) -> None:
        """Count the pixels of each.

        Raises:
            ConfigError: a target covers no pixel.
        """
        self._wanted = token_pixels(targets)
        self._total = np.count_nonzero(self._wanted, axis=(1, 2))
        if not self._total.all():
            size = targets.shape[-1]
            raise ConfigError(
                f"the target covers no pixel of a picture of {size} x {size}: raise "
                "sim.pixels or tokens.scale, or lower sim.arena"
            )

    def rewards(self, states: Pixels) -> Floats:
        """Eq. 14 (B,) of other pictures (B, P, P), from [0, 1] to [-1, 1]."""
        covered = np.count_nonzero(self._wanted & token_pixels(states), axis=(1, 2))
        rewards: Floats = 2.0 * covered / self._total - 1.0
        return rewards


def dense(achieved: Floats, desired: Floats, layout: Layout, reach: float) -> Floats:
    """Eq. 15: the distance of each token's centre from its target's, as `closeness`.

    The paper scales the distance "across all possible distances" and gives no constants. Here the
    scale is the arena's diagonal. Several tokens: the mean of their rewards, so that one that is
    far away does not flatten the slope for one that is near.
    """
    gap = layout.bases(achieved) - layout.bases(desired)
    mean: Floats = closeness(np.linalg.norm(gap, axis=-1), reach).mean(axis=-1)
    return mean


def closeness(distance: Floats, reach: float) -> Floats:
    """+1 at distance 0, -1 at `reach`: r = 1 - 2 log(1 + s d / reach) / log(1 + s).

    The slope at the target is s / log(1 + s) times that of a straight line, and the reward is 0
    at about reach / sqrt(s). With s = 100 half of the scale is spent on the nearest
    tenth of the arena's diagonal, about the size of a token, and the slope at the target is 22
    times the straight line's. Beyond `reach`, outside the arena, the logarithm goes on below -1,
    so that a token that left still has a way back.
    """
    scaled: Floats = 1.0 - 2.0 * np.log1p(SHARPNESS * distance / reach) / np.log1p(SHARPNESS)
    return scaled


def reward_bounds(config: RewardConfig, sim: SimConfig, bound: float) -> tuple[float, float]:
    """The least and the largest reward where no coordinate is beyond +-bound.

    Of a user's own function nothing is known: it may return up to MAX_REWARD.
    """
    if config.own is not None:
        return -MAX_REWARD, MAX_REWARD
    if config.name == "overlap":
        return -1.0, 1.0
    farthest = np.array(2.0 * np.sqrt(2.0) * bound)
    least = closeness(farthest, sim.arena * np.sqrt(2.0))
    return min(-1.0, float(least)), 1.0


def reward_identity(config: RewardConfig) -> dict[str, Any]:
    """The settings of a reward as processes on different machines compare them.

    Of a user's own reward it is the file's content that counts, not the folder that it lies in.

    Raises:
        ConfigError: the user's file cannot be read.
    """
    content = asdict(config)
    del content["sha256"]
    if config.own is not None:
        path, function = config.own
        content["name"] = f"{_source(config, path)[1][:16]}:{function}"
    return content


def pinned(config: RewardConfig) -> RewardConfig:
    """The reward so that it holds in any folder, and for no other content of a user's file.

    Raises:
        ConfigError: the user's file cannot be read, or is not the one that was written down.
    """
    if config.own is None:
        return config
    path, function = config.own
    return replace(config, name=f"{path.absolute()}:{function}", sha256=_source(config, path)[1])


def _source(config: RewardConfig, path: Path) -> tuple[bytes, str]:
    return read_code("reward.name", config.name, path, config.sha256)


def _load(config: RewardConfig, path: Path, attribute: str) -> UserReward:
    loaded: UserReward = load_code(
        "reward.name", config.name, path, attribute, _source(config, path)[0]
    )
    if not callable(loaded):
        raise ConfigError(
            f"reward.name={config.name}: '{attribute}' is not a function (achieved, desired, "
            "layout)"
        )
    return loaded


def _checked(
    name: str, function: UserReward, achieved: Floats, desired: Floats, layout: Layout
) -> Floats:
    """What the user's function returns, if it is one number within the bounds per row."""
    given = achieved.view(), desired.view()
    for one in given:  # else `achieved -= desired` would change what is scored and learned from
        one.flags.writeable = False
    try:
        rewards = np.asarray(function(*given, layout), dtype=np.float64)
    except (Exception, SystemExit) as error:  # it is the user's code: anything may go wrong
        raise ConfigError(f"reward.name={name} failed: {type(error).__name__}: {error}") from error
    if rewards.shape != (len(achieved),):
        raise ConfigError(
            f"reward.name={name} must return one number per row, shape ({len(achieved)},), "
            f"got shape {rewards.shape}"
        )
    if not (np.abs(rewards) <= MAX_REWARD).all():
        raise ConfigError(
            f"reward.name={name} must return numbers between {-MAX_REWARD:g} and {MAX_REWARD:g}, "
            f"got {rewards}"
        )
    return rewards
