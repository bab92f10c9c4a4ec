"""Settings of every actor-critic agent."""

from dataclasses import dataclass

from tangram_core.errors import ConfigError
from tangram_core.settings import LEARNING, NETWORK, Settings, setting


@dataclass(frozen=True)
class EpisodeConfig(Settings, section="agent"):
    """Settings of pace, replay buffer and hindsight."""

    learning_rate: float = setting(
        1e-3, "learning rate of all networks", low=1e-9, high=1e3, part=LEARNING
    )
    batch_size: int = setting(512, "transitions in one update", low=1, part=LEARNING)
    updates_per_transition: float = setting(
        0.2, "updates for each transition played", low=1e-9, high=1e3, part=LEARNING
    )
    learning_starts: int = setting(
        1000, "transitions played before the first update", low=1, part=LEARNING
    )
    replay_capacity: int = setting(
        1_000_000,
        "transitions kept in the replay buffer, as whole episodes",
        low=1,
        high=1_000_000_000,
        part=LEARNING,
    )
    gamma: float = setting(0.95, "discount factor", low=0, high=0.99999, part=LEARNING)
    polyak: float = setting(0.99, "rho of the target networks, Eq. 4", low=0, high=1, part=LEARNING)
    relabel_share: float = setting(
        0.8,
        "share of a batch whose goal is replaced by one that the episode achieved later; 0: no "
        "hindsight",
        low=0,
        high=1,
        part=LEARNING,
    )
    uniform_share: float = setting(
        0.2, "share of random exploring actions", low=0, high=1, part=LEARNING
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.batch_size > self.replay_capacity:
            raise ConfigError(
                f"{self.section}.batch_size ({self.batch_size}) must not exceed "
                f"{self.section}.replay_capacity ({self.replay_capacity})"
            )


@dataclass(frozen=True)
class BaseConfig(EpisodeConfig, section="agent"):
    """Settings of networks and exploration, in addition to `EpisodeConfig`."""

    hidden: tuple[int, ...] = setting(
        (256, 256), "widths of the hidden layers", low=1, high=65536, part=NETWORK
    )
    noise: float = setting(
        0.2, "standard deviation of the exploration noise on actions", low=0, part=LEARNING
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.hidden:
            raise ConfigError(f"{self.section}.hidden must name at least one layer, got []")
