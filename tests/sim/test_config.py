"""Each declared bound, choice and condition is checked when a dataclass of settings is made."""

import math
from dataclasses import dataclass, field
from typing import Any

import pytest

from tangram_core.errors import ConfigError
from tangram_core.settings import Settings, declared, setting
from tangram_sim.config import RewardConfig, SimConfig

pytestmark = pytest.mark.fast


@dataclass(frozen=True)
class NoiseConfig(Settings, section="noise"):
    """Of a made-up section."""

    seed: int = field(default=1, metadata=declared("of the noise", low=0, high=9))
    kind: str = setting("none", "which noise", choices=("none", "gaussian", "wide"))
    width: float = setting(0.1, "its deviation", low=0, only={"kind": ("gaussian", "wide")})
    sizes: tuple[int, ...] = setting((1, 2), "of its parts", low=1, high=4)
    share: float | None = setting(None, "of what is noisy", low=0, high=1)
    blur: float = setting(0.0, "of its edges", low=0, unless={"share": (None, 0.0)})


@dataclass(frozen=True)
class TopConfig(Settings):
    """Settings without a section."""

    jobs: int = setting(2, "at a time", low=1)


FINITE = "a finite number"
UNUSED = (
    "^noise.width=0.2 changes nothing with noise.kind=none: leave it at 0.1, or set "
    "noise.kind=gaussian or wide$"
)
BLURRED = "leave it at 0, or give noise.share another value$"
REFUSED = [
    (NoiseConfig, {"seed": -1}, "^noise.seed must be between 0 and 9, got -1$"),
    (NoiseConfig, {"seed": 10}, "^noise.seed must be between 0 and 9, got 10$"),
    (NoiseConfig, {"kind": "x"}, "^noise.kind must be one of none, gaussian, wide, got 'x'$"),
    (NoiseConfig, {"kind": "wide", "width": -1.0}, "^noise.width must be at least 0, got -1.0$"),
    (NoiseConfig, {"seed": True}, f"^noise.seed must be {FINITE}, between 0 and 9, got true$"),
    (TopConfig, {"jobs": 10**400}, f"^jobs must be {FINITE}, at least 1, got 1000"),
    (NoiseConfig, {"sizes": (1, True)}, f"^noise.sizes must be {FINITE}, between 1 and 4, got tr"),
    (
        NoiseConfig,
        {"kind": "wide", "width": math.nan},
        f"^noise.width must be {FINITE}, at least 0, got nan$",
    ),
    (
        NoiseConfig,
        {"kind": "wide", "width": math.inf},
        f"^noise.width must be {FINITE}, at least 0, got inf$",
    ),
    (NoiseConfig, {"sizes": (1, 5)}, "^noise.sizes must be between 1 and 4, got 5$"),
    (NoiseConfig, {"share": 1.5}, "^noise.share must be between 0 and 1, got 1.5$"),
    (NoiseConfig, {"width": 0.2}, UNUSED),
    (NoiseConfig, {"blur": 0.5}, f"^noise.blur=0.5 .* with noise.share=null: {BLURRED}"),
    (NoiseConfig, {"blur": 0.5, "share": 0.0}, f"^noise.blur=0.5 .* noise.share=0: {BLURRED}"),
    (TopConfig, {"jobs": 0}, "^jobs must be at least 1, got 0$"),
    (SimConfig, {"backend": "x"}, "sim.backend must be one of physics, kinematic, got 'x'"),
    (SimConfig, {"pixels": 15}, "sim.pixels must be 0 or at least 16, got 15"),
    (SimConfig, {"observe": "pictures"}, "^sim.observe=pictures needs .*: set sim.pixels=128$"),
    (
        SimConfig,
        {"observe": "pictures", "pixels": 64, "view": 2.0},
        "needs pictures of the arena, got sim.view=2: set sim.view=1",
    ),
    (RewardConfig, {"name": "x"}, "overlap, dense or path/to/file.py:function, got 'x'"),
    (RewardConfig, {"name": ":function"}, "got ':function'"),
    (RewardConfig, {"name": "file.py:"}, "got 'file.py:'"),
    (RewardConfig, {"name": "file.py:two words"}, "got 'file.py:two words'"),
    (RewardConfig, {"name": "module:function"}, "got 'module:function'"),
    (RewardConfig, {"source": "eyes"}, "reward.source must be one of polygon, camera"),
    (RewardConfig, {"name": "dense", "source": "camera"}, "set reward.source=polygon"),
    (RewardConfig, {"sha256": "ab"}, "^reward.sha256 changes nothing with reward.name=overlap"),
]


@pytest.mark.parametrize(("made", "values", "reason"), REFUSED)
def test_a_wrong_value_is_refused(
    made: type[Settings], values: dict[str, Any], reason: str
) -> None:
    with pytest.raises(ConfigError, match=reason):
        made(**values)


def test_bounds_and_what_is_not_given_are_taken() -> None:
    made = NoiseConfig(9, "wide", 0.0, (), 0.0)
    assert (made.width, made.sizes, made.share) == (0.0, (), 0.0)
    assert NoiseConfig(0).width == 0.1
    assert NoiseConfig(0, share=0.5, blur=0.5).blur == 0.5
