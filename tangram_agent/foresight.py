"""What a look ahead asks: a guide, who proposes, and worlds to try actions in.

Legend: B scenes, K tokens, M options. Shares are of a piece's area.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tangram_sim.arrays import Bools, Floats, Ints
from tangram_sim.config import SimConfig
from tangram_sim.layout import Layout
from tangram_sim.world import make_world


@dataclass(frozen=True, eq=False)
class Table:
    """Scenes that share their target, and tokens' sides; or one of them.

    Attributes:
        poses: (B, K, 3) of the tokens; of one (K, 3).
        flipped: (K,) which lie on their other side.
        goal: (K, 3) poses of the pieces.
        goal_flipped: (K,) their sides.
    """

    poses: Floats
    flipped: Bools
    goal: Floats
    goal_flipped: Bools


@dataclass(frozen=True, eq=False)
class Places:
    """M places that tokens may take.

    Attributes:
        row: (M,) in which scene.
        token: (M,) which token.
        piece: (M,) for which piece.
        pose: (M, 3) where it is to lie.
        value: (M,) area that it covers there of the piece, over the larger of both areas.
    """

    row: Ints
    token: Ints
    piece: Ints
    pose: Floats
    value: Floats


class Guide(Protocol):
    """Who proposes."""

    def places(self, table: Table, left: Bools, covered: Floats) -> Places:
        """Where tokens that are left (B, K) may go; shares of pieces are covered, (B, K)."""

    def pushed(self, table: Table, token: Ints, start: Floats, end: Floats) -> Floats:
        """(M, K) share of every piece's area that is pushed away where its own token lies there.

        Args:
            table: their target.
            token: (M,) which slide
            start: from poses (M, 3)
            end: to poses (M, 3).
        """


class Foresight(Protocol):
    """Worlds to try actions in."""

    def slid(self, table: Table, token: Ints, way: Floats) -> Floats:
        """(B, K, 3) as all tokens lie when in each scene one, (B,), went a way, (B, 3)."""


class EngineWorlds:
    """See `Foresight`: planning with the simulator."""

    def __init__(self, layout: Layout, sim: SimConfig) -> None:
        """Load the engine."""
        self._world = make_world(layout, sim.blind)

    def slid(self, table: Table, token: Ints, way: Floats) -> Floats:
        """See `Foresight.slid`."""
        ends = np.empty_like(table.poses)
        for b, poses in enumerate(table.poses):
            self._world.place(poses, table.flipped)
            self._world.move(int(token[b]), way[b])
            ends[b] = self._world.poses()
        return ends
