"""Settings of the agent of pairs."""

from dataclasses import dataclass

from tangram_agent.base.config import ActorCriticConfig
from tangram_core.settings import NETWORK, setting


@dataclass(frozen=True)
class PairConfig(ActorCriticConfig, section="agent"):
    """DDPG on pairs of a token and a piece of the target."""

    motion: str = setting(
        "learned",
        "what a command comes to: learned from the replay, and watched in each episode; or the "
        "exact rigid motion",
        choices=("learned", "exact"),
        part=NETWORK,
    )
    reapply: int = setting(
        2, "times that the actor is applied again to what it proposed", low=0, high=100
    )
