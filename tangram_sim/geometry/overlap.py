"""Exact overlap area of convex polygons and of unions of tokens, vectorised over a batch.

Clipping is Sutherland-Hodgman with padded outputs. The result is continuous in the input, so
touching or equal pieces cause rounding errors only. A general library may return a whole piece as
the intersection of two that only touch.
"""

import numpy as np

from tangram_core.arrays import AnyArray, Bools, Complex, Floats, Ints
from tangram_sim.geometry.layout import Layout

# Pairs of pieces processed together: more do not fit into a core's cache.
_MAX_PAIRS = 8192


def area(polygons: Floats) -> Floats:
    """Signed areas (B,) of polygons (B, M, 2); corners may repeat."""
    corners = _complex(polygons)
    total: Floats = (corners.conj() * _ahead(corners)).imag.sum(axis=1) / 2.0
    return total


def clip(polygons: Floats, clipper: Floats) -> Floats:
    """Intersection of convex polygons (B, M, 2) with convex counter-clockwise ones (B, C, 2).

    Both may repeat corners, as padding.

    Returns:
        (B, M', 2): corners of the intersection, padded by repeating its first corner to the
        longest of the batch; all corners are zero where the intersection is empty.
    """
    result, corners = _complex(polygons), _complex(clipper)
    for c in range(corners.shape[1]):
        start = corners[:, c, None]
        result = _clip_half_plane(result, start, corners[:, c - corners.shape[1] + 1, None] - start)
    return np.stack([result.real, result.imag], axis=-1)


def _complex(points: Floats) -> Complex:
    """Points (..., 2) as x + iy (...): a rotation or a cross product is then one call."""
    numbers: Complex = points[..., 0] + 1j * points[..., 1]
    return numbers


def _ahead(row: AnyArray) -> AnyArray:
    """Each row's next element, (B, M)."""
    return np.concatenate([row[:, 1:], row[:, :1]], axis=1)


def _clip_half_plane(polygons: Complex, point: Complex, direction: Complex) -> Complex:
    """Keep what lies left of lines (B, 1): (B, M) -> (B, M')."""
    side: Floats = (direction.conj() * (polygons - point)).imag
    next_side = _ahead(side)
    inside = side >= 0.0
    crosses = inside != (next_side >= 0.0)
    if inside.all():
        return polygons
    share = side / np.where(crosses, side - next_side, 1.0)
    crossing = polygons + share * (_ahead(polygons) - polygons)
    return _compact(polygons, inside, crossing, crosses)


def _compact(polygons: Complex, inside: Bools, crossing: Complex, crosses: Bools) -> Complex:
    """Interleave kept corners and crossings, drop the rest, pad with the first one left."""
    points, keep = _interleaved(polygons, crossing), _interleaved(inside, crosses)
    count = keep.sum(axis=1)
    # Mostly at most m + 1; corners on the line may alternate sides by rounding, then more.
    width = max(int(count.max(initial=0)), 1)
    order = np.argsort(~keep, axis=1, kind="stable")[:, :width]
    order = np.where(np.arange(width) < count[:, None], order, order[:, :1])
    packed: Complex = points[np.arange(len(points))[:, None], order] * (count > 0)[:, None]
    return packed


def _interleaved(first: AnyArray, second: AnyArray) -> AnyArray:
    """Columns of both in turns: (B, M), (B, M) -> (B, 2M)."""
    joined = np.empty((len(first), 2 * first.shape[1]), first.dtype)
    joined[:, ::2], joined[:, 1::2] = first, second
    return joined


def overlap_area(tokens: Floats, targets: Floats, layout: Layout) -> Floats:
    """Area (B,) that the union of tokens shares with the union of targets.

    Computed by inclusion and exclusion: areas of the targets' pieces covered by single tokens,
    minus those covered by pairs of tokens, plus those by triples, and so on. Each round clips all
    pieces of the batch at once, and only pairs whose bounding boxes meet.

    Args:
        tokens: (B, V, 2) corners of the tokens; tokens may overlap each other.
        targets: (B, V, 2) corners of the targets, which do not overlap each other.
        layout: which corners belong to which token.
    """
    rows = max(1, _MAX_PAIRS // layout.tokens**2)
    parts = range(0, len(tokens), rows)
    areas = [_overlap_area(tokens[i : i + rows], targets[i : i + rows], layout) for i in parts]
    return np.concatenate([np.zeros(0), *areas])


def _overlap_area(tokens: Floats, targets: Floats, layout: Layout) -> Floats:
    rows = np.repeat(np.arange(len(tokens)), layout.tokens)
    pieces = outlines(targets, layout).reshape(len(rows), -1, 2)
    return _covered(outlines(tokens, layout), rows, pieces, np.full(len(rows), -1))


def union_area(tokens: Floats, layout: Layout) -> Floats:
    """Area (B,) of the union of tokens with corners (B, V, 2), which may overlap each other."""
    count = layout.tokens
    rows = np.repeat(np.arange(len(tokens)), count)
    own = outlines(tokens, layout)
    # Each token counts without the part that later tokens cover.
    last = np.tile(np.arange(count), len(tokens))
    whole = layout.areas.sum()
    return np.asarray(whole - _covered(own, rows, own.reshape(len(rows), -1, 2), last))


def _covered(own: Floats, rows: Ints, pieces: Floats, last: Ints) -> Floats:
    """(B,) summed area of the parts of pieces (P, M, 2) that tokens (B, K, C, 2) cover.

    `rows` (P,) gives each piece's row of the batch; only tokens after number `last` (P,) count.
    """
    total, sign, count = np.zeros(len(own)), 1.0, own.shape[1]
    for _ in range(count):
        # Every piece with every token after the last one that it was clipped by.
        piece, token = np.nonzero(np.arange(count) > last[:, None])
        meet = _boxes_meet(pieces[piece], own[rows[piece], token])
        piece, token = piece[meet], token[meet]
        if not len(piece):
            break
        common = clip(pieces[piece], own[rows[piece], token])
        size = area(common)
        total += sign * np.bincount(rows[piece], size, minlength=len(own))
        hit = size > 0.0
        rows, pieces, last = rows[piece[hit]], common[hit], token[hit]
        sign = -sign
    return total


def outlines(corners: Floats, layout: Layout) -> Floats:
    """Corners (B, V, 2) grouped by token (B, K, C, 2), padded by repeating a token's last one.

    Outlines are counter-clockwise on both sides of a token.
    """
    padded: Floats = corners[:, layout.padded_corners]
    if layout.any_chiral:
        flipped = layout.flipped(corners)[..., None, None]
        padded = np.where(flipped, padded[:, :, ::-1], padded)
    return padded


def _boxes_meet(first: Floats, second: Floats) -> Bools:
    """(B,) whether the bounding boxes of polygons (B, M, 2) and (B, C, 2) overlap."""
    low, high = _box(first)
    other_low, other_high = _box(second)
    apart = (low >= other_high) | (other_low >= high)
    return ~(apart[:, 0] | apart[:, 1])


def _box(polygons: Floats) -> tuple[Floats, Floats]:
    """Lowest and highest coordinates (B, 2) of polygons (B, M, 2)."""
    # Corner by corner: numpy is several times slower along a short axis in the middle.
    corners = np.ascontiguousarray(polygons.swapaxes(0, 1))
    return corners.min(axis=0), corners.max(axis=0)


def covered_share(tokens: Floats, targets: Floats, layout: Layout) -> Floats:
    """Coverage (B,) in [0, 1]: the covered share of the target's area."""
    whole = layout.areas.sum()
    share: Floats = np.clip(overlap_area(tokens, targets, layout) / whole, 0.0, 1.0)
    return share


def pairs_overlap(first: Floats, second: Floats, tolerance: float = 1e-9) -> Bools:
    """(B,) whether polygons (B, M, 2) and (B, C, 2) overlap by more than `tolerance` in area."""
    return np.asarray(shared_area(first, second) > tolerance)


def shared_area(first: Floats, second: Floats) -> Floats:
    """(B,) area that convex counter-clockwise polygons (B, M, 2) and (B, C, 2) share."""
    shared = np.zeros(len(first))
    # Most pairs are too far apart to meet: clip only the others.
    rows = np.flatnonzero(_boxes_meet(first, second))
    if len(rows):
        shared[rows] = area(clip(first[rows], second[rows]))
    return shared


def shared_areas(first: Floats, second: Floats) -> Floats:
    """(B, K, L) area that each of polygons (B, K, C, 2) shares with each of others (B, L, C, 2).

    All are convex and counter-clockwise, as `outlines` gives them.
    """
    size = (len(first), first.shape[1], second.shape[1], *first.shape[2:])
    one, other = np.broadcast_to(first[:, :, None], size), np.broadcast_to(second[:, None], size)
    flat = (-1, *first.shape[2:])
    return shared_area(one.reshape(flat), other.reshape(flat)).reshape(size[:3])


def outlines_at(body: Floats, poses: Floats, flipped: Bools) -> Floats:
    """Counter-clockwise corners (M, C, 2) of single tokens in poses (M, 3).

    Args:
        body: (C, 2) corners of one token for all poses, or (M, C, 2) of one for each.
        poses: x, y and angle of each.
        flipped: (M,) tokens that are turned over, see `Layout.corners`.
    """
    cos, sin = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x, y = body[..., 0], body[..., 1]
    if flipped.any():
        other_side = flipped[:, None]
        x, y = np.where(other_side, x[..., ::-1], x), np.where(other_side, -y[..., ::-1], y)
    turned = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    moved: Floats = turned + poses[:, None, :2]
    return moved
