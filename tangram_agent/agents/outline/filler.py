"""Choice of the next token and its place, after which the rest is most likely to be filled.

If no place leaves a rest that may be filled, a token left goes to where it covers most of it.

Legend: B environments, K tokens, V corners, G rows of an outline.
"""

from collections.abc import Sequence

import numpy as np
import shapely
import torch
from shapely import Polygon
from torch import nn

from tangram_agent.agents.outline.filling import Filling, Rests
from tangram_agent.agents.outline.values import Corners
from tangram_agent.base.types import Choice
from tangram_core.arrays import Bools, Floats
from tangram_core.errors import ConfigError
from tangram_sim.config import MAX_OVERLAP
from tangram_sim.geometry.areas import Area, polygons
from tangram_sim.geometry.dissections import Laid, Place
from tangram_sim.geometry.overlap import outlines
from tangram_sim.geometry.rings import covered_area
from tangram_sim.motion.actions import velocities_of
from tangram_tasks.fill import Fill

_ANGLES = 8  # tried for each token if none fits
_FREE = 0.5  # share of MAX_OVERLAP that such a token may use


class Filler:
    """Chooses the next token and its place."""

    def __init__(self, value: nn.Module, task: Fill) -> None:
        self._value, self._layout, self._sim = value, task.layout, task.sim
        self._filling, self._rows = Filling(task.layout), task.goal_rows

    def choose(
        self,
        corners: Floats,
        placed: Bools,
        goals: Floats,
        anything: Bools,
        generators: Sequence[np.random.Generator] = (),
    ) -> Choice:
        """Choose a token, its side and its velocity for each environment.

        Args:
            corners: (B, V, 2) of the tokens.
            placed: (B, K) whether each token is placed.
            goals: (B, G, 2) outlines to fill.
            anything: (B,) where to draw a random next place by the environment's generator.
            generators: one for each environment while exploring, else none.

        Raises:
            ConfigError: the goals have another form, such as corners of pieces.
        """
        count = len(corners)
        if goals.shape != (count, self._rows, 2):
            raise ConfigError(
                f"goals of an agent of outlines have the shape {(count, self._rows, 2)}, got "
                f"{goals.shape}: give rows that tangram_sim.geometry.rings.as_rows makes"
            )
        rests = [self._filling.rest(goals[b], corners[b], placed[b]) for b in range(count)]
        every = [
            self._filling.places(rests[b], self._filling.left(~placed[b])) for b in range(count)
        ]
        best = self._best([[] if anything[b] else every[b] for b in range(count)])
        for b in np.flatnonzero(anything).tolist():
            if every[b]:
                best[b] = every[b][int(generators[b].integers(len(every[b])))]
        token, flip = np.zeros(count, np.int64), np.zeros(count, np.bool_)
        wanted, here = np.zeros((count, 3)), self._layout.poses(corners)
        sides = self._layout.flipped(corners)
        for b, place in enumerate(best):
            laid = place.laid if place else None
            if laid is None and not len(generators):  # exploration does not need it
                laid = self._rough(rests[b], corners[b], placed[b])
            token[b], wanted[b] = self._taken(laid, here[b], sides[b], placed[b])
            flip[b] = laid is not None and bool(sides[b, token[b]] != laid.flipped)
        way = wanted - here[np.arange(count), token]
        velocity = np.clip(velocities_of(way, self._sim), -1.0, 1.0).astype(np.float32)
        return Choice(token, flip, velocity)

    def values(self, places: Sequence[Place]) -> Floats:
        """Logits that the rest after each place can be filled; infinity if it is filled already.

        Minus infinity if the rest has more corners than the network takes.
        """
        found = np.full(len(places), np.inf)
        still = [i for i, place in enumerate(places) if not place.filled]
        if still:
            seen = [self._filling.seen(places[i].rest, places[i].left) for i in still]
            every = Rests.joined(seen)
            with torch.inference_mode():
                logits = self._value(Corners.of(every)).numpy()
            found[still] = np.where(every.known, logits, -np.inf)
        return found

    def _best(self, every: Sequence[list[Place]]) -> list[Place | None]:
        """The place of the highest value in each environment; the first of equals."""
        values = self.values([one for places in every for one in places])
        own = np.split(values, np.cumsum([len(places) for places in every])[:-1])
        return [
            places[int(worth.argmax())] if places else None
            for places, worth in zip(every, own, strict=True)
        ]

    def _taken(
        self, laid: Laid | None, here: Floats, sides: Bools, placed: Bools
    ) -> tuple[int, Floats]:
        """The token for a place and its pose there; without a place a token stays where it is."""
        left = np.flatnonzero(~placed)
        if laid is None:
            token = int(left[0]) if len(left) else 0
            return token, here[token]
        alike = np.flatnonzero(~placed & (self._filling.shape_of == laid.shape)).tolist()

        def far(token: int) -> tuple[bool, float]:
            way = here[token] - laid.pose
            return bool(sides[token] != laid.flipped), float(np.hypot(*way[:2]))

        return min(alike, key=far), laid.pose

    def _rough(self, rest: Area, corners: Floats, placed: Bools) -> Laid | None:
        """Where a token that is left covers most of the rest; None if it would cover others."""
        sides, tried, laid = self._layout.flipped(corners), [], []
        for token in np.flatnonzero(~placed).tolist():
            for part in polygons(rest):
                for angle in np.arange(_ANGLES) * (2.0 * np.pi / _ANGLES):
                    pose = np.array([part.centroid.x, part.centroid.y, angle])
                    laid.append(Laid(int(self._filling.shape_of[token]), bool(sides[token]), pose))
                    tried.append((token, pose))
        if not tried:
            return None
        poses = self._layout.poses(np.repeat(corners[None], len(tried), axis=0))
        for row, (token, pose) in zip(poses, tried, strict=True):
            row[token] = pose
        own = outlines(self._layout.corners(poses, np.tile(sides, (len(tried), 1))), self._layout)
        tokens = np.array([token for token, _ in tried])
        bodies = shapely.polygons(own[np.arange(len(tried)), tokens])
        covered = shapely.area(shapely.intersection(bodies, rest))
        others = covered_area(corners, self._layout, placed) if placed.any() else Polygon()
        over = shapely.area(shapely.intersection(bodies, others))
        covered[over > _FREE * MAX_OVERLAP * self._layout.areas[tokens]] = 0.0
        best = int(covered.argmax())
        return laid[best] if covered[best] > 0.0 else None
