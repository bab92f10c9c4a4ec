"""Each declared bound, choice and condition is checked when a dataclass of settings is made."""

import math
from dataclasses import dataclass, field
from typing import Any

import pytest

from tangram_sim.errors import ConfigError
from tangram_sim.settings import Settings, declared, setting

pytestmark = pytest.mark.fast


@dataclass(frozen=True)
class NoiseConfig(Settings, section="noise"):
    """Of a made-up section."""

    seed: int = field(metadata=declared("of the noise", low=0, high=9))
    kind: str = setting("none", "which noise", choices=("none", "gaussian", "wide"))
    width: float = setting(0.1, "its deviation", low=0, only={"kind": ("gaussian", "wide")})
    sizes: tuple[int, ...] = setting((1, 2), "of its parts", low=1, high=4)
    share: float | None = setting(None, "of what is noisy", low=0, high=1)
    blur: float = setting(0.0, "of its edges", low=0, unless={"share": (None, 0.0)})


@dataclass(frozen=True)
class TopConfig(Settings):
    """Settings without a section."""

    jobs: int = setting(2, "at a time", low=1)


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"seed": -1}, "noise.seed must be between 0 and 9, got -1"),
        ({"seed": 10}, "noise.seed must be between 0 and 9, got 10"),
        ({"kind": "loud"}, "noise.kind must be one of none, gaussian, wide, got 'loud'"),
        ({"kind": "wide", "width": -1.0}, "noise.width must be at least 0, got -1.0"),
        ({"kind": "wide", "width": math.nan}, "noise.width must be at least 0, got nan"),
        ({"sizes": (1, 5)}, "noise.sizes must be between 1 and 4, got 5"),
        ({"share": 1.5}, "noise.share must be between 0 and 1, got 1.5"),
        (
            {"width": 0.2},
            "noise.width=0.2 changes nothing with noise.kind=none: leave it at 0.1, or set "
            "noise.kind=gaussian or wide",
        ),
        (
            {"blur": 0.5},
            "noise.blur=0.5 changes nothing with noise.share=null: leave it at 0, or give "
            "noise.share another value",
        ),
        (
            {"blur": 0.5, "share": 0.0},
            "noise.blur=0.5 changes nothing with noise.share=0: leave it at 0, or give "
            "noise.share another value",
        ),
    ],
)
def test_a_wrong_value_is_refused(values: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError) as caught:
        NoiseConfig(**{"seed": 1} | values)
    assert str(caught.value) == reason


def test_a_setting_at_the_top_carries_no_section() -> None:
    with pytest.raises(ConfigError, match="^jobs must be at least 1, got 0$"):
        TopConfig(jobs=0)


def test_bounds_and_what_is_not_given_are_taken() -> None:
    made = NoiseConfig(9, "wide", 0.0, (), 0.0)
    assert (made.width, made.sizes, made.share) == (0.0, (), 0.0)
    assert NoiseConfig(0).width == 0.1
    assert NoiseConfig(0, share=0.5, blur=0.5).blur == 0.5
