"""A photograph of tokens at an unknown scale -> where each of them lies.

The tokens are known, and all of them are in the picture: so the area that they cover tells the
scale. Light may fall off smoothly towards any side, tokens may be darker than the ground or
lighter, each by another amount; weak shadows are taken away.

Legend: H x W pixels of the photograph, P along a side of what is looked at, K tokens.
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

# Along a side, at most, in which tokens are searched: the fewer, the less a skew matters.
_PIXELS = (256, 128, 80)
_SMALL = 6.0  # pixels: the root of the smallest token's area that is enough
_SPOTS = 200  # areas that are looked at
_DIRT = 0.4  # of the smallest token's share of all
_MARGIN = 8  # pixels around the tokens
_AROUND = 3  # pixels around one area
_MANY = 40  # areas whose shapes are told
_SIZE = 1.6  # times that an area may be larger or smaller than the token that it looks like
_LIKE = 0.25  # moments nearer than this make an area look like a token
_CONTRAST = 40  # levels between ground and tokens; less is taken for noise, and
_CLEAN = 12  # is enough where the ground has none
_POINTS = 100  # of the light along a side
_BORDER = 5  # points of the light from each side that show the ground
_ROUNDS = 24
_STEEP = 3.0  # how much steeper edges are made: less than a third is a shadow
_NOTHING = "no token alone"


class LackingError(ConfigError):
    """Not all tokens were found, or they are too small.

    Attributes:
        areas: that were seen apart.
    """

    def __init__(self, told: str, areas: int) -> None:
        super().__init__(told)
        self.areas = areas


@dataclass(frozen=True, eq=False)
class Found:
    """Tokens in a photograph.

    Attributes:
        poses: (K, 3) x and y in arena units from the photograph's upper left corner, y up, and
            angle.
        flipped: (K,) which lie on their other side.
        unit: pixels of an arena unit.
    """

    poses: Floats
    flipped: Bools
    unit: float


def find_tokens(picture: Image.Image, layout: Layout, source: str) -> Found:
    """Where a photograph shows each of a layout's tokens.

    Args:
        picture: the photograph.
        layout: its tokens.
        source: what errors call the photograph.

    Raises:
        ConfigError: says what was found instead.
    """
    cover = _coverage(picture)
    spots = _spots(cover, layout, source)
    unit = float(np.sqrt(spots.cover.sum() / layout.areas.sum()))
    smallest = float(np.sqrt(layout.areas.min()) * unit)
    if smallest < _SMALL:
        raise LackingError(
            f"{source} shows tokens too small: the smallest is about {smallest:.1f} pixels wide, "
            f"and {_SMALL:g} are needed: take it from nearer, or larger",
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
    """What a photograph shows of a silhouette.

    Attributes:
        cover: (P, P) coverage by it, of a square around it, as from straight above.
        back: homography (3, 3) of the square's points, 0 to 1 to the right and down, to columns and
            rows of the photograph.
    """

    cover: Singles
    back: Floats


def find_silhouette(picture: Image.Image, layout: Layout, source: str) -> Shade:
    """The silhouette that a photograph shows, of one part or of several.

    Args:
        picture: the photograph.
        layout: the tokens that are to fill it.
        source: what errors call the photograph.

    Raises:
        ConfigError: it shows none.
    """
    cover = _coverage(picture)
    spots = _spots(cover, layout, source)
    if spots.lacks:
        raise ConfigError(
            f"{source} is cut off: a part of it reaches the picture's edge, leave ground around it"
        )
    part, corner = spots.cut_out()
    above, back = from_above(part)
    size = np.diag([len(above), len(above), 1.0])
    return Shade(_smaller(above, _PIXELS[0]), shift(*corner) @ back @ size)


def _spots(cover: Singles, layout: Layout, source: str) -> "_Spots":
    """The areas of a photograph that may be tokens, or parts of a silhouette."""
    spots = _Spots.of(cover, float(layout.areas.min() / layout.areas.sum()))
    if not len(spots.boxes):
        at_edge = f" but what reaches its edge ({spots.cut})" if spots.cut else ""
        raise ConfigError(
            f"{source} shows nothing{at_edge} that is darker or lighter than its ground by "
            f"{_CLEAN} of 255 levels, {_CONTRAST} where that is uneven: take it with dark "
            "tokens on light ground, or light ones on dark, and with ground all around"
        )
    return spots


def _seen(cover: Singles, layout: Layout, view: float) -> Look | None:
    """All tokens of a layout in a square of coverage that is so wide; None if some are missing."""
    for pixels in _PIXELS:
        seen = see(_smaller(cover, pixels), layout, view)
        if seen.known.all():
            return seen
    return None


def _smaller(cover: Singles, pixels: int) -> Singles:
    """The same with at most so many pixels along a side."""
    side = min(pixels, len(cover))
    return np.asarray(cv2.resize(cover, (side, side), interpolation=cv2.INTER_AREA), np.float32)


def _told(cover: Singles, spots: "_Spots", layout: Layout, view: float) -> str:
    """What was found where that is not what was looked for, and what to do."""
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
    """What each area looks like, whether or not it is as large."""
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


# What is covered


def _coverage(picture: Image.Image) -> Singles:
    """(H, W) about 0 on the ground, and about 1 on tokens, each by its own level."""
    grey, *colours = (_smooth(one) for one in (picture.convert("L"), *picture.split()))
    light, noise = _light(grey)
    contrast = _CONTRAST if noise > 1.0 else _CLEAN
    least = max(contrast / 2.0, 4.0 * noise)
    differs = light - grey
    dark = np.count_nonzero(differs < -least) > np.count_nonzero(differs > least)  # a dark ground
    sign = np.float32(-1.0 if dark else 1.0)
    differs *= sign
    cover = np.zeros_like(differs)
    # In a drawing yellow on white differs in blue alone, and a shadow has no colour.
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
    """(H, W) levels of a lit ground, and the deviation from it.

    A curved surface from which most of the picture's border is not far, and then all that it meets
    within: a figure may cover most of the picture.
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
        cover: (H, W) coverage by them alone.
        boxes: (N, 4) left, top, right and bottom of each.
        cut: areas that reach the photograph's edge, and were left out.
        lacks: whether one of these is as large as what counts.
    """

    cover: Singles
    boxes: Ints
    cut: int
    lacks: bool

    @staticmethod
    def of(cover: Singles, smallest: float) -> "_Spots":
        """Those of coverage (H, W), the smallest token being such a share of all."""
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
