"""Find the pose and the side of each token in a picture's coverage, and whether they are certain.

A blob that looks like one token is fitted at once; other blobs are searched for touching tokens.
The set of tokens is known, and each token explains one blob only. So all blobs are explained
together. Tokens that look alike come in any order.

Legend of this package: P pixels along a side of a picture, K tokens, N blobs. Coverage is (P, P)
float32, about 0 where a picture shows the ground and about 1 where it shows a token.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations

import numpy as np

from tangram_core.arrays import Complex, Floats, Ints, Singles
from tangram_sim.geometry.layout import Layout
from tangram_sim.sight.perception import Look
from tangram_sim.targets.connected import MAX_PILE
from tangram_vision.pictures.blobs import Blobs, find_blobs, likeness
from tangram_vision.pictures.edges import refined
from tangram_vision.pictures.kinds import Kind, kinds_of
from tangram_vision.pictures.piles import Laid, arrangements, reaching_out

_SMALLEST = 0.4  # of the smallest token's area: a smaller blob is dirt
_CLOSE = 0.15  # kinds so close to the nearest one by moments are compared by their edges
_ROUGH = 0.7  # pixels of a token's edge error, at most, as root mean square
_AREA = 0.35  # error of an area over its perimeter, in pixels
_DIFFERS = 0.08  # share of a pile that may differ from its explanation
_ALIKE = 0.01  # explanations whose shares differ by less are equally good
_TRIES = 8  # piles that are searched for one picture


@dataclass(frozen=True, eq=False)
class _Explained:
    """An explanation of one blob.

    Attributes:
        laid: tokens of the blob.
        doubtful: whether another arrangement explains the blob as well.
    """

    laid: Laid
    doubtful: bool = False


def see(cover: Singles, layout: Layout, arena: float) -> Look:
    """Find the tokens of a layout in a picture of the arena.

    Args:
        cover: (P, P) share of each pixel that tokens cover. Nothing else of a token's size may
            be in the picture.
        layout: the tokens.
        arena: width of the picture, in units of the layout.
    """
    pixels = len(cover)
    kinds = kinds_of(layout, arena, pixels)
    poses, flipped = np.zeros((layout.tokens, 3)), np.zeros(layout.tokens, np.bool_)
    known, sure = np.zeros_like(flipped), np.zeros_like(flipped)
    left = {kind.shape: list(kind.tokens) for kind in kinds}
    counts = Counter({shape: len(tokens) for shape, tokens in left.items()})
    blobs = find_blobs(cover, _SMALLEST * min(kind.area for kind in kinds))
    for one in _Puzzle(blobs, kinds, counts).explained():
        for number, pose in zip(one.laid.kinds, one.laid.poses, strict=True):
            token = left[kinds[number].shape].pop(0)
            poses[token], flipped[token] = pose, kinds[number].flipped
            known[token], sure[token] = True, not one.doubtful
    unit = arena / pixels
    poses[known, :2] = (poses[known, :2] + (-pixels / 2.0, pixels / 2.0)) * unit
    poses[:, 2] = np.angle(np.exp(1j * poses[:, 2]))
    return Look(poses, flipped, known, sure)


@dataclass
class _Puzzle:
    """The blobs of a picture, to be explained together."""

    blobs: Blobs
    kinds: Sequence[Kind]
    left: Counter[int]
    _known: dict[tuple[int, tuple[int, ...]], list[_Explained]] = field(default_factory=dict)
    _tries: int = 0

    @cached_property
    def _sizes(self) -> dict[int, tuple[float, float]]:
        """Area and perimeter of each shape."""
        return {kind.shape: (kind.area, kind.perimeter) for kind in self.kinds}

    def explained(self) -> list[_Explained]:
        """Explanations of as many blobs as the available tokens allow."""
        if not len(self.blobs):
            return []
        singles, left = self._singles, self.left
        # Blobs that look like one token come first, as they need no search.
        alone = Counter(self.kinds[one.laid.kinds[0]].shape for one in singles.values())
        if len(singles) == len(self.blobs) and alone <= left:
            return [singles[blob] for blob in sorted(singles, reverse=True)]
        cut = self.blobs.cut.tolist()
        shown = [blob for blob in range(len(cut)) if not cut[blob] or self._piles(blob, left)]
        order = sorted(shown, key=lambda blob: (blob not in singles, -blob))
        best: list[_Explained] = []
        for whole in (True, False):
            every = []
            for found in self._whole(order, singles, left, [], whole):
                every.append(found)
                piles = any(len(one.laid.kinds) > 1 for one in found)
                if self._tries >= _TRIES or (len(found) == len(order) and not (whole and piles)):
                    break
            best = max(every, key=_rank, default=best)
            if len(best) == len(order):
                return _doubted(best, every)
            self._tries = 0
        return best

    def _whole(
        self,
        order: Sequence[int],
        singles: dict[int, _Explained],
        left: Counter[int],
        found: list[_Explained],
        whole: bool,
    ) -> Iterator[list[_Explained]]:
        """Yield explanations of the blobs in `order`; with `whole`, only those of every blob."""
        if not order:
            yield found
            return
        blob, rest = order[0], order[1:]
        for one in self._options(blob, singles, left):
            used = Counter(self.kinds[number].shape for number in one.laid.kinds)
            if not whole or self._enough(rest, left - used):
                yield from self._whole(rest, singles, left - used, [*found, one], whole)
        if not whole:
            # Leave this blob unexplained.
            yield from self._whole(rest, singles, left, found, whole)

    def _enough(self, order: Sequence[int], left: Counter[int]) -> bool:
        """Whether the tokens that are left can make up the areas of blobs."""
        if not order:
            return True
        blob, rest = order[0], order[1:]
        area = float(self.blobs.area[blob])
        return any(
            self._enough(rest, left - Counter(some))
            for count in range(1, MAX_PILE + 1)
            for some in set(combinations(sorted(left.elements()), count))
            if self.blobs.cut[blob] or self._area_off(area, some) < 1.0
        )

    def _area_off(self, area: float, shapes: Sequence[int]) -> float:
        """Difference between an area and that of these shapes, over the tolerance."""
        own = [self._sizes[shape] for shape in shapes]
        return abs(area - sum(size for size, _ in own)) / (_AREA * sum(round_ for _, round_ in own))

    def _options(
        self, blob: int, singles: dict[int, _Explained], left: Counter[int]
    ) -> Iterator[_Explained]:
        """Yield explanations of a blob with the tokens that are left, the simplest first."""
        single = singles.get(blob)
        if single is not None and left[self.kinds[single.laid.kinds[0]].shape]:
            yield single
        if left.total() > 1 or self.blobs.cut[blob]:
            yield from self._piles(blob, left)

    def _piles(self, blob: int, left: Counter[int]) -> list[_Explained]:
        """The best arrangement of a pile for each set of tokens that explains it."""
        counts = tuple(left[shape] for shape in range(1 + max(k.shape for k in self.kinds)))
        key = (blob, counts)
        if key in self._known or self._tries >= _TRIES:
            return self._known.get(key, [])
        side = self.blobs.cover.shape[1]
        cover = self.blobs.cover[self.blobs.base[blob] :][:side]
        self._tries += 1
        search = reaching_out if self.blobs.cut[blob] else arrangements
        found = [one for one in search(cover, self.kinds, counts) if one.differs < _DIFFERS]
        sets: dict[tuple[int, ...], list[Laid]] = {}
        for one in found:
            sets.setdefault(tuple(sorted(self.kinds[k].shape for k in one.kinds)), []).append(one)
        options = [
            _Explained(
                best[0],
                len(best) > 1 and best[1].differs < best[0].differs + _ALIKE,
            )
            for best in sets.values()
        ]
        self._known[key] = options
        return options

    @cached_property
    def _singles(self) -> dict[int, _Explained]:
        """The blobs that look like one token."""
        blobs, kinds = self.blobs, self.kinds
        far, turn = likeness(blobs.moments, kinds)
        area = np.array([kind.area for kind in kinds])
        slack = _AREA * np.array([kind.perimeter for kind in kinds])
        fits = (np.abs(blobs.area[:, None] - area) < slack) & ~blobs.cut[:, None]
        far = np.where(fits, far, np.inf)
        near = far < np.minimum(far.min(axis=1, keepdims=True) + _CLOSE, 1.0)
        blob, kind = np.nonzero(near)
        if not len(blob):
            return {}
        rough = np.column_stack([_plane(blobs.centre[blob]), turn[blob, kind]])
        shapes = [kinds[k] for k in kind.tolist()]
        poses, spread = refined(shapes, rough, blobs.cover, blobs.base[blob])
        best = _least(blob, spread)
        best = best[spread[best] < _ROUGH]
        return {
            int(blob[row]): _Explained(Laid((int(kind[row]),), poses[row : row + 1], 0.0))
            for row in best.tolist()
        }


def _doubted(best: Sequence[_Explained], every: Sequence[Sequence[_Explained]]) -> list[_Explained]:
    """The best explanations; a blob is doubtful if an equally good one has other tokens there."""
    told = list(best)
    for other in every:
        if _rank(other) > (len(best), _rank(best)[1] - _ALIKE):
            for i, (one, that) in enumerate(zip(best, other, strict=True)):
                if sorted(one.laid.kinds) != sorted(that.laid.kinds):
                    told[i] = replace(told[i], doubtful=True)
    return told


def _rank(found: Sequence[_Explained]) -> tuple[int, float]:
    """A key for sorting: more explained blobs are better, then a smaller difference."""
    return len(found), -max((one.laid.differs for one in found), default=0.0)


def _plane(z: Complex) -> Floats:
    return np.column_stack([z.real, z.imag])


def _least(group: Ints, value: Floats) -> Ints:
    """The row of the least value in each group."""
    order = np.lexsort((value, group))
    return order[np.unique(group[order], return_index=True)[1]]
