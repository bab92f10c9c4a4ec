"""Search for touching tokens ("a pile") that explain one common outline.

At a convex corner of the outline some token has a corner, too, with an edge along a side of the
outline. The search tries each token and each of its corners, with an edge along either side of the
outline there. A token that stays inside and explains most of the outline is subtracted, until the
rest is a single token. Then all poses are fitted to all pixels together. The remaining difference
of the pixels ranks the arrangements.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np

from tangram_core.arrays import Complex, Floats, Ints, Singles
from tangram_sim.geometry.dissections import less
from tangram_sim.targets.connected import MAX_PILE
from tangram_vision.pictures.blobs import find_blobs, likeness
from tangram_vision.pictures.edges import NARROW, WIDE, Outlines
from tangram_vision.pictures.kinds import Kind
from tangram_vision.pictures.ramps import fitted, ramps, unlike

_TRIED = 120  # corner fits that are refined
_BEAM = (10, 6, 4)  # refined fits that are followed, by the number of tokens laid before
_LEAVES = 8  # complete arrangements that are compared
_MOST_STEPS = 40  # outlines whose corners are tried
_GOOD, _MORE_STEPS = 0.02, 4  # an arrangement that differs so little allows so many more steps
_UNLIKE = 0.5  # share of a pile's area that may differ before its poses are fitted
_OUTSIDE = 0.2  # share of a token that may lie outside the outline; a third of it when refined
_AREA = 0.3  # error of an area over its perimeter, in pixels
_FLAT = np.radians(165.0)
_SLACK = np.radians(25.0)
_RUGGED = 1.2  # pixels between an outline and its polygon, at most
_ROUNDS = (WIDE, WIDE, NARROW)
_BEYOND = 40  # pixels around a picture where the rest of a cut-off token may lie
_SHOWN = 0.6  # share of such a token that must be seen
_FEW = 3  # fits of such a token that are compared


@dataclass(frozen=True, eq=False)
class Laid:
    """Tokens that explain a pile.

    Attributes:
        kinds: indices into the list of kinds.
        poses: (n, 3), pixels from the picture's upper left corner, y up.
        differs: share of the pile's area in which tokens and picture differ.
    """

    kinds: tuple[int, ...]
    poses: Floats
    differs: float


def arrangements(cover: Singles, kinds: Sequence[Kind], left: Sequence[int]) -> list[Laid]:
    """Distinct arrangements of tokens that explain a pile, the best first; empty if none is found.

    Args:
        cover: (P, P) coverage by the pile alone.
        kinds: all kinds of the layout.
        left: number of available tokens of each shape.
    """
    rows, columns = (np.flatnonzero((cover > 0.5).any(axis=axis)) for axis in (1, 0))
    top, begin = max(0, rows[0] - 5), max(0, columns[0] - 5)
    crop = np.ascontiguousarray(cover[top : rows[-1] + 6, begin : columns[-1] + 6])
    side = max(crop.shape)
    crop = np.pad(crop, ((0, side - crop.shape[0]), (0, side - crop.shape[1])))
    search, found, end = _Search(crop, kinds), list[Laid](), _MOST_STEPS
    for names, rough in search.run(tuple(left)):
        if search.steps > end:
            break
        own = [kinds[name] for name in names]
        if unlike(own, rough, crop) > _UNLIKE:
            continue
        poses, differs = fitted(own, rough, crop)
        if not any(search.same(names, poses, laid.kinds, laid.poses) for laid in found):
            found.append(Laid(names, poses, differs))
        if differs < _GOOD:
            end = min(end, search.steps + _MORE_STEPS)
        if len(found) == _LEAVES:
            break
    found.sort(key=lambda laid: laid.differs)
    origin = np.array([begin, -top, 0.0])
    return [replace(laid, poses=laid.poses + origin) for laid in found]


def reaching_out(cover: Singles, kinds: Sequence[Kind], left: Sequence[int]) -> list[Laid]:
    """Single tokens that explain a blob cut off by the picture's edge, the best first.

    Args:
        cover: (P, P) coverage by the blob alone, in the whole picture.
        kinds: all kinds of the layout.
        left: number of available tokens of each shape.
    """
    search, found = _Search(cover, kinds, _BEYOND), list[Laid]()
    for name, rough in search.corners(cover, float(cover.sum()) / _SHOWN, tuple(left))[:_FEW]:
        poses, differs = fitted([kinds[name]], rough[None], cover)
        if not any(search.same((name,), poses, laid.kinds, laid.poses) for laid in found):
            found.append(Laid((name,), poses, differs))
    return sorted(found, key=lambda laid: laid.differs)


class _Search:
    """Depth-first search that takes tokens out of one pile (P, P), the best token first.

    Attributes:
        steps: outlines whose corners were tried.
    """

    def __init__(self, cover: Singles, kinds: Sequence[Kind], beyond: int = 0) -> None:
        """Prepare the search of a pile.

        Args:
            cover: coverage by the pile.
            kinds: kinds that the pile may contain.
            beyond: pixels around the picture where the pile may continue.
        """
        self._cover, self._kinds, self._beyond = cover, kinds, beyond
        self.steps = 0
        self._smallest = min(kind.area for kind in kinds)

    def run(self, left: tuple[int, ...]) -> Iterator[tuple[tuple[int, ...], Floats]]:
        """Yield kinds and rough poses (n, 3) of complete arrangements."""
        yield from self._rest(self._cover, left, (), np.zeros((0, 3)))

    def _rest(
        self, rest: Singles, left: tuple[int, ...], laid: tuple[int, ...], poses: Floats
    ) -> Iterator[tuple[tuple[int, ...], Floats]]:
        """Explain what is left of the pile, part after part."""
        blobs = find_blobs(rest, 0.4 * self._smallest)
        if not len(blobs):
            yield laid, poses
            return
        if len(laid) + len(blobs) > MAX_PILE:
            return
        # The smallest part is explained first: it is mostly one token.
        part = blobs.cover[blobs.base[-1] :][: len(rest)]
        others = blobs.cover[: blobs.base[-1]].reshape(-1, *rest.shape).sum(axis=0)
        area = float(blobs.area[-1])
        single = [] if not laid else self._single(blobs.moments[-1:], blobs.centre[-1], area, left)
        for kind, pose in single:
            now = less(left, self._kinds[kind].shape)
            yield from self._rest(others, now, (*laid, kind), np.vstack([poses, pose]))
        most = MAX_PILE - len(laid) - len(blobs) + 1
        if not single and most > 1 and self._sums(area, left, most):
            for kind, pose in self.corners(part, area, left, len(laid)):
                here = ramps([self._kinds[kind]], pose[None], rest.shape[0])[0]
                now = less(left, self._kinds[kind].shape)
                gone = np.clip(rest - here, 0.0, 1.0).astype(np.float32)
                yield from self._rest(gone, now, (*laid, kind), np.vstack([poses, pose]))

    def _single(
        self, moments: Complex, centre: complex, area: float, left: tuple[int, ...]
    ) -> list[tuple[int, Floats]]:
        """Kinds that a part of the pile looks like, and poses."""
        far, turn = likeness(moments, self._kinds)
        near = [
            k
            for k, kind in enumerate(self._kinds)
            if left[kind.shape] and far[0, k] < 0.22 and self._is_area(area, k)
        ]
        near.sort(key=lambda k: float(far[0, k]))
        return [(k, np.array([centre.real, centre.imag, turn[0, k]])) for k in near[:2]]

    def _is_area(self, area: float, kind: int) -> bool:
        return abs(area - self._kinds[kind].area) < 2.0 * _AREA * self._kinds[kind].perimeter

    def _sums(self, area: float, left: tuple[int, ...], most: int) -> bool:
        """Whether two to `most` of the tokens that are left may have this area together."""
        areas = {kind.shape: kind.area for kind in self._kinds}
        sizes = [areas[shape] for shape, count in enumerate(left) for _ in range(min(count, most))]
        slack = 3.0 * _AREA * max(kind.perimeter for kind in self._kinds)
        return any(
            abs(sum(some) - area) < slack
            for count in range(2, most + 1)
            for some in combinations(sizes, count)
        )

    def corners(
        self, part: Singles, area: float, left: tuple[int, ...], depth: int = 0
    ) -> list[tuple[int, Floats]]:
        """Kinds and poses of tokens at corners of a part; the best for its outline come first."""
        self.steps += 1
        names, poses = self._proposed(part, area, left)
        if not len(names):
            return []
        # Beyond the picture everything counts as covered: a token may continue there.
        part = np.pad(part, self._beyond, constant_values=1.0)
        corner = np.array([self._beyond, -self._beyond, 0.0])
        poses += corner
        outside = self._outside(part, names, poses)
        order = np.argsort(outside, kind="stable")[:_TRIED]
        order = order[outside[order] < _OUTSIDE]
        names, poses = names[order], poses[order]
        if not len(names):
            return []
        poses, seen = self._refined(part, names, poses)
        outside = self._outside(part, names, poses)
        worth = seen - 40.0 * outside
        order = np.argsort(-worth, kind="stable")
        kept: list[tuple[int, Floats]] = []
        for i in order[outside[order] < _OUTSIDE / 3.0].tolist():
            if not any(self._alike(int(names[i]), poses[i], *other) for other in kept):
                kept.append((int(names[i]), poses[i]))
            if len(kept) == _BEAM[min(depth, 2)]:
                break
        return [(name, pose - corner) for name, pose in kept]

    def _proposed(self, part: Singles, area: float, left: tuple[int, ...]) -> tuple[Ints, Floats]:
        """Kinds (n,) and poses (n, 3) that lay a corner and an edge onto those of the outline."""
        names, poses = [], []
        usable = [
            (k, kind)
            for k, kind in enumerate(self._kinds)
            if left[kind.shape] and kind.area < area * 1.05
        ]
        for corner, before, after, inner in _convex(part):
            for k, kind in usable:
                body = kind.corners @ (1.0, 1j)
                out, back = np.roll(body, -1) - body, np.roll(body, 1) - body
                own = np.angle(back / out) % (2.0 * np.pi)
                for c in np.flatnonzero(own[: kind.different] < inner + _SLACK).tolist():
                    turns = {np.angle(after / out[c]), np.angle(before / back[c])}
                    for turn in turns:
                        place = corner - body[c] * np.exp(1j * turn)
                        names.append(k)
                        poses.append((place.real, place.imag, turn))
        return np.array(names, np.int64), np.array(poses).reshape(-1, 3)

    def _outside(self, part: Singles, names: Ints, poses: Floats) -> Floats:
        """(n,) share of tokens that lies outside of a part."""
        shares = np.empty(len(names))
        for k in set(names.tolist()):
            own = np.flatnonzero(names == k)
            points = _inner_points(self._kinds[k])
            z = points * np.exp(1j * poses[own, 2:]) + (poses[own, :1] + 1j * poses[own, 1:2])
            shares[own] = 1.0 - np.minimum(2.0 * _levels(part, z), 1.0).mean(axis=1)
        return shares

    def _refined(self, part: Singles, names: Ints, poses: Floats) -> tuple[Floats, Floats]:
        """Poses refined by visible edges, and how many pixels of the outline each explains."""
        base = np.zeros(len(names), np.int64)
        kinds = [self._kinds[k] for k in names.tolist()]
        every = {reach: Outlines(kinds, reach) for reach in set(_ROUNDS)}
        for reach in _ROUNDS:
            lines = every[reach]
            off = lines.off(poses, part, base)
            poses = lines.move_seen(poses, off, np.abs(off) < reach * 0.8)
        lines = every[NARROW]
        hit = np.abs(lines.off(poses, part, base)) < 0.6
        return poses, np.bincount(lines.owner, hit, len(names)).astype(np.float64)

    def same(
        self, names: tuple[int, ...], poses: Floats, others: tuple[int, ...], those: Floats
    ) -> bool:
        """Whether two arrangements have every token in the same place."""
        if sorted(names) != sorted(others):
            return False
        return all(
            any(
                self._alike(kind, pose, other, that)
                for other, that in zip(others, those, strict=True)
            )
            for kind, pose in zip(names, poses, strict=True)
        )

    def _alike(self, kind: int, pose: Floats, other: int, that: Floats) -> bool:
        """Whether two tokens are of one shape and lie in one place."""
        if kind != other or np.hypot(*(pose - that)[:2]) > 1.0:
            return False
        body = self._kinds[kind].corners @ (1.0, 1j)
        one, two = body * np.exp(1j * pose[2]), body * np.exp(1j * that[2])
        return bool(np.abs(one[:, None] - two).min(axis=1).max() < 1.5)


def _inner_points(kind: Kind) -> Complex:
    """Points spread over a shape, at some distance from its edges."""
    corners = kind.corners @ (1.0, 1j)
    rings = [corners * share for share in (0.9, 0.6, 0.3)]
    middles = [(ring + np.roll(ring, -1)) / 2.0 for ring in rings]
    quarters = [(3.0 * rings[0] + np.roll(rings[0], one)) / 4.0 for one in (1, -1)]
    points: Complex = np.concatenate([*rings, *middles, *quarters, [0j]])
    return points


def _levels(cover: Singles, z: Complex) -> Floats:
    """Coverage (n, m) at points (n, m)."""
    side = len(cover) - 1
    column, row = np.clip(z.real - 0.5, 0, side), np.clip(-z.imag - 0.5, 0, side)
    level = cv2.remap(cover, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR)
    return np.asarray(level, np.float64).reshape(z.shape)


def _convex(part: Singles) -> list[tuple[complex, complex, complex, float]]:
    """Convex corners of an outline: place, vectors to both neighbours, inner angle."""
    mask = (part > 0.5).astype(np.uint8)
    found, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outline = max(found, key=len)
    polygon = cv2.approxPolyDP(outline, _RUGGED, closed=True)[:, 0].astype(np.float64)
    z = (polygon[:, 0] + 0.5) - 1j * (polygon[:, 1] + 0.5)
    if len(z) < 3:
        return []
    if (z.conj() * np.roll(z, -1)).imag.sum() < 0:
        z = z[::-1]
    corners = []
    for corner, before, after in zip(z, np.roll(z, 1), np.roll(z, -1), strict=True):
        back, ahead = before - corner, after - corner
        inner = float(np.angle(back / ahead) % (2.0 * np.pi))
        if inner < _FLAT:
            # The outline runs through the centres of its pixels, half a pixel inside.
            middle = np.exp(1j * (np.angle(ahead) + inner / 2.0))
            corners.append((corner - 0.5 * middle, back, ahead, inner))
    return corners
