"""From a drawn figure to exact tans: pieces are fitted, checked, and pushed apart if they overlap.

Gaps stay as drawn: the drawing does not say which edges should touch.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tangram_core.arrays import Floats
from tangram_core.settings import check_range
from tangram_sim.geometry.fitting import Fit, fit_piece, overlap_depths, separate
from tangram_sim.geometry.layout import Layout, TokensConfig, make_layout
from tangram_sim.geometry.overlap import outlines
from tangram_sim.geometry.shapes import SHAPE_NAMES, tan
from tangram_sim.puzzles.sketches import Sketch

COUNTS = {
    "large_triangle": 2,
    "medium_triangle": 1,
    "small_triangle": 2,
    "square": 1,
    "parallelogram": 1,
}
# Units. Errors of 0.01 in x and y move a corner by up to 0.014, and a fit leaves less.
MAX_RESIDUAL = 0.03
# Units. Both neighbours move by as much, and rotate. The limit is a depth and not an area: for the
# same error of the drawing, an overlap along a whole edge has a larger area than one at a corner.
# A depth of 0.014 along its longest edge is 11 % of a small triangle.
MAX_DEPTH = 0.04
MAX_PUSH = 0.1  # units, by which a piece may be pushed in all


@dataclass(frozen=True)
class PuzzleRules:
    """Rules that a figure must keep, and its scale.

    Attributes:
        scale: side of the full square in arena units, as in the token set.
        subset: whether a figure may have only some of the seven tans.
        max_extent: largest distance between two corners, in units. With the default, a figure of
            scale 0.6 fits into an arena of width 2 at every angle.
    """

    scale: float = 0.6
    subset: bool = False
    max_extent: float = 3.1

    def __post_init__(self) -> None:
        check_range("scale of puzzles", self.scale, 1e-3, 1e3)
        check_range("max_extent of puzzles", self.max_extent, 1.0, 1e3)


@dataclass(frozen=True, eq=False)
class Puzzle:
    """A figure of K tans, with the middle of its bounding box at the origin.

    Attributes:
        name: of the figure.
        pieces: K names of tans, in the order of `SHAPE_NAMES`.
        poses: (K, 3) x, y (arena units) and angle (radians).
        scale: side of the full square, in arena units.
    """

    name: str
    pieces: tuple[str, ...]
    poses: Floats
    scale: float

    @cached_property
    def layout(self) -> Layout:
        """The tans of the figure as a token set."""
        return make_layout(TokensConfig(self.pieces, self.scale))

    @property
    def corners(self) -> Floats:
        """Corners (V, 2) of the tans, in arena units."""
        return self.layout.corners(self.poses)


def build_puzzle(sketch: Sketch, rules: PuzzleRules) -> tuple[Puzzle | None, list[str]]:
    """(figure, []) if a drawing keeps the rules, else (None, its faults)."""
    where = f"puzzle '{sketch.name}'"
    fits = [fit_piece(kind, corners) for kind, corners in sketch.pieces]
    faults = _count_faults(sketch, rules, where) + _fit_faults(sketch, fits, where)
    if faults:
        return None, faults
    layout = make_layout(TokensConfig(tuple(fit.shape for fit in fits), 1.0))
    poses = np.array([fit.pose for fit in fits])
    drawn = outlines(layout.corners(poses)[None], layout)[0]
    faults = _overlap_faults(sketch, drawn, where)
    if faults:
        return None, faults
    shifts = separate(drawn)
    if shifts is None or np.abs(shifts).max() > MAX_PUSH:
        return None, [f"{where}: pieces must be moved by more than {MAX_PUSH:g} units: redraw it"]
    poses[:, :2] += shifts
    return _centred(sketch.name, layout, poses, rules)


def _centred(
    name: str, layout: Layout, poses: Floats, rules: PuzzleRules
) -> tuple[Puzzle | None, list[str]]:
    corners = layout.corners(poses)
    extent = float(np.linalg.norm(corners[:, None] - corners, axis=-1).max())
    if extent > rules.max_extent + 1e-9:
        fault = (
            f"is {extent:.4g} units across, at most {rules.max_extent:g} allowed: draw it closer"
        )
        return None, [f"puzzle '{name}': {fault}"]
    poses[:, :2] -= (corners.min(axis=0) + corners.max(axis=0)) / 2.0
    # Pieces in the order of a token set, lengths in arena units.
    names = [shape.name for shape in layout.shapes]
    order = sorted(range(len(names)), key=lambda k: SHAPE_NAMES.index(names[k]))
    poses = poses[order] * (rules.scale, rules.scale, 1.0)
    poses.setflags(write=False)  # the cached library shares them
    return Puzzle(name, tuple(names[k] for k in order), poses, rules.scale), []


def _count_faults(sketch: Sketch, rules: PuzzleRules, where: str) -> list[str]:
    counts = Counter(kind for kind, _ in sketch.pieces)
    wrong = [
        f"{counts[kind]} {kind} (must be {'at most ' if rules.subset else ''}{count})"
        for kind, count in COUNTS.items()
        if counts[kind] > count or (counts[kind] < count and not rules.subset)
    ]
    remedy = "draw some of the seven tans" if rules.subset else "draw each of the seven tans"
    return [f"{where}: has {', '.join(wrong)}: {remedy}"] if wrong else []


def _fit_faults(sketch: Sketch, fits: Sequence[Fit], where: str) -> list[str]:
    return [
        f"{where}, piece {k + 1} ({kind}): a corner is {fit.residual:.3g} units off the exact "
        f"shape, at most {MAX_RESIDUAL:g} allowed: it is {_size(kind, corners):.3g} times as large "
        "as it should be; draw the full square with side 1"
        for k, ((kind, corners), fit) in enumerate(zip(sketch.pieces, fits, strict=True))
        if not fit.residual <= MAX_RESIDUAL
    ]


def _size(kind: str, corners: Floats) -> float:
    """Summed distance of the corners from their mean, divided by that of the exact tan."""
    spread = np.linalg.norm(corners - corners.mean(axis=0), axis=1).sum()
    return float(spread / np.linalg.norm(tan(kind).corners, axis=1).sum())


def _overlap_faults(sketch: Sketch, drawn: Floats, where: str) -> list[str]:
    depth, _ = overlap_depths(drawn)
    kinds = [kind for kind, _ in sketch.pieces]
    return [
        f"{where}, piece {i + 1} ({kinds[i]}): lies {depth[i, j]:.3g} units deep in piece {j + 1} "
        f"({kinds[j]}), at most {MAX_DEPTH:g} allowed: move them apart"
        for i, j in np.argwhere(np.triu(depth > MAX_DEPTH, 1))
    ]
