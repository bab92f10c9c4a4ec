"""Fill the silhouette in a picture with a layout's tokens.

The picture is outlined in several ways. Each outline is searched for an exact filling, then a beam
search lays tokens that need not fit. Each result is fitted to all pixels; the remaining difference
ranks it. Then tokens whose pixels differ most are taken up, and laid anew in the area left.

Legend: K tokens, P pixels along a side of a picture.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, islice

import numpy as np
import shapely

from tangram_core.arrays import Floats, Singles
from tangram_sim.geometry.areas import Area
from tangram_sim.geometry.dissections import (
    Budget,
    Dissection,
    Laid,
    Search,
    Tokens,
    dissection,
    without,
)
from tangram_sim.geometry.layout import Layout
from tangram_vision.pictures.kinds import Kind, kinds_of
from tangram_vision.pictures.ramps import fitted, ramps
from tangram_vision.silhouettes.beams import Beam
from tangram_vision.silhouettes.outlines import WAYS, Way, outline
from tangram_vision.silhouettes.silhouettes import (
    SOLVED,
    TOLERANCES,
    Filled,
    nearest_fill,
    pieces,
)

_EACH_S = 0.5  # for the search of one outline
_EACH = 2  # dissections compared for each outline and tolerance of a search
_BEST = 3  # dissections compared for each beam search
_ALIKE = 0.02  # share of the tokens' area: a smaller difference is good enough, and ends the search
_ROUGH = (0.035, 0.07)  # tolerances of a beam search
_AGAIN = 3  # tokens that are laid anew
_TRIED = 12  # choices of such tokens that are tried
_MARGIN = 3  # pixels around a silhouette
_SHARE = 0.9  # of the time; the rest is for an attempt where nothing was found


@dataclass(frozen=True, eq=False)
class _Explained:
    """An explanation of a picture.

    Attributes:
        found: poses of the tokens, in the units of the layout.
        kinds: K kinds of the tokens.
        poses: (K, 3) poses in pixels.
        differs: share of the tokens' area in which pixels differ.
        by: the method, search or beam.
    """

    found: Dissection
    kinds: list[Kind]
    poses: Floats
    differs: float
    by: str


def fill_picture(cover: Singles, layout: Layout, view: float, seconds: float) -> Filled:
    """The dissection that explains a picture's coverage (P, P) best.

    Args:
        cover: coverage, about 0 on the ground and 1 in the silhouette.
        layout: the tokens.
        view: width of the picture, in the units of the layout.
        seconds: processor time, at most.
    """
    begin, unit = time.thread_time(), view / len(cover)
    crop, corner = _cropped(cover)
    explainer = _Explainer(crop, layout, kinds_of(layout, view, len(cover)), unit)
    explainer.run(Budget(begin + _SHARE * seconds))
    best, nodes = explainer.best, explainer.budget.taken
    if best is not None:
        iou = _overlap(best, crop)
        found = _moved(best.found, corner * unit)
        return Filled(found, iou, time.thread_time() - begin, nodes, False, by=best.by)
    area, late = explainer.outlined(WAYS[0]), Budget(begin + seconds)
    laid, iou = nearest_fill(area, layout, late, explainer.attempts)
    attempt = None if laid is None else _moved(laid, corner * unit)
    return Filled(None, iou, time.thread_time() - begin, nodes, False, attempt)


def _moved(found: Dissection, way: Floats) -> Dissection:
    """The dissection moved by `way` (2,)."""
    return replace(found, poses=found.poses + (*way, 0.0))


class _Explainer:
    """Search for the best explanation of one picture.

    Attributes:
        best: the best explanation so far; None at first.
        attempts: arrangements that lack tokens.
        budget: limit of the search, and the steps taken.
    """

    def __init__(self, cover: Singles, layout: Layout, kinds: Sequence[Kind], unit: float) -> None:
        """Explain coverage (P, P); a pixel is `unit` wide, in units of the layout."""
        self._cover, self._layout, self._kinds, self._unit = cover, layout, kinds, unit
        self._tokens = Tokens(layout)
        self._beam = Beam(self._tokens)
        self.best: _Explained | None = None
        self.attempts: list[list[Laid]] = []
        self.budget = Budget(0.0)

    def run(self, budget: Budget) -> None:
        """Search until an explanation is good enough, or the budget is spent."""
        self.budget = budget
        for way in WAYS:
            area, before = self.outlined(way), self.best
            if self._search(area):
                return
            if self._lay(area, (), self._tokens.counts, _ROUGH):
                return
            while self.best is not None and self.best is not before:
                before = self.best
                if self._mend(before, area):
                    return
            if budget.spent():
                return

    def outlined(self, way: Way) -> Area:
        """One possible outline of the picture, in the units of the layout."""
        return shapely.transform(outline(self._cover, way), lambda points: points * self._unit)

    def _search(self, area: Area) -> bool:
        """Offer the results of a search; whether the best one is good enough."""
        end = self.budget.until
        self.budget.until = min(time.thread_time() + _EACH_S, end)
        for tolerance in TOLERANCES[1:]:
            search = Search(self._tokens, tolerance * self._tokens.unit, self.budget)
            for laid in islice(search.run(area), _EACH):
                if self._offer(laid, "search"):
                    return True
            self.attempts.append(search.best)
        self.budget.until = end
        return False

    def _lay(
        self,
        area: Area,
        kept: Sequence[Laid],
        left: tuple[int, ...],
        tolerances: Sequence[float],
    ) -> bool:
        """Offer what a beam lays beside the kept tokens; whether the best one is good enough."""
        for tolerance in tolerances:
            states = self._beam.run(area, left, tolerance * self._tokens.unit, self.budget)
            for state in states[:_BEST]:
                laid = [*kept, *state.laid]
                if any(state.left):
                    self.attempts.append(laid)
                elif self._offer(laid, "beam"):
                    return True
        return False

    def _mend(self, best: _Explained, area: Area) -> bool:
        """Lay some tokens anew, those whose pixels differ most first.

        Returns:
            Whether the best explanation is good enough.
        """
        wrong, bodies = _wrong(best, self._cover), np.array(pieces(self._layout, best.found))
        count, tolerance = len(wrong), _ROUGH[0] * self._tokens.unit
        choices = combinations(range(count), min(_AGAIN, count))
        for again in sorted(choices, key=lambda some: -wrong[list(some)].sum())[:_TRIED]:
            others = [k for k in range(count) if k not in again]
            covered = shapely.union_all(bodies[others])
            rest = without(area, covered, tolerance, self._tokens.unit)
            kept = [self._laid(best.found, k) for k in others]
            left = tuple(sum(k in own for k in again) for own in self._tokens.own)
            if self._lay(rest, kept, left, _ROUGH[:1]):
                return True
        return False

    def _laid(self, found: Dissection, token: int) -> Laid:
        shape = next(n for n, own in enumerate(self._tokens.own) if token in own)
        return Laid(shape, bool(found.flipped[token]), found.poses[token])

    def _offer(self, laid: Sequence[Laid], by: str) -> bool:
        """Keep an arrangement if it is the best; whether the best one is good enough."""
        found = dissection(self._tokens, laid)
        kinds = [
            next(kind for kind in self._kinds if k in kind.tokens and kind.flipped == flipped)
            for k, flipped in enumerate(found.flipped.tolist())
        ]
        size = (self._unit, self._unit, 1.0)
        poses, differs = fitted(kinds, found.poses / size, self._cover)
        if self.best is None or differs < self.best.differs:
            self.best = _Explained(replace(found, poses=poses * size), kinds, poses, differs, by)
        return self.best.differs < _ALIKE and _overlap(self.best, self._cover) >= SOLVED


def _wrong(best: _Explained, cover: Singles) -> Floats:
    """(K,) sum of the differences of pixels that each token covers or touches."""
    own = ramps(best.kinds, best.poses, len(cover))
    off = np.abs(cover - np.minimum(own.sum(axis=0), 1.0))
    near = np.pad(own, ((0, 0), (1, 1), (1, 1)))
    near = np.maximum.reduce(
        [near[:, 1:-1, :-2], near[:, 1:-1, 2:], near[:, :-2, 1:-1], near[:, 2:, 1:-1], own]
    )
    return np.asarray((near * off).sum(axis=(1, 2)))


def _overlap(best: _Explained, cover: Singles) -> float:
    """Intersection over union of tokens and coverage (P, P)."""
    drawn = np.minimum(ramps(best.kinds, best.poses, len(cover)).sum(axis=0), 1.0)
    seen = np.clip(cover, 0.0, 1.0)
    return float(np.minimum(drawn, seen).sum() / np.maximum(drawn, seen).sum())


def _cropped(cover: Singles) -> tuple[Singles, Floats]:
    """The square around what is covered, and its upper left corner, x and y, in pixels."""
    rows, columns = (np.flatnonzero((cover > 0.3).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return cover, np.zeros(2)
    top, left = max(0, int(rows[0]) - _MARGIN), max(0, int(columns[0]) - _MARGIN)
    part = cover[top : int(rows[-1]) + _MARGIN + 1, left : int(columns[-1]) + _MARGIN + 1]
    side = max(part.shape)
    room = ((0, side - part.shape[0]), (0, side - part.shape[1]))
    return np.pad(part, room), np.array([left, -top], np.float64)
