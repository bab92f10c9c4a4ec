"""The rivals of a task of tokens."""

from collections.abc import Callable, Mapping

from tangram_core.task import Chooser, Env
from tangram_sim.config import SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_tasks.rivals.baselines import exact_policy, position_policy, random_policy


def rivals_of(layout: Layout, sim: SimConfig) -> Mapping[str, Callable[[Env], Chooser]]:
    """The baselines of a world by name, the strongest first.

    `exact` moves every token exactly onto its target. `position only`, for one token, moves the
    token onto the target's centre without a turn. `random` takes random actions.
    """
    found: dict[str, Callable[[Env], Chooser]] = {"exact": lambda _: exact_policy(layout, sim)}
    if layout.tokens == 1:
        found["position only"] = lambda _: position_policy(layout, sim)
    return found | {"random": lambda _: random_policy(layout, sim)}
