"""Find the figure of all tokens that comes nearest to a drawing that they cannot fill.

Simulated annealing: a step takes some tokens up and lays each anew where it adds most. A
correlation gives the gain of all places at once. Then all tokens slide to increase their gain.

Points and directions are complex numbers here. Legend: K tokens, n tokens or places, C corners of a
token, padded by repeating the last one, X x Y pixels, M samples on a token's edges.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.fft
import shapely
from scipy.ndimage import gaussian_filter

from tangram_core.arrays import AnyArray, Bools, Complex, Floats, Ints, Singles
from tangram_sim.geometry.areas import Area, overlap, rings, valid
from tangram_sim.geometry.dissections import Dissection
from tangram_sim.geometry.fitting import separate
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import outlines
from tangram_sim.geometry.rings import unit_of
from tangram_sim.geometry.shapes import mirror_image
from tangram_vision.silhouettes.silhouettes import covered

_PIXELS = 20  # along the root of all tokens' area
_MOST = 20_000  # pixels of the canvas, at most: a long drawing gets larger pixels
_FINE = 8  # samples of the drawing along a pixel's side
_TURNS = 8  # angles of a full turn at which tokens are laid
_STRAIGHT = 0.03  # of the root of all tokens' area: how far a straight side by hand may stray
_ALIKE = 2.0  # how sharply directions of sides are told apart
_RUNS, _STEPS = 3, 500  # annealing runs, and steps of each
_TAKEN = 4  # tokens that are laid anew at a time, at most
_HEAT = 0.02  # of the tokens' area: a loss that is accepted with probability 1/e, at first
# Cost of area that is covered twice, at first and at last; area covered once is worth 1. At a low
# cost tokens can move past each other.
_COSTS = (0.7, 1.5)
_SHARE = 0.9  # of the time, for annealing; the rest is for the last slides
_KEPT = 0.6  # share of its speed that a token keeps from step to step
_WIDER = 1.05  # tokens that cannot be separated are moved so many times as far from their middle
_NONE = 1e-9  # an edge of this length belongs to a repeated corner


@dataclass(frozen=True, eq=False)
class _Way:
    """Settings of a slide, in which tokens follow the gain along their edges.

    Attributes:
        steps: number of steps.
        samples: samples on each edge.
        far: length of the first step and of the last one, in roots of all tokens' area.
        soft: width of edges at first and at last, in pixels.
        blur: blur of the drawing, in pixels; edges see a gain from that far.
        cost: cost of area that is covered twice.
    """

    steps: int
    samples: int
    far: tuple[float, float]
    soft: tuple[float, float]
    blur: float
    cost: float


_ROUGH = _Way(10, 8, (0.05, 0.01), (1.5, 0.3), 0.5, _COSTS[0])
_LAST = (
    _Way(150, 24, (0.03, 0.002), (0.5, 0.05), 0.12, 1.0),
    _Way(60, 48, (0.005, 0.0003), (0.1, 0.01), 0.12, 1.0),
)


@dataclass(frozen=True, eq=False)
class _State:
    """Poses of all tokens, and what they cover.

    Attributes:
        poses: (K, 3).
        flipped: (K,).
        masks: (K, X, Y) share of each pixel that each token covers.
        once: share of the tokens' area that covers the drawing.
        twice: share of the tokens' area that lies on other tokens.
    """

    poses: Floats
    flipped: Bools
    masks: Singles
    once: float
    twice: float

    def worth(self, cost: float = _COSTS[1]) -> float:
        """The share that covers the drawing, less `cost` times the share on other tokens."""
        return self.once - cost * self.twice


def nearest_figure(
    area: Area, layout: Layout, seconds: float, seed: int = 0, starts: Sequence[Dissection] = ()
) -> tuple[Dissection, float]:
    """Find the figure of all tokens, without overlap, that comes nearest to a drawing.

    The result depends on the seed alone, unless the time is too short for all steps. Seven tans
    take 2 s, and more on a busy machine; a shorter search finds a little less. At least one figure
    is made, in about 0.05 s.

    Args:
        area: the drawing, not empty, in units of the layout, as large as all tokens.
        layout: the tokens.
        seconds: processor time of this thread.
        seed: seed of the random steps.
        starts: arrangements of some tokens or all, where annealing begins instead of with none.

    Returns:
        The figure, and its intersection over union with the drawing.
    """
    begin, drawing = time.thread_time(), valid(area)
    annealer = _Annealer(drawing, layout, np.random.default_rng(seed))
    nothing = np.zeros(layout.tokens, np.bool_)
    none = Dissection(np.zeros((layout.tokens, 3)), nothing, nothing)
    every = [*starts, *[none] * (_RUNS - len(starts))]
    best, most = none, -1.0
    for run, start in enumerate(every):
        until = begin + _SHARE * seconds * (run + 1) / len(every)
        if run and time.thread_time() > until:
            break
        found = _apart(annealer.run(start, until), layout)
        iou = overlap(covered(layout, found), drawing)
        if iou > most:
            best, most = found, iou
    return best, most


def _apart(found: Dissection, layout: Layout) -> Dissection:
    """The tokens pushed apart until none lies on another."""
    poses, unit = found.poses.copy(), unit_of(layout)
    while True:
        corners = layout.corners(poses, found.flipped)
        shifts = separate(outlines(corners[None], layout)[0] / unit)
        if shifts is not None:
            poses[:, :2] += shifts * unit
            return Dissection(poses, found.flipped)
        middle = poses[:, :2].mean(axis=0)
        poses[:, :2] = middle + _WIDER * (poses[:, :2] - middle)


def _direction(area: Area, unit: float) -> float:
    """The angle of most sides of a drawing, modulo 45 degrees."""
    every = [np.roll(z, -1) - z for z, _, _ in rings(area, _STRAIGHT * unit)]
    sides = np.concatenate([np.zeros(1, np.complex128), *every])
    angles = np.arange(90) * np.pi / 360.0
    near = np.exp(_ALIKE * np.cos(8.0 * (np.angle(sides) - angles[:, None])))
    return float(angles[(near * np.abs(sides)).sum(axis=1).argmax()])


class _Canvas:
    """A drawing in pixels.

    Attributes:
        side: side of a pixel.
        wanted: (X, Y) share of each pixel that is drawn.
        x, y: (X,) and (Y,) centres of pixels.
    """

    def __init__(self, area: Area, layout: Layout) -> None:
        """Draw the area with room around it, as a correlation wraps around at the edges."""
        room = 2.0 * float(layout.radii.max())
        self._low, high = np.array(area.bounds[:2]) - room, np.array(area.bounds[2:]) + room
        size = high - self._low
        self.side = max(unit_of(layout) / _PIXELS, float(np.sqrt(size.prod() / _MOST)))
        width, height = (
            scipy.fft.next_fast_len(int(pixels), real=True)
            for pixels in np.ceil(size / self.side).tolist()
        )
        x, y = (self._middles(axis, n, _FINE) for axis, n in enumerate((width, height)))
        shapely.prepare(area)
        fine = shapely.contains_xy(area, x[:, None], y).astype(np.float32)
        self.wanted: Singles = fine.reshape(width, _FINE, height, _FINE).mean(axis=(1, 3))
        self._blurred: dict[float, Singles] = {
            way.blur: gaussian_filter(fine, way.blur * _FINE) for way in (_ROUGH, *_LAST)
        }
        self.x, self.y = self._middles(0, width, 1), self._middles(1, height, 1)

    def _middles(self, axis: int, count: int, parts: int) -> Singles:
        middles = (np.arange(count * parts) + 0.5) * (self.side / parts)
        return np.asarray(self._low[axis] + middles, np.float32)

    def drawn(self, points: Complex, blur: float) -> Singles:
        """Whether points lie in the drawing, from 0 to 1 across its edges."""
        seen = self._blurred[blur]
        scale, (wide, high) = _FINE / self.side, seen.shape
        column = ((points.real - self._low[0]) * scale).astype(np.int64)
        row = ((points.imag - self._low[1]) * scale).astype(np.int64)
        column = np.minimum(np.maximum(column, 0), wide - 1)
        row = np.minimum(np.maximum(row, 0), high - 1)
        return np.asarray(seen[column, row])

    def masks(self, normals: Complex, reach: Floats) -> Singles:
        """Shares (n, X, Y) of pixels inside convex polygons.

        Args:
            normals: (n, C) outward normal of each edge, of length 1.
            reach: (n, C) distance of each edge from the origin along its normal.
        """
        least = np.full((len(normals), len(self.x), len(self.y)), np.inf, np.float32)
        away = (normals / self.side).astype(np.complex64).T[..., None]
        inside = (reach / self.side + 0.5).astype(np.float32).T[..., None]
        for normal, far in zip(away, inside, strict=True):
            deep = (far - normal.real * self.x)[:, :, None] - (normal.imag * self.y)[:, None]
            np.minimum(least, deep, out=least)
        return np.minimum(np.maximum(least, 0.0, out=least), 1.0, out=least)


class _Annealer:
    """Simulated annealing of a layout's tokens in one drawing."""

    def __init__(self, area: Area, layout: Layout, rng: np.random.Generator) -> None:
        self._layout, self._rng, self._unit = layout, rng, unit_of(layout)
        self._every = np.arange(layout.tokens)
        self._canvas = _Canvas(area, layout)
        body = layout.body[layout.padded_corners]
        # (2, K, C) corners of each token, with either side up.
        self._bodies: Complex = np.stack([body, list(map(mirror_image, body))]) @ (1.0, 1j)
        self._edges: Complex = np.roll(self._bodies, -1, axis=-1) - self._bodies
        length = np.abs(self._edges)
        self._normals: Complex = -1j * self._edges / np.maximum(length, _NONE)
        reach = (self._normals.conj() * self._bodies).real
        self._reach: Floats = np.where(length > _NONE, reach, np.inf)
        # The gain of an edge is weighted by its share of the token's perimeter.
        self._weights: Floats = 4.0 * length / length.sum(axis=-1, keepdims=True)
        base = _direction(area, self._unit)
        self._places = [self._places_of(token, base) for token in self._every.tolist()]

    def run(self, start: Dissection, until: float) -> Dissection:
        """The best arrangement of one annealing run.

        Args:
            start: poses at first; missing tokens are laid before annealing.
            until: end of the run, in `time.thread_time`.
        """
        missing = np.setdiff1d(self._every, start.laid)
        state = best = self._next(self._state(start.poses, start.flipped), self._mixed(missing))
        for step in range(_STEPS):
            if time.thread_time() > until:
                break
            part = step / _STEPS
            cost = _COSTS[0] + part * (_COSTS[1] - _COSTS[0])
            new = self._next(state, self._mixed(self._taken(state)))
            if new.worth() > best.worth():
                best = new
            gain = new.worth(cost) - state.worth(cost)
            if self._rng.random() < np.exp(min(gain / (_HEAT * (1.0 - part)), 0.0)):
                state = new
        poses = best.poses
        for way in _LAST:
            poses = self._slid(poses, best.flipped, way)
        return Dissection(poses, best.flipped)

    def _taken(self, state: _State) -> Ints:
        """Random tokens to lay anew, mostly neighbours."""
        count = int(self._rng.integers(1, min(_TAKEN, len(self._every)) + 1))
        offset = state.poses[:, :2] - state.poses[self._rng.integers(len(self._every)), :2]
        far = np.hypot(*offset.T) * self._rng.uniform(0.5, 1.5, len(offset))
        return np.argsort(far)[:count]

    def _mixed(self, tokens: Ints) -> list[int]:
        """The tokens in random order, mostly the large ones first."""
        size = self._layout.areas[tokens] * self._rng.uniform(0.4, 1.6, len(tokens))
        return [int(token) for token in tokens[np.argsort(-size)]]

    def _next(self, state: _State, order: Sequence[int]) -> _State:
        """The state after tokens are laid anew, one after the other, each where it adds most."""
        poses, flipped, canvas = state.poses.copy(), state.flipped.copy(), self._canvas
        others = [token for token in self._every.tolist() if token not in order]
        lying = state.masks[others].sum(axis=0)
        for token in order:
            sides, angles, transforms = self._places[token]
            gains = canvas.wanted * (1.0 - np.minimum(lying, 1.0)) - _COSTS[0] * lying
            worth = scipy.fft.irfft2(scipy.fft.rfft2(gains) * transforms, s=gains.shape)
            place, column, row = np.unravel_index(int(worth.argmax()), worth.shape)
            poses[token] = canvas.x[column], canvas.y[row], angles[place]
            flipped[token] = sides[place]
            lying += self._masks(np.array([token]), poses[[token]], flipped[[token]])[0]
        return self._state(self._slid(poses, flipped, _ROUGH), flipped)

    def _state(self, poses: Floats, flipped: Bools) -> _State:
        masks = self._masks(self._every, poses, flipped)
        lying, pixels = masks.sum(axis=0), self._layout.areas.sum() / self._canvas.side**2
        covering = np.minimum(lying, 1.0)
        once, twice = (covering * self._canvas.wanted).sum(), (lying - covering).sum()
        return _State(poses, flipped, masks, float(once / pixels), float(twice / pixels))

    def _masks(self, tokens: Ints, poses: Floats, flipped: Bools) -> Singles:
        """Masks (n, X, Y) of tokens (n,) in poses (n, 3), on sides (n,)."""
        own = flipped.astype(np.int64), tokens
        normals = self._normals[own] * np.exp(1j * poses[:, 2:])
        centre = poses[:, :1] + 1j * poses[:, 1:2]
        return self._canvas.masks(normals, self._reach[own] + (normals.conj() * centre).real)

    def _places_of(self, token: int, base: float) -> tuple[Bools, Floats, AnyArray]:
        """Sides and angles (n,) to try for a token, and Fourier transforms of its masks."""
        layout, canvas = self._layout, self._canvas
        part = 2.0 * np.pi / int(layout.symmetries[token])
        turns = max(1, _TURNS // int(layout.symmetries[token]))
        count = turns * (2 if layout.chiral[token] else 1)
        sides = np.arange(count) >= turns
        angles = np.asarray(base + np.arange(count) % turns * (part / turns), np.float64)
        column, row = len(canvas.x) // 2, len(canvas.y) // 2
        poses = np.column_stack([np.zeros((count, 2)), angles])
        poses[:, :2] = canvas.x[column], canvas.y[row]
        masks = self._masks(np.full(count, token), poses, sides)
        centred = np.roll(masks, (-column, -row), axis=(1, 2))
        return sides, angles, scipy.fft.rfft2(centred).conj()

    def _slid(self, poses: Floats, flipped: Bools, way: _Way) -> Floats:
        """Poses after a slide of tokens to where their edges gain, and away from others."""
        own, side = (flipped.astype(np.int64), self._every), self._canvas.side
        share = (np.arange(way.samples) + 0.5) / way.samples
        body = self._bodies[own][..., None] + self._edges[own][..., None] * share
        normals, weights = self._normals[own], self._weights[own] / way.samples
        push = np.repeat(weights * normals, way.samples, axis=1)  # (K, M), as body
        body = body.reshape(push.shape)
        turn_by = (body.conj() * push).imag / (2.0 * self._layout.radii[:, None] ** 2)
        centre, angle = poses[:, 0] + 1j * poses[:, 1], poses[:, 2]
        speed, spin = np.zeros_like(centre), np.zeros_like(angle)
        far, soft = np.geomspace(*way.far, way.steps), np.geomspace(*way.soft, way.steps)
        for step, width in zip((far * self._unit).tolist(), (soft * side).tolist(), strict=True):
            turn = np.exp(1j * angle)[:, None]
            points = centre[:, None] + turn * body
            out = turn * normals
            reach = self._reach[own] + (out.conj() * centre[:, None]).real
            on = self._lying(points.ravel(), out / width, reach / width).reshape(push.shape)
            drawn = self._canvas.drawn(points, way.blur)
            gain = drawn * (1.0 - np.minimum(on, 1.0)) - way.cost * on
            speed = _KEPT * speed + (1.0 - _KEPT) * (gain * push).sum(axis=1) * turn[:, 0]
            spin = _KEPT * spin + (1.0 - _KEPT) * (gain * turn_by).sum(axis=1)
            centre, angle = centre + step * speed, angle + step * spin
        return np.column_stack([centre.real, centre.imag, angle])

    def _lying(self, points: Complex, normals: Complex, reach: Floats) -> Floats:
        """How many other tokens lie on points (K M,); edges (K, C) are one unit wide."""
        deep = np.full((len(normals), len(points)), np.inf)
        for normal, far in zip(normals.T[..., None], reach.T[..., None], strict=True):
            inside = far - (normal.real * points.real + normal.imag * points.imag)
            np.minimum(deep, inside, out=deep)
        on = np.clip(deep + 0.5, 0.0, 1.0).reshape(len(normals), len(normals), -1)
        on[self._every, self._every] = 0.0
        return np.asarray(on.sum(axis=0))
