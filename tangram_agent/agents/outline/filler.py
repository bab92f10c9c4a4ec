"""Acting on outlines: the place whose rest is most surely filled, by itself or by a beam.

Where nothing fits any more, a token that is left goes to where it covers most of what is left.

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
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import outlines
from tangram_sim.geometry.rings import covered_area
from tangram_sim.motion.actions import velocities_of
from tangram_tasks.fill import Fill

_ANGLES = 8  # that a token is tried at where nothing fits
_FREE = 0.5  # of what a token may cover of others


class Fillable:
    """How surely a layout's tokens fill what is left, by a network that learned it."""

    def __init__(self, value: nn.Module, layout: Layout) -> None:
        """Judge tokens of the same shapes, in the same order, as it learned; of any size."""
        # (n,) logits of `Corners`, see `OutlineValue`.
        self._value, self._filling = value, Filling(layout)

    def __call__(self, rests: Sequence[Area], left: Sequence[tuple[int, ...]]) -> Floats:
        """(n,) logits; minus infinity where there are more corners than are seen.

        Args:
            rests: n, what is left to fill.
            left: n, how many tokens there are of each shape.
        """
        every = Rests.joined([self._filling.seen(*one) for one in zip(rests, left, strict=True)])
        with torch.inference_mode():
            logits = self._value(Corners.of(every)).numpy()
        return np.where(every.known, logits, -np.inf).astype(np.float64)


class Filler:
    """Chooses where the next token goes."""

    def __init__(self, value: nn.Module, task: Fill, beam: int) -> None:
        self._fillable, self._layout = Fillable(value, task.layout), task.layout
        self._sim = task.sim
        self._filling, self._rows = Filling(task.layout), task.goal_rows
        self._beam = beam

    def choose(
        self,
        corners: Floats,
        placed: Bools,
        goals: Floats,
        anything: Bools,
        generators: Sequence[np.random.Generator] = (),
    ) -> Choice:
        """What to play.

        Args:
            corners: (B, V, 2) of the tokens.
            placed: (B, K) which are placed.
            goals: (B, G, 2) outlines to fill.
            anything: (B,) where any place will do, drawn by the environment's generator.
            generators: one for each environment, where some explore.

        Raises:
            ConfigError: goals of another form, as the corners of pieces are.
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
        wanted_of = [[] if anything[b] else every[b] for b in range(count)]
        beam = 1 if len(generators) else self._beam
        plans = self._plans(wanted_of, beam)
        token, flip = np.zeros(count, np.int64), np.zeros(count, np.bool_)
        wanted, here = np.zeros((count, 3)), self._layout.poses(corners)
        sides = self._layout.flipped(corners)
        for b, plan in enumerate(plans):
            place = plan[0] if plan else None
            if anything[b] and every[b]:
                place = every[b][int(generators[b].integers(len(every[b])))]
            laid = place.laid if place else None
            if laid is None and not len(generators):  # nothing is learned from where it then lies
                laid = self._rough(rests[b], corners[b], placed[b])
            token[b], wanted[b] = self._taken(laid, here[b], sides[b], placed[b])
            flip[b] = laid is not None and bool(sides[b, token[b]] != laid.flipped)
        way = wanted - here[np.arange(count), token]
        velocity = np.clip(velocities_of(way, self._sim), -1.0, 1.0).astype(np.float32)
        return Choice(token, flip, velocity)

    def values(self, places: Sequence[Place]) -> Floats:
        """How surely what is left can be filled, as logits; a filled one is surest."""
        found = np.full(len(places), np.inf)
        still = [i for i, place in enumerate(places) if not place.filled]
        if still:
            rests = [places[i].rest for i in still]
            found[still] = self._fillable(rests, [places[i].left for i in still])
        return found

    def _plans(self, every: Sequence[list[Place]], beam: int) -> list[tuple[Place, ...]]:
        """Of each environment the places that lead furthest; none where there are none.

        Args:
            every: what may be laid now.
            beam: states of each depth that are followed; one plays what is best now, and looks no
                further.
        """
        found: list[tuple[Place, ...]] = [()] * len(every)
        states: list[tuple[int, tuple[Place, ...]]]
        states = [(b, (one,)) for b, places in enumerate(every) for one in places]
        while states:
            values = self.values([places[-1] for _, places in states])
            kept = []
            for b in {row for row, _ in states}:
                own = [i for i, (row, _) in enumerate(states) if row == b]
                own = [own[i] for i in np.argsort(-values[own], kind="stable")[:beam]]
                found[b] = states[own[0]][1]
                if not found[b][-1].filled:
                    kept += [states[i] for i in own]
            if beam == 1:
                break
            states = [
                (b, (*places, place))
                for b, places in kept
                for place in self._filling.places(places[-1].rest, places[-1].left)
            ]
        return found

    def _taken(
        self, laid: Laid | None, here: Floats, sides: Bools, placed: Bools
    ) -> tuple[int, Floats]:
        """The token that goes to a place, and its pose there; without one any stays where it is."""
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
        """Where a token that is left covers most of what is left; None if it covers others."""
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
