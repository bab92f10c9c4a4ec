"""The rival of agents that fill outlines: a search that takes tokens back.

Legend: B environments, K tokens.
"""

import numpy as np

from tangram_core.arrays import Floats, Singles
from tangram_core.spec import Arrays
from tangram_core.task import Chooser, Generators, History
from tangram_sim.config import SimConfig
from tangram_sim.geometry.dissections import Dissection
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.rings import as_area
from tangram_sim.motion.actions import make_actions, velocities_of
from tangram_tasks.played import as_seen
from tangram_vision.silhouettes.silhouettes import fill_outline

SECONDS = 5.0  # processor time for each outline, about


def search_policy(layout: Layout, sim: SimConfig) -> Chooser:
    """Search for a dissection of each outline, then lay its tokens one by one.

    If it finds none, its best attempt is laid. Tokens without a place stay where they are. A slower
    machine may find less, as the search has a time limit.
    """
    known: dict[bytes, Dissection | None] = {}

    def dissection(outline: Floats) -> Dissection | None:
        key = outline.tobytes()
        if key not in known:
            filled = fill_outline(as_area(outline), layout, SECONDS)
            known[key] = filled.found or filled.attempt
        return known[key]

    def choose(seen: Arrays, past: History, _generators: Generators) -> Singles:
        if not past.actions.shape[1]:  # new episodes
            known.clear()
        corners, placed, goals = as_seen(seen)
        count = len(corners)
        token = np.zeros(count, np.int64)
        way, flip = np.zeros((count, 3)), np.zeros(count, np.bool_)
        poses, sides = layout.poses(corners), layout.flipped(corners)
        for b in range(count):
            found, left = dissection(goals[b]), np.flatnonzero(~placed[b])
            laid = left[:0] if found is None else np.intersect1d(left, found.laid)
            token[b] = next(iter([*laid, *left]), 0)
            if found is not None and len(laid):
                way[b] = found.poses[token[b]] - poses[b, token[b]]
                flip[b] = found.flipped[token[b]] != sides[b, token[b]]
        return make_actions(token, velocities_of(way, sim), flip, layout.tokens, sim)

    return choose
