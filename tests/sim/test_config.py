"""Settings that cannot work are refused with the value, the bound and what to do."""

import math
from typing import Any

import pytest

from tangram_sim.config import EXACT_SUBSTEPS, RewardConfig, SimConfig, StageConfig
from tangram_sim.errors import ConfigError

pytestmark = pytest.mark.fast


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"backend": "mujoco"}, "sim.backend must be one of physics, kinematic, got 'mujoco'"),
        ({"arena": 0.0}, "sim.arena must be between 0.001 and 1000"),
        ({"arena": math.nan}, "sim.arena must be between"),
        ({"actions_per_token": 0}, "sim.actions_per_token must be between 1 and 100, got 0"),
        ({"substeps": 0}, "sim.substeps must be between 1 and 1000, got 0"),
        ({"damping": 1.5}, "sim.damping must be between 0 and 1, got 1.5"),
        ({"corner_noise": 0.3}, "sim.corner_noise must be between 0 and 0.2, got 0.3"),
        ({"pixels": 15}, "sim.pixels must be 0 or at least 16, got 15"),
        ({"pixels": 1025}, "sim.pixels must be between 0 and 1024, got 1025"),
        ({"motion": "fly"}, "sim.motion must be one of lift, slide, got 'fly'"),
        ({"max_overlap": 1.1}, "sim.max_overlap must be between 0 and 1, got 1.1"),
        ({"max_overlap": -0.1}, "sim.max_overlap must be between 0 and 1, got -0.1"),
        ({"targets": "chaos"}, "sim.targets must be one of uniform, .* mixed, got 'chaos'"),
        ({"spread": 0.0}, "sim.spread must be between 0.001 and 1, got 0"),
        ({"starts": "here"}, "sim.starts must be one of anywhere, outside, got 'here'"),
        ({"mirrored": 2.0}, "sim.mirrored must be between 0 and 1, got 2"),
        ({"mirrored": math.nan}, "sim.mirrored must be between 0 and 1, got nan"),
        (
            {"stages": (StageConfig(updates=5), StageConfig(updates=5))},
            "sim.stages must begin one after the other, got updates .5, 5.: sort them",
        ),
        ({"stages": (StageConfig(updates=5), StageConfig(updates=1))}, "got updates .5, 1."),
        ({"stages": ({"updates": 0},)}, "sim.stages must list stages, got {'updates': 0}"),
    ],
)
def test_refused_sim(settings: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        SimConfig(**settings)


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"updates": -1}, "sim.stages.updates must be at least 0, got -1"),
        ({"tokens": -1}, "sim.stages.tokens must be between 0 and 16, got -1"),
        ({"tokens": 17}, "sim.stages.tokens must be between 0 and 16, got 17"),
        ({"targets": "chaos"}, "sim.stages.targets must be one of uniform"),
        ({"spread": 1.5}, "sim.stages.spread must be between 0.001 and 1, got 1.5"),
    ],
)
def test_refused_stage(settings: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        StageConfig(**settings)


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"name": "overlapp"}, "overlap, dense, pose or path/to/file.py:function, got 'overlapp'"),
        ({"name": ":function"}, "got ':function'"),
        ({"name": "file.py:"}, "got 'file.py:'"),
        ({"name": "file.py:two words"}, "got 'file.py:two words'"),
        ({"name": "module:function"}, "got 'module:function'"),
        ({"source": "eyes"}, "reward.source must be one of polygon, camera"),
        ({"sharpness": 0.0}, "reward.sharpness must be between"),
        ({"name": "dense", "source": "camera"}, "set reward.source=polygon"),
    ],
)
def test_refused_reward(settings: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        RewardConfig(**settings)


def test_defaults_work() -> None:
    assert SimConfig().substeps >= EXACT_SUBSTEPS
    assert SimConfig().damping == 0.0
    assert RewardConfig().name == "overlap"
