"""Settings of the simulated world and of the reward."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tangram_core.errors import ConfigError
from tangram_core.run.code import own_code
from tangram_core.settings import NETWORK, Settings, refuse_ignored, setting

BACKENDS = ("physics", "kinematic")
REWARDS = ("overlap", "dense")
SOURCES = ("polygon", "camera")
MIN_PIXELS = 16
SILHOUETTE = "silhouette"  # the target as an outline, without its pieces
OBSERVED = ("corners", "pictures", SILHOUETTE)
# Largest share of a token that may overlap others where it is set down. The engine pushes such
# tokens apart by a little; with a larger overlap it would move placed tokens too far.
MAX_OVERLAP = 0.2
STARTS = ("anywhere", "outside")
TARGETS = ("uniform", "connected", "figures", "touching")


@dataclass(frozen=True)
class SimConfig(Settings, section="sim"):
    """Settings of the simulated world."""

    backend: str = setting(
        "physics",
        "physics: PyBullet; kinematic: exact rigid motion without an engine",
        choices=BACKENDS,
    )
    arena: float = setting(
        2.0, "side of the square arena", low=1e-3, high=1e3, unit="as the tokens", part=NETWORK
    )
    actions_per_token: int = setting(1, "actions that each token has", low=1, high=100)
    observe: str = setting(
        "corners",
        "corners: agents see exact corners; pictures: they see tokens found in the camera's "
        "pictures, Eq. 14 is measured on pictures, too, and scores on exact polygons; silhouette: "
        "they see the target's outline only, which agent=outline or, for others, a search fills",
        choices=OBSERVED,
    )
    targets: str = setting(
        "uniform",
        "uniform: separate pieces at random poses; connected: edge to edge; figures: puzzles of "
        "the train split; touching: connected or figures at random",
        choices=TARGETS,
    )
    overhang: bool = setting(
        False,
        "centres of tokens are random in the whole arena, so that tokens may reach over its edge",
    )
    starts: str = setting(
        "anywhere",
        "anywhere in the arena, or outside the target where there is room",
        choices=STARTS,
    )
    mirrored: float = setting(
        0.0,
        "share of episodes in which chiral tokens are turned over, in start and target",
        low=0,
        high=1,
    )
    allow_flip: bool = setting(
        False, "chiral tokens start on random sides; an action may turn its token over"
    )
    pixels: int = setting(
        0,
        "side of the camera's square pictures, at least 16; with 0 only evaluators take pictures, "
        "to report Eq. 14 on them",
        low=0,
        high=1024,
    )
    view: float = setting(
        1.0,
        "width of the area in a picture, as a multiple of the arena's width",
        low=1,
        high=100,
        unless={"pixels": 0},
    )

    @property
    def looks(self) -> bool:
        """Whether agents see only tokens that are found in pictures."""
        return self.observe == "pictures"

    @property
    def blind(self) -> "SimConfig":
        """The same world without a camera."""
        return replace(self, pixels=0, view=1.0, observe="corners")

    def __post_init__(self) -> None:
        if self.looks:
            self._check_observed()
        super().__post_init__()
        if 0 < self.pixels < MIN_PIXELS:
            raise ConfigError(f"sim.pixels must be 0 or at least {MIN_PIXELS}, got {self.pixels}")
        if self.observe == "silhouette" and self.pixels:
            remedy = "set sim.observe=pictures"
            refuse_ignored(f"sim.pixels={self.pixels}", "sim.observe=silhouette", remedy, 0)

    def _check_observed(self) -> None:
        if not self.pixels:
            raise ConfigError(
                f"sim.observe={self.observe} needs pictures, got sim.pixels=0: set sim.pixels=128"
            )
        if self.view != 1.0:
            raise ConfigError(
                f"sim.observe={self.observe} needs pictures of the arena, got sim.view="
                f"{self.view:g}: set sim.view=1"
            )


def with_given_reward(read: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """The reward settings of a file, overridden by those of a command line.

    A file may come from anybody, so code that only a file names is not loaded.

    Raises:
        ConfigError: the file names code, and the command line names no reward.
    """
    name = given.get("name", read.get("name"))
    own = isinstance(name, str) and own_code(name) is not None
    if own and "name" not in given:
        raise ConfigError(
            f"the settings of the run name code, {name} (sha256 {read.get('sha256', 'unknown')}), "
            f"which is not loaded unless you name it: add reward.name={name} if you trust it"
        )
    without = {} if own or "sha256" not in read else {"sha256": None}
    return {**read, **without, **given}


@dataclass(frozen=True)
class RewardConfig(Settings, section="reward"):
    """Settings of the reward."""

    name: str = setting(
        "overlap",
        "overlap (Eq. 14), dense (Eq. 15), or path/to/file.py:function for one of your own",
    )
    source: str = setting(
        "polygon",
        "what Eq. 14 is measured on while playing: exact polygons or the camera's pictures",
        choices=SOURCES,
    )
    sha256: str | None = setting(
        None, "hash of your own file, recorded by a run; a file with other content is refused"
    )

    def __post_init__(self) -> None:
        if self.name not in REWARDS and self.own is None:
            raise ConfigError(
                f"reward.name must be one of {', '.join(REWARDS)} or path/to/file.py:function, "
                f"got '{self.name}'"
            )
        super().__post_init__()
        if self.source == "camera" and self.name != "overlap":
            raise ConfigError(
                f"reward.source=camera measures Eq. 14 only, got reward.name={self.name}: "
                "set reward.source=polygon"
            )
        if self.sha256 is not None and self.own is None:
            refuse_ignored("reward.sha256", f"reward.name={self.name}", "name a file of your own")

    @property
    def own(self) -> tuple[Path, str] | None:
        """File and function of the user's own reward; None for a built-in one."""
        return own_code(self.name)
