"""Settings of the agent of outlines."""

from dataclasses import dataclass

from tangram_agent.base.config import LearningConfig
from tangram_core.settings import LEARNING, setting


@dataclass(frozen=True)
class OutlineConfig(LearningConfig, section="agent"):
    """Q-learning over afterstates, with hindsight."""

    beam: int = setting(
        1,
        "exploration off: lay all tokens in thought first, and follow so many fillings of each "
        "depth, by the values of what would be left; 1: play what is best now",
        low=1,
        high=32,
    )
    polyak: float = setting(0.99, "rho of the target network, Eq. 4", low=0, high=1, part=LEARNING)
    copies: int = setting(6, "states of hindsight for each episode", low=1, high=64, part=LEARNING)
