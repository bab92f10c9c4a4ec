"""The guide that learned nothing: exact places, and what lies in the way of a sweep.

Legend: K tokens, M ways, S moments of each.
"""

import numpy as np

from tangram_agent.foresight import Foresight, Places, Table
from tangram_agent.lookahead import Lookahead
from tangram_agent.types import Past
from tangram_sim.actions import make_actions, velocities_of
from tangram_sim.arrays import Bools, Floats, Ints, Singles
from tangram_sim.config import SimConfig
from tangram_sim.geometry import outlines, outlines_at, separations
from tangram_sim.kinematics import wrap
from tangram_sim.layout import Layout
from worker.pairing import alike, all_ways
from worker.rollout import Choose, Generators

_MOMENTS = 24
_PUSHED = 1.5  # depth of a meeting, in roots of the area, by which all of a piece is pushed away


def sweeping_policy(layout: Layout, sim: SimConfig, world: Foresight, beam: int) -> Choose:
    """A look ahead that nothing learned guides, see `Lookahead`."""
    lookahead = Lookahead(layout, sim, SweepGuide(layout), world, beam)

    def choose(
        corners: Floats, placed: Bools, goals: Floats, _generators: Generators, past: Past
    ) -> Singles:
        token, pose = lookahead.choose(corners, placed, goals, past)
        here = layout.poses(corners)[np.arange(len(token)), token]
        straight = np.zeros(len(token), dtype=np.bool_)
        velocity = velocities_of(pose - here, sim)
        return make_actions(token, velocity, straight, layout.tokens, sim)

    return choose


class SweepGuide:
    """See `tangram_agent.foresight.Guide`."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._same = alike(layout)
        self._body = layout.body[layout.padded_corners]

    def places(self, table: Table, left: Bools, covered: Floats) -> Places:
        """Every token exactly on every piece of its shape that is not taken."""
        layout = self._layout
        corners = layout.corners(table.poses, table.flipped)
        goals = layout.corners(table.goal[None], table.goal_flipped)
        ways = all_ways(layout, corners, goals)
        same = self._same & (table.flipped[:, None] == table.goal_flipped)
        row, token, piece = np.nonzero(same & left[:, :, None] & (covered < 1.0)[:, None])
        pose = table.poses[row, token] + ways[row, token, piece]
        return Places(row, token, piece, pose, np.ones(len(token)))

    def pushed(self, table: Table, token: Ints, start: Floats, end: Floats) -> Floats:
        """By how deep the token comes into the piece on its way."""
        layout = self._layout
        way = end - start
        way[:, 2] = wrap(way[:, 2])
        moment = np.arange(1, _MOMENTS + 1) / _MOMENTS
        path = start[:, None] + moment[:, None] * way[:, None]  # (M, S, 3)
        apart = np.linalg.norm(path[:, :, None, :2] - table.goal[:, :2], axis=-1)
        near = layout.radii[token][:, None, None] + layout.radii
        m, s, piece = np.nonzero(apart < near)
        one = outlines_at(self._body[token[m]], path[m, s], table.flipped[token[m]])
        pieces = outlines(layout.corners(table.goal, table.goal_flipped)[None], layout)[0]
        depth = np.zeros(apart.shape)
        depth[m, s, piece] = separations(one, pieces[piece])[0]
        share: Floats = np.clip(depth.max(axis=1) / np.sqrt(layout.areas) * _PUSHED, 0.0, 1.0)
        return share
