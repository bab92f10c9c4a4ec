"""Find tokens, or a silhouette, in a photograph of unknown scale.

All tokens are known and are in the picture, so the area that they cover gives the scale. Light may
fall off smoothly towards any side. Tokens may be darker or lighter than the ground, each by a
different amount. Weak shadows are removed.

Legend: H x W pixels of the photograph, P along a side of the part that is searched, K tokens.
"""

from collections import Counter
from dataclasses import dataclass

import cv2
import numpy as np
from PIL import Image

from tangram_core.arrays import Bools, Floats, Ints, Singles
from tangram_core.errors import ConfigError
from tangram_sim.geometry.layout import Layout
from tangram_sim.sight.perception import Look
from tangram_sim.targets.connected import MAX_PILE
from tangram_vision.pictures.blobs import find_blobs, likeness
from tangram_vision.pictures.kinds import kinds_of
from tangram_vision.pictures.seeing import see
from tangram_vision.silhouettes.tilts import from_above, shift

# Pixels along a side of the searched part, tried in turn: with fewer pixels a skew matters less.
_PIXELS = (256, 128, 80)
_SMALL = 6.0  # pixels: the root of the smallest token's area, at least
_SPOTS = 200  # areas that are examined, at most
_DIRT = 0.4  # of the smallest token's area: a smaller area is dirt
_MARGIN = 8  # pixels around the tokens
_AROUND = 3  # pixels around one area
_MANY = 40  # areas whose shapes an error lists, at most
_SIZE = 1.6  # an area may be this many times larger or smaller than the token that it looks like
_LIKE = 0.25  # distance of moments within which an area looks like a token
_CONTRAST = 40  # levels between ground and tokens, at least, on uneven ground
_CLEAN = 12  # the same on even ground
_POINTS = 100  # samples of the light along a side
_BORDER = 5  # samples at each side that show the ground
_ROUNDS = 24
_STEEP = 3.0  # factor that makes edges steeper: less than a third of a token's level is a shadow
_NOTHING = "no token alone"


class LackingError(ConfigError):
    """Tokens are missing in a photograph, or too small.

    Attributes:
        areas: number of separate areas that were found.
    """

    def __init__(self, told: str, areas: int) -> None:
        super().__init__(told)
        self.areas = areas


@dataclass(frozen=True, eq=False)
class Found:
    """Poses of tokens in a photograph.

    Attributes:
        poses: (K, 3) x and y in arena units from the photograph's upper left corner, y up, and
            angle.
        flipped: (K,) whether a token is turned over.
        unit: pixels in an arena unit.
    """

    poses: Floats
    flipped: Bools
    unit: float


def find_tokens(picture: Image.Image, layout: Layout, source: str) -> Found:
    """Find the pose of each token in a photograph.

    Args:
        picture: the photograph.
        layout: the tokens.
        source: name of the photograph in errors.

    Raises:
        ConfigError: tokens are missing or too small; says what was found instead.
    """
    cover = _coverage(picture)
    spots = _spots(cover, layout, source)
    unit = float(np.sqrt(spots.cover.sum() / layout.areas.sum()))
    smallest = float(np.sqrt(layout.areas.min()) * unit)
    if smallest < _SMALL:
        raise LackingError(
            f"the tokens in {source} are too small: the smallest is about {smallest:.1f} pixels "
            f"wide, and {_SMALL:g} are needed: take it from nearer, or with more pixels",
            len(spots.boxes),
        )
    part, corner = spots.cut_out()
    view = len(part) / unit
    seen = None if len(spots.boxes) > layout.tokens else _seen(part, layout, view)
    if seen is None:
        told = _told(_smaller(part, _PIXELS[-1]), spots, layout, view)
        raise LackingError(f"{source} {told}", len(spots.boxes))
    middle = np.array([corner[0] + len(part) / 2.0, -corner[1] - len(part) / 2.0]) / unit
    return Found(seen.poses + (*middle, 0.0), seen.flipped, unit)


@dataclass(frozen=True, eq=False)
class Shade:
    """A silhouette in a photograph.

    Attributes:
        cover: (P, P) coverage by the silhouette in a square around it, as from straight above.
        back: homography (3, 3) from points of that square, 0 to 1 to the right and down, to columns
            and rows of the photograph.
    """

    cover: Singles
    back: Floats


def find_silhouette(picture: Image.Image, layout: Layout, source: str) -> Shade:
    """Find the silhouette in a photograph; it may have several parts.

    Args:
        picture: the photograph.
        layout: the tokens that will fill the silhouette.
        source: name of the photograph in errors.

    Raises:
        ConfigError: the photograph shows no silhouette, or cuts it off.
    """
    cover = _coverage(picture)
    spots = _spots(cover, layout, source)
    if spots.lacks:
        raise ConfigError(
            f"{source} is cut off by the picture's edge: leave ground around the silhouette"
        )
    part, corner = spots.cut_out()
    above, back = from_above(part)
    size = np.diag([len(above), len(above), 1.0])
    return Shade(_smaller(above, _PIXELS[0]), shift(*corner) @ back @ size)


def _spots(cover: Singles, layout: Layout, source: str) -> "_Spots":
    """The areas of a photograph that may be tokens, or parts of a silhouette."""
    spots = _Spots.of(cover, float(layout.areas.min() / layout.areas.sum()))
    if not len(spots.boxes):
        at_edge = f" except areas at its edge ({spots.cut})" if spots.cut else ""
        raise ConfigError(
            f"{source} shows nothing{at_edge} that is darker or lighter than its ground by "
            f"{_CLEAN} of 255 levels ({_CONTRAST} on uneven ground): take it with dark "
            "tokens on light ground, or light ones on dark, and with ground all around"
        )
    return spots


def _seen(cover: Singles, layout: Layout, view: float) -> Look | None:
    """All tokens in a square of coverage of width `view`; None if some are missing."""
    for pixels in _PIXELS:
        seen = see(_smaller(cover, pixels), layout, view)
        if seen.known.all():
            return seen
    return None


def _smaller(cover: Singles, pixels: int) -> Singles:
    """The coverage with at most so many pixels along a side."""
    side = min(pixels, len(cover))
    return np.asarray(cv2.resize(cover, (side, side), interpolation=cv2.INTER_AREA), np.float32)


def _told(cover: Singles, spots: "_Spots", layout: Layout, view: float) -> str:
    """The error for missing tokens: what was found, and what to do."""
    count = len(spots.boxes)
    edge = f" ({spots.cut} more at its edge left out)" if spots.cut else ""
    areas = "1 area" if count == 1 else f"{count} areas"
    looks, names = _looks(cover, layout, view), [shape.name for shape in layout.shapes]
    found = f"{areas}{edge}, by shape {_listed(looks) or _NOTHING}"
    lacks = _listed(list((Counter(names) - Counter(looks)).elements()))
    return (
        f"shows {found if count <= _MANY else f'more than {_MANY} areas'}, and the run moves "
        f"{_listed(names)}{f' (not found: {lacks})' if lacks and count <= _MANY else ''}: lay them "
        f"all in the picture and nothing else, at most {MAX_PILE} touching, and take it from "
        "straight above"
    )


def _looks(cover: Singles, layout: Layout, view: float) -> list[str]:
    """The shape that each area looks like, also if their sizes differ somewhat."""
    kinds = kinds_of(layout, view, len(cover))
    blobs = find_blobs(cover, _DIRT * min(kind.area for kind in kinds))
    far, _ = likeness(blobs.moments, kinds)
    share = blobs.area[:, None] / np.array([kind.area for kind in kinds])
    far = np.where((share > 1.0 / _SIZE) & (share < _SIZE), far, np.inf)
    return [
        layout.shapes[kinds[int(one.argmin())].tokens[0]].name if one.min() < _LIKE else _NOTHING
        for one in far
    ]


def _listed(names: list[str]) -> str:
    counts = Counter(names).items()
    return ", ".join(f"{count} {name}" if count > 1 else name for name, count in counts)


# Coverage


def _coverage(picture: Image.Image) -> Singles:
    """(H, W) about 0 on the ground and about 1 on tokens, whatever the level of each token."""
    grey, *colours = (_smooth(one) for one in (picture.convert("L"), *picture.split()))
    light, noise = _light(grey)
    contrast = _CONTRAST if noise > 1.0 else _CLEAN
    least = max(contrast / 2.0, 4.0 * noise)
    differs = light - grey
    dark = np.count_nonzero(differs < -least) > np.count_nonzero(differs > least)  # a dark ground
    sign = np.float32(-1.0 if dark else 1.0)
    differs *= sign
    cover = np.zeros_like(differs)
    # In a drawing, yellow on white differs in blue alone. A shadow has no colour.
    if noise <= 1.0 and (np.ptp(colours, axis=0) > contrast).any():
        each = [sign * (_light(colour)[0] - colour) for colour in colours]
        coloured = np.ptp(each, axis=0) > contrast
        differs = np.maximum(differs, np.max(each, axis=0))
        cover = cv2.erode(coloured.astype(np.float32), np.ones((3, 3), np.uint8))
    _, label, stats, _ = cv2.connectedComponentsWithStats((differs > least).astype(np.uint8))
    largest = np.argsort(-stats[1:, cv2.CC_STAT_AREA], kind="stable")[:_SPOTS] + 1
    for spot in largest.tolist():
        own = _window(stats[spot], cover.shape)
        here = label[own] == spot
        level = float(np.percentile(differs[own][here], 75))
        if level >= contrast:
            near = cv2.dilate(here.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
            share = np.clip(0.5 + _STEEP * (differs[own] / level - 0.5), 0.0, 1.0)
            cover[own] = np.maximum(cover[own], np.where(near, share, 0.0))
    return cover


def _smooth(channel: Image.Image) -> Singles:
    return cv2.GaussianBlur(np.asarray(channel), (3, 3), 0).astype(np.float32)


def _light(grey: Singles) -> tuple[Singles, float]:
    """(H, W) levels of the lit ground, and the noise around them.

    A curved surface is fitted to the picture's border, then to all pixels that are near to it.
    So a figure may cover most of the picture.
    """
    step = max(1, max(grey.shape) // _POINTS)
    some = grey[::step, ::step].astype(np.float64)
    design = _surface(*(np.linspace(-1.0, 1.0, side) for side in some.shape))
    border = np.ones(some.shape)
    border[_BORDER:-_BORDER, _BORDER:-_BORDER] = 0.0
    weights, noise = border, 1.0
    for left in reversed(range(_ROUNDS)):
        terms = (design * weights[..., None]).reshape(-1, design.shape[-1])
        surface = np.linalg.lstsq(terms, (some * weights).ravel(), rcond=None)[0]
        far = np.abs(some - design @ surface)
        if left > _ROUNDS // 2:
            weights = border / np.sqrt(np.maximum(far, 1.0))
        else:
            noise = max(1.0, 1.48 * float(np.median(far[far < far.mean() + 1.0])))
            weights = (far < 4.0 * noise).astype(np.float64)
    every = _surface(*(np.linspace(-1.0, 1.0, side) for side in grey.shape))
    return (every @ surface).astype(np.float32), noise


def _surface(y: Floats, x: Floats) -> Floats:
    """(H, W, 6) terms of a polynomial of second degree."""
    x, y = np.broadcast_arrays(x, y[:, None])
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def _window(stats: Ints, shape: tuple[int, ...]) -> tuple[slice, slice]:
    left, top, width, height = (int(stats[i]) for i in range(4))
    rows = slice(max(0, top - _AROUND), min(shape[0], top + height + _AROUND))
    return rows, slice(max(0, left - _AROUND), min(shape[1], left + width + _AROUND))


@dataclass(frozen=True, eq=False)
class _Spots:
    """The areas of a photograph that may be tokens.

    Attributes:
        cover: (H, W) coverage by these areas alone.
        boxes: (N, 4) left, top, right and bottom of each.
        cut: number of areas left out, because they reach the photograph's edge.
        lacks: whether an area that was left out is too large for dirt.
    """

    cover: Singles
    boxes: Ints
    cut: int
    lacks: bool

    @staticmethod
    def of(cover: Singles, smallest: float) -> "_Spots":
        """The areas of coverage (H, W); `smallest` is the smallest token's share of all tokens."""
        height, width = cover.shape
        _, label, stats, _ = cv2.connectedComponentsWithStats((cover > 0.5).astype(np.uint8))
        left, top, wide, high, count = stats.T
        inside = (left > 0) & (top > 0) & (left + wide < width) & (top + high < height)
        inside[0] = False
        largest = count[inside].max(initial=0)
        least = min(_DIRT * smallest * count[inside].sum(), largest / 2.0)
        kept = inside & (count > least)
        at_edge = ~inside[1:] & (count[1:] > count[kept].min(initial=0))
        cut, lacks = int(np.count_nonzero(at_edge)), bool((count[1:][at_edge] > least).any())
        near = cv2.dilate(kept[label].astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        alone = np.where(near, cover, 0.0).astype(np.float32)
        boxes = np.stack([left, top, left + wide, top + high], axis=1)[kept].astype(np.int64)
        return _Spots(alone, boxes, cut, lacks)

    def cut_out(self) -> tuple[Singles, tuple[int, int]]:
        """The square around all areas, and the column and row of its upper left corner."""
        low, high = self.boxes[:, :2].min(axis=0), self.boxes[:, 2:].max(axis=0)
        side = int((high - low).max()) + 2 * _MARGIN
        left, top = ((low + high - side) // 2).tolist()
        room = np.pad(self.cover, side)
        return room[top + side :, left + side :][:side, :side], (left, top)
