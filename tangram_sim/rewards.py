"""Rewards: pure functions of achieved and desired corners, vectorised.

Every built-in reward lies in [-1, 1] and is +1 exactly where the goal is reached. Legend as in
arrays.py: achieved and desired are (B, V, 2) corners, rewards are (B,).
"""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from tangram_core.arrays import Floats, Pixels
from tangram_core.errors import ConfigError, OwnCodeError
from tangram_core.run.code import load_code, read_code
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import covered_share
from tangram_sim.sight.pictures import token_pixels

MAX_REWARD = 1e6  # largest |reward| that a user's own function may return
LEAST_SHOWN = 16  # fewest pixels of a token where Eq. 14 is measured on pictures
# s: steepness of the logarithm near the target; in the authors' code 2.83 / .01.
SHARPNESS = 200.0 * 2.0**0.5
RewardFn = Callable[[Floats, Floats], Floats]
UserReward = Callable[[Floats, Floats, Layout], Any]


def make_reward(config: RewardConfig, layout: Layout, sim: SimConfig) -> RewardFn:
    """The configured reward as a function (achieved, desired) -> (B,).

    With source=camera, too, the function computes Eq. 14 on polygons: a relabelled goal has no
    picture. Goals outside the picture give -1. While playing, `BatchedEnv` uses the camera's value.

    Raises:
        ConfigError: the camera is the source but is off or too coarse, or a user's function cannot
            be loaded. A call raises it if a user's function fails, or returns a wrong shape or
            numbers beyond MAX_REWARD.
    """
    if config.source == "camera":
        _check_camera(layout, sim)
    # The largest distance between two points of the arena.
    reach = sim.arena * np.sqrt(2.0)
    if config.own is not None:
        function = _load(config, *config.own)
        return lambda achieved, desired: _checked(config.name, function, achieved, desired, layout)
    if config.source == "camera":
        return lambda achieved, desired: _shown(achieved, desired, layout, sim.arena * sim.view)
    if config.name == "overlap":
        return lambda achieved, desired: overlap(achieved, desired, layout)
    return lambda achieved, desired: dense(achieved, desired, layout, reach)


def _check_camera(layout: Layout, sim: SimConfig) -> None:
    if not sim.pixels:
        raise ConfigError("reward.source=camera needs pictures: set sim.pixels=64")
    side, least = sim.arena * sim.view / np.sqrt(layout.areas), np.sqrt(LEAST_SHOWN)
    pixels, worst = int(np.ceil(side.max() * least)), layout.shapes[int(np.argmax(side))]
    if sim.pixels < pixels:
        shown = (sim.pixels / side.max()) ** 2
        raise ConfigError(
            f"reward.source=camera needs tokens of at least {LEAST_SHOWN} pixels, and {worst.name} "
            f"covers {shown:.3g} pixels: raise sim.pixels to {pixels} (at most 1024), or lower "
            "sim.view or sim.arena"
        )


def check_reward(config: RewardConfig, layout: Layout, sim: SimConfig) -> None:
    """Call the configured reward once, so that a faulty user's function fails before a run starts.

    Raises:
        ConfigError: see `make_reward`.
    """
    apart = np.zeros((2, layout.tokens, 3))
    apart[1, :, 0] = sim.arena / 4.0
    corners = layout.corners(apart)
    make_reward(config, layout, sim)(corners, corners[::-1])


def overlap(achieved: Floats, desired: Floats, layout: Layout) -> Floats:
    """Eq. 14 on exact polygons, scaled to [-1, 1]: r = 2 * covered share of the target - 1."""
    return scaled_overlap(covered_share(achieved, desired, layout))


def _shown(achieved: Floats, desired: Floats, layout: Layout, width: float) -> Floats:
    """Eq. 14, but -1 where a picture of this width shows no corner of the goal."""
    shown = np.abs(desired).max(axis=2).min(axis=1) < width / 2.0
    return np.where(shown, overlap(achieved, desired, layout), -1.0)


def scaled_overlap(share: Floats) -> Floats:
    """The reward (B,) in [-1, 1] for a coverage (B,) in [0, 1]."""
    return 2.0 * share - 1.0


class TargetPictures:
    """Pictures (B, P, P) of the targets, to score other pictures by Eq. 14."""

    def __init__(self, targets: Pixels) -> None:
        """Count the pixels that each target covers.

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
        """Rewards (B,) by Eq. 14 for pictures (B, P, P) of the tokens, scaled to [-1, 1]."""
        covered = np.count_nonzero(self._wanted & token_pixels(states), axis=(1, 2))
        rewards: Floats = 2.0 * covered / self._total - 1.0
        return rewards


def dense(achieved: Floats, desired: Floats, layout: Layout, reach: float) -> Floats:
    """Eq. 15: `closeness` of each token's centre to its target's centre, averaged over tokens.

    The paper scales the distance "across all possible distances" and gives no constants. Here the
    scale `reach` is the arena's diagonal. The mean is of rewards and not of distances: so a distant
    token does not flatten the slope for a near one.
    """
    gap = layout.bases(achieved) - layout.bases(desired)
    mean: Floats = closeness(np.linalg.norm(gap, axis=-1), reach).mean(axis=-1)
    return mean


def closeness(distance: Floats, reach: float) -> Floats:
    """The reward for a distance d: r = max(-1, 1 - 2 log(1 + s d / reach) / log(1 + s)).

    It is +1 at 0 and -1 from `reach` on. The slope at 0 is 50 times that of a straight line, as in
    the authors' code.
    """
    scaled: Floats = 1.0 - 2.0 * np.log1p(SHARPNESS * distance / reach) / np.log1p(SHARPNESS)
    return np.maximum(scaled, -1.0)


def reward_bounds(config: RewardConfig) -> tuple[float, float]:
    """The least and the largest reward; +-MAX_REWARD for a user's own function."""
    if config.own is not None:
        return -MAX_REWARD, MAX_REWARD
    return -1.0, 1.0


def reward_identity(config: RewardConfig) -> dict[str, Any]:
    """The reward settings in a form that processes on different machines can compare.

    A user's own reward is identified by its file's content, not by the path.

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
    """The reward settings with the absolute path and the hash of a user's file.

    Raises:
        ConfigError: the user's file cannot be read, or its hash differs from the recorded one.
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
    """The output of the user's function, checked: one number within the bounds per row."""
    given = achieved.view(), desired.view()
    for one in given:  # `achieved -= desired` must not change data for scores and learning
        one.flags.writeable = False
    try:
        rewards = np.asarray(function(*given, layout), dtype=np.float64)
    except (Exception, SystemExit) as error:  # it is the user's code: anything may go wrong
        raise OwnCodeError(f"reward.name={name} failed: {type(error).__name__}: {error}") from error
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
