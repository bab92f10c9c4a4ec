"""Filling an outline as a problem of optimisation, which rivals of the search share.

A state is a place, a turn and a side for each token. Turns are those that put its edges on the
outline's grid of 45 degrees. What is made least is the share of the outline that no token covers,
counted on points within it: tokens and outline have one area, so what overlaps or lies outside is
uncovered elsewhere.

Points and directions are complex numbers here. Legend: B states, K tokens, M tries, L ways to lie
(turn and side), C corners of a token, filled up to those of the largest by repeating the last one,
P points within the outline.
"""

import time
from dataclasses import dataclass

import numpy as np
import shapely

from tangram_sim.areas import Area, overlap, straightened
from tangram_sim.arrays import Bools, Complex, Floats, Ints
from tangram_sim.dissections import Dissection
from tangram_sim.layout import Layout
from tangram_vision.silhouettes import SOLVED, Filled, covered

POINTS = 256  # a tan has 16 of them at least; more make evaluations fewer
_TURNS = 8
_TILT = 0.4  # rad between the points' rows and the outline's sides
_STRAIGHT = 0.004  # of the root of the area: corners of drawings that are none
_INSIDE = -1e-6  # squared units: rounding
_OWN, _ALONG, _NUDGED = 0.5, 0.3, 0.2  # shares of tries, see `Board.tries`
_NUDGE = 0.05  # of the root of the area
_ENOUGH = SOLVED + 0.005  # IoU: as a figure is scored, its seams are open
_NEAR = 0.03  # uncovered share from which a state may count as filled


@dataclass(eq=False)
class States:
    """Where the tokens lie in B states.

    Attributes:
        place: (B, K) of their centres.
        lie: (B, K) which of the L ways.
        masks: (B, K, P) the points that each covers.
    """

    place: Complex
    lie: Ints
    masks: Bools

    def uncovered(self) -> Floats:
        """(B,) the share of points that no token covers."""
        share: Floats = 1.0 - self.masks.any(axis=1).mean(axis=1)
        return share

    def lay(self, tokens: Ints, tries: "Tries", chosen: Ints) -> None:
        """Move one token of each state (B,) to one of its tries (B,)."""
        rows = np.arange(len(tokens))
        self.place[rows, tokens] = tries.place[rows, chosen]
        self.lie[rows, tokens] = tries.lie[rows, chosen]
        self.masks[rows, tokens] = tries.masks[rows, chosen]

    def replace(self, rows: Bools, others: "States") -> None:
        """Take those rows (B,) from other states."""
        self.place[rows], self.lie[rows] = others.place[rows], others.lie[rows]
        self.masks[rows] = others.masks[rows]


@dataclass(frozen=True, eq=False)
class Tries:
    """Where one token of each state may go; the first try is where it lies.

    Attributes:
        place, lie: (B, M).
        masks: (B, M, P).
        gain: (B, M) share of the points that it would cover and no other token does.
    """

    place: Complex
    lie: Ints
    masks: Bools
    gain: Floats


class Board:
    """An outline, and all that does not change while it is filled.

    Attributes:
        layout: the tokens.
        points: (P,) within the outline, in a square lattice.
        bodies: (K, L, C) tokens' corners around their centres, counter-clockwise.
    """

    def __init__(self, area: Area, layout: Layout) -> None:
        """An outline of the tokens' area, in the units of the layout."""
        self.layout, self._area, self._unit = layout, area, float(np.sqrt(area.area))
        rings = [straightened(ring, _STRAIGHT * self._unit) for ring in _rings(area)]
        self._corners = np.concatenate(rings)
        self._sides = np.concatenate([np.roll(ring, -1) - ring for ring in rings])
        length = np.abs(self._sides)
        grid = float(np.angle((self._sides**8 / length**7).sum()) / 8.0)
        self.points = self._lattice(grid + _TILT)
        ones = np.ones(len(self.points))
        self._plane = np.stack([self.points.real, self.points.imag, ones]).astype(np.float32)
        self.bodies = self._lies(grid)

    @property
    def lies(self) -> int:
        """L."""
        return len(self._turns)

    def random(self, count: int, rng: np.random.Generator) -> States:
        """So many states, each token anywhere in the outline."""
        shape = (count, self.layout.tokens)
        return self.states(rng.choice(self.points, shape), rng.integers(self.lies, size=shape))

    def states(self, place: Complex, lie: Ints) -> States:
        """States by places and ways to lie (B, K)."""
        return States(place, lie, self._masks(place[..., None] + self._laid(lie)))

    def tries(self, states: States, tokens: Ints, count: int, rng: np.random.Generator) -> Tries:
        """So many tries for one token (B,) of each state.

        Most lie anyhow, with one of their corners in a corner of the outline or of a token of the
        state, or somewhere along the side that leaves it; some are nudged from where they lie.
        """
        rows, shape = np.arange(len(tokens))[:, None], (len(tokens), count)
        own, along, nudged = rng.random((3, *shape)) < np.array([_OWN, _ALONG, _NUDGED]).reshape(
            3, 1, 1
        )
        lie = rng.integers(self.lies, size=shape)
        corners = states.place[..., None] + self._laid(states.lie)
        sides = np.roll(corners, -1, axis=-1) - corners
        outer = rng.integers(len(self._corners), size=shape)
        drawn = rng.integers(corners[0].size, size=shape)
        start = np.where(own, self._corners[outer], _rows(corners)[rows, drawn])
        side = np.where(own, self._sides[outer], _rows(sides)[rows, drawn])
        anchor = start + np.where(along, rng.random(shape), 0.0) * side
        corner = rng.integers(self.bodies.shape[-1], size=shape)
        place = anchor - self.bodies[tokens[:, None], lie, corner]
        step = rng.normal(scale=_NUDGE * self._unit, size=(2, *shape))
        step[:, :, 0], nudged[:, 0] = 0.0, True
        now = states.place[rows, tokens[:, None]]
        place = np.where(nudged, now + step[0] + 1j * step[1], place)
        lie = np.where(nudged, states.lie[rows, tokens[:, None]], lie)
        masks = self._masks(place[..., None] + self.bodies[tokens[:, None], lie])
        others = states.masks.sum(axis=1, dtype=np.int8) - states.masks[rows[:, 0], tokens]
        free = np.count_nonzero(masks & (others == 0)[:, None], axis=-1)
        return Tries(place, lie, masks, free / len(self.points))

    def overlap(self, place: Complex, lie: Ints) -> tuple[Dissection, float]:
        """A state (K,) on exact polygons, and its intersection over union with the outline."""
        own = lie, np.arange(self.layout.tokens)
        poses = np.column_stack([place.real, place.imag, self._turns[own]])
        found = Dissection(poses, self._flipped[own])
        return found, overlap(covered(self.layout, found), self._area)

    def _masks(self, corners: Complex) -> Bools:
        """(..., P) the points that polygons (..., C) cover."""
        edge = np.roll(corners, -1, axis=-1) - corners
        lines = np.stack([-edge.imag, edge.real, (edge * corners.conj()).imag], axis=-1)
        inside = lines.astype(np.float32).reshape(-1, 3) @ self._plane >= _INSIDE
        return np.asarray(inside.reshape(*corners.shape, -1).all(axis=-2))

    def _laid(self, lie: Ints) -> Complex:
        """(B, K, C) tokens' corners around their centres."""
        return self.bodies[np.arange(self.layout.tokens), lie]

    def _lattice(self, turn: float) -> Complex:
        low_x, low_y, high_x, high_y = self._area.bounds
        reach = float(np.hypot(high_x - low_x, high_y - low_y)) / 2.0
        steps = np.arange(-reach, reach, self._unit / np.sqrt(POINTS))
        z = (steps + 1j * steps[:, None]).ravel() * np.exp(1j * turn)
        z += complex(low_x + high_x, low_y + high_y) / 2.0
        own: Complex = z[shapely.contains_xy(self._area, z.real, z.imag)]
        return own

    def _lies(self, grid: float) -> Complex:
        """The tokens' corners in all ways to lie, on either side where that makes a difference."""
        layout, number = self.layout, np.arange(2 * _TURNS)[:, None]
        self._flipped: Bools = (number >= _TURNS) & layout.chiral
        first = (layout.body[layout.starts[:-1] + 1] - layout.body[layout.starts[:-1]]) @ (1.0, 1j)
        along = np.where(self._flipped, -1.0, 1.0) * np.angle(first)
        self._turns: Floats = grid + np.pi / 4.0 * (number % _TURNS) - along
        poses = np.zeros((*self._turns.shape, 3))
        poses[..., 2] = self._turns
        z = (layout.corners(poses, self._flipped) @ (1.0, 1j))[:, layout.padded_corners]
        # Tokens on their other side have their corners clockwise.
        return np.where(self._flipped[..., None], z[..., ::-1], z).swapaxes(0, 1)


class Attempt:
    """One figure: what may be spent on it, and the best filling so far.

    Attributes:
        board: the figure.
        evaluations: of states so far.
        best: the filling; None before the first look.
    """

    def __init__(self, board: Board, seconds: float, most: int = 10**12) -> None:
        """At most so many seconds of this process's time, and about so many evaluations."""
        self.board, self._seconds, self._most = board, seconds, most
        self._begin, self.evaluations = time.process_time(), 0
        self.best: Dissection | None = None
        self._iou, self._least = 0.0, 1.0

    def look(self, states: States) -> bool:
        """Judge the best of the states on exact polygons; whether the attempt is over."""
        left = states.uncovered()
        state = int(left.argmin())
        if left[state] < max(self._least, _NEAR):
            self._least = min(self._least, float(left[state]))
            found, iou = self.board.overlap(states.place[state], states.lie[state])
            if iou > self._iou:
                self.best, self._iou = found, iou
        return (
            self._iou >= _ENOUGH or self.evaluations >= self._most or self._passed >= self._seconds
        )

    def result(self) -> Filled:
        """What came of it."""
        return Filled(self.best, self._iou, self._passed, self.evaluations, False)

    @property
    def _passed(self) -> float:
        return time.process_time() - self._begin


def _rings(area: Area) -> list[Complex]:
    return [
        np.asarray(ring.coords)[:-1] @ np.array([1.0, 1j])
        for part in shapely.get_parts(area).tolist()
        for ring in (part.exterior, *part.interiors)
    ]


def _rows(corners: Complex) -> Complex:
    return corners.reshape(len(corners), -1)
