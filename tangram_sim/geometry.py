"""Exact overlap area of convex polygons and of unions of tokens, vectorised over a batch.

Clipping is Sutherland-Hodgman with padded outputs. It is continuous in its input, so pieces that
touch or coincide cost nothing but rounding; a library's general intersection may return a whole
piece for two that only touch.
"""

import numpy as np

from tangram_sim.arrays import Bools, Floats
from tangram_sim.layout import Layout


def area(polygons: Floats) -> Floats:
    """Signed areas (B,) of polygons (B, M, 2); repeated corners do no harm."""
    ahead = np.roll(polygons, -1, axis=1)
    cross = polygons[..., 0] * ahead[..., 1] - ahead[..., 0] * polygons[..., 1]
    total: Floats = cross.sum(axis=1) / 2.0
    return total


def clip(polygons: Floats, clipper: Floats) -> Floats:
    """Intersection of convex polygons (B, M, 2) with convex counter-clockwise ones (B, C, 2).

    Returns:
        (B, M', 2): corners of the intersection, padded by repeating its first corner to the
        longest of the batch; all corners are zero where the intersection is empty.
    """
    result = polygons
    for c in range(clipper.shape[1]):
        start = clipper[:, c]
        result = _clip_half_plane(result, start, clipper[:, (c + 1) % clipper.shape[1]] - start)
    return result


def _clip_half_plane(polygons: Floats, point: Floats, direction: Floats) -> Floats:
    """Keep what lies left of a line: (B, M, 2) -> (B, M', 2)."""
    offset: Floats = polygons - point[:, None]
    side: Floats = direction[:, None, 0] * offset[..., 1] - direction[:, None, 1] * offset[..., 0]
    next_side = np.roll(side, -1, axis=1)
    inside = side >= 0.0
    crosses = inside != (next_side >= 0.0)
    span = np.where(crosses, side - next_side, 1.0)
    ahead = np.roll(polygons, -1, axis=1)
    crossing = polygons + (side / span)[..., None] * (ahead - polygons)
    return _compact(polygons, inside, crossing, crosses)


def _compact(polygons: Floats, inside: Bools, crossing: Floats, crosses: Bools) -> Floats:
    """Interleave kept corners and crossings, drop the rest, pad with the first one left."""
    size, m = inside.shape
    points = np.stack([polygons, crossing], axis=2).reshape(size, 2 * m, 2)
    keep: Bools = np.stack([inside, crosses], axis=2).reshape(size, 2 * m)
    slot = np.cumsum(keep, axis=1) - 1
    first = points[np.arange(size), np.argmax(keep, axis=1)] * keep.any(axis=1, keepdims=True)
    # Mostly at most m + 1; corners on the line may alternate sides by rounding, then more.
    width = max(int(slot[:, -1].max(initial=0)) + 1, 1)
    packed = np.repeat(first[:, None], width, axis=1)
    row, column = np.nonzero(keep)
    packed[row, slot[row, column]] = points[row, column]
    return packed


def overlap_area(tokens: Floats, targets: Floats, layout: Layout) -> Floats:
    """Area (B,) of (union of tokens) intersected with (union of targets).

    Args:
        tokens: (B, V, 2) corners of the tokens; tokens may overlap each other.
        targets: (B, V, 2) corners of the targets, which do not overlap each other.
        layout: which corners belong to which token.
    """
    total = np.zeros(len(tokens))
    for j in range(layout.tokens):
        target = targets[:, layout.corners_of(j)]
        total += _covered(target, tokens, layout)
    return total


def _covered(piece: Floats, tokens: Floats, layout: Layout, first: int = 0) -> Floats:
    """Area (B,) of each convex piece that at least one token k >= first covers.

    Inclusion-exclusion as a recursion: |P n (T_k u rest)| = |P n T_k| + |P n rest| minus what of
    P n T_k the rest covers. Only the rows of the batch where both can meet are followed.
    """
    total = np.zeros(len(piece))
    for k in range(first, layout.tokens):
        token = tokens[:, layout.corners_of(k)]
        rows = np.flatnonzero(_boxes_meet(piece, token))
        if not len(rows):
            continue
        common = clip(piece[rows], token[rows])
        size = area(common)
        total[rows] += size
        hit = size > 0.0
        if k + 1 < layout.tokens and hit.any():
            deeper = rows[hit]
            total[deeper] -= _covered(common[hit], tokens[deeper], layout, k + 1)
    return total


def _boxes_meet(first: Floats, second: Floats) -> Bools:
    """(B,), whether the bounding boxes of polygons (B, M, 2) and (B, C, 2) overlap."""
    below = first.min(axis=1) < second.max(axis=1)
    above = second.min(axis=1) < first.max(axis=1)
    meet: Bools = (below & above).all(axis=-1)
    return meet


def overlap_share(tokens: Floats, targets: Floats, layout: Layout) -> Floats:
    """Raw overlap in [0, 1], (B,): the covered share of the target's area."""
    whole = sum(shape.area for shape in layout.shapes)
    share: Floats = np.clip(overlap_area(tokens, targets, layout) / whole, 0.0, 1.0)
    return share


def pairs_overlap(first: Floats, second: Floats, tolerance: float = 1e-9) -> Bools:
    """(B,), whether polygons (B, M, 2) and (B, C, 2) overlap by more than `tolerance` in area."""
    found: Bools = _boxes_meet(first, second)
    # Most pairs are too far apart to meet: only the rest is worth clipping.
    rows = np.flatnonzero(found)
    if len(rows):
        found[rows] = area(clip(first[rows], second[rows])) > tolerance
    return found


def any_overlap(corners: Floats, layout: Layout, tolerance: float = 1e-9) -> Bools:
    """Whether any two tokens of a layout overlap by more than `tolerance` in area: (B,)."""
    found = np.zeros(len(corners), dtype=np.bool_)
    for i in range(layout.tokens):
        for j in range(i + 1, layout.tokens):
            first, second = corners[:, layout.corners_of(i)], corners[:, layout.corners_of(j)]
            found |= pairs_overlap(first, second, tolerance)
    return found
