"""What the episodes of tokens are made of, by the names under which they travel."""

from tangram_core.spec import EpisodeSpec, Field
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.motion.actions import action_size, corner_bound, goal_rows, horizon
from tangram_sim.rewards import reward_bounds


def spec_of(
    layout: Layout, sim: SimConfig, reward: RewardConfig, outlines: bool = False
) -> EpisodeSpec:
    """What episodes of these tokens are made of.

    corners (V, 2) of the tokens and goals (V, 2) of their targets are as they are seen; placed (K,)
    is 1 where a token is placed. Where pictures are what is observed, seen (K,) is 1 where a token
    was found in the picture, or should have left that of several tokens, and goals_seen (K,) the
    same of the target's pieces; closed (K,) is 1 where no action should name a token: it is placed,
    or not seen while others are. With `outlines` goals are rows (G, 2) of outlines.
    """
    tokens, bound = layout.tokens, corner_bound(layout.tokens, sim)
    looks = (
        Field("seen", (tokens,), 0, 1, "moment", "u1"),
        Field("closed", (tokens,), 0, 1, "moment", "u1"),
        Field("goals_seen", (tokens,), 0, 1, "episode", "u1"),
    )
    rows = goal_rows(layout, sim) if outlines else layout.corner_count
    return EpisodeSpec(
        horizon(tokens, sim),
        action_size(tokens, sim),
        (
            Field("corners", (layout.corner_count, 2), -bound, bound),
            Field("placed", (tokens,), 0, 1, "moment", "u1"),
            Field("goals", (rows, 2), -bound, bound, "episode"),
            *(looks if sim.looks else ()),
        ),
        achieved="corners",
        desired="goals",
        rewards=reward_bounds(reward),
    )
