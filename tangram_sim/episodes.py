"""Names, shapes and bounds of the arrays in an episode of tokens."""

from tangram_core.spec import EpisodeSpec, Field
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.motion.actions import action_size, corner_bound, goal_rows, horizon
from tangram_sim.rewards import reward_bounds


def spec_of(
    layout: Layout, sim: SimConfig, reward: RewardConfig, outlines: bool = False
) -> EpisodeSpec:
    """The names, shapes and bounds of the arrays in an episode of these tokens.

    corners (V, 2) of the tokens and goals (V, 2) of their targets are as the agent sees them. With
    `outlines`, goals are rows (G, 2) of outlines. placed (K,) is 1 for a placed token.

    `sim.observe=pictures` adds three arrays. seen (K,) is 1 for a token found in the picture; with
    several tokens also for one that should have left it. goals_seen (K,) is 1 for a piece found in
    the target's picture. closed (K,) is 1 for a token that no action should name: it is placed, or
    unseen while others are seen.
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
