"""How near seven tans come to drawings that they do not fill, beside the library's best figure."""

from collections.abc import Callable, Mapping
from itertools import product
from pathlib import Path
from types import MappingProxyType

import numpy as np
import shapely
from scipy.optimize import minimize
from shapely import Polygon

from tangram_lab.benchmarks.measure import show, write
from tangram_lab.benchmarks.seeing import SCALE, SEVEN
from tangram_sim.areas import Area, overlap, valid
from tangram_sim.assembly import Puzzle
from tangram_sim.dissections import Dissection
from tangram_sim.layout import TokensConfig, make_layout
from tangram_sim.puzzles import library
from tangram_sim.targets import placement
from tangram_vision.approximations import nearest_figure
from tangram_vision.silhouettes import silhouette

SECONDS = 2.5  # as the studio has
SPLITS = ("train", "test")
WOBBLES = (0.01, 0.02, 0.03)  # of the root of a drawing's area
POINTS = 50  # of a wobbly outline
TURNS = 48  # at which figures of the library are tried
REFINED = 5  # of them are fitted
LAYOUT = make_layout(TokensConfig(SEVEN, SCALE))

Corners = tuple[tuple[float, float], ...]
# What people draw first; the outlines are this project's own.
DRAWN: Mapping[str, Corners] = MappingProxyType(
    {
        "house": ((0, 0), (6, 0), (6, 4), (7, 4), (3, 8), (-1, 4), (0, 4)),
        "cat": (
            *((0, 0), (5, 0), (6, 3), (8, 3), (8, 2), (9, 2), (9, 4), (6, 4), (5, 5)),
            *((5, 8), (4, 7), (2, 7), (1, 8), (1, 5)),
        ),
        "fish": ((0, 2), (3, 4), (6, 3), (8, 5), (8, -1), (6, 1), (3, 0)),
        "boat": ((0, 2), (4, 2), (4, 8), (8, 3), (5, 3), (5, 2), (9, 2), (7, 0), (2, 0)),
        "tree": (
            *((3, 0), (4, 0), (4, 2), (7, 2), (5, 4), (6, 4), (3.5, 8)),
            *((1, 4), (2, 4), (0, 2), (3, 2)),
        ),
        "arrow": ((0, 2), (6, 2), (6, 0), (10, 3), (6, 6), (6, 4), (0, 4)),
        "star": tuple(
            (float((2 - n % 2) * np.cos(n * np.pi / 5)), float((2 - n % 2) * np.sin(n * np.pi / 5)))
            for n in range(10)
        ),
        "egg": tuple(
            (float(1.4 * np.cos(a) + 0.1 * np.cos(2 * a)), float(np.sin(a)))
            for a in np.linspace(0, 2 * np.pi, 60, endpoint=False)
        ),
    }
)


def run_nearest(scenes: int, seed: int, out: Path | None) -> int:
    """Measure and print; the exit status is 0.

    Args:
        scenes: figures of the library, at most.
        seed: of how their outlines wobble.
        out: JSON file of the results.
    """
    known = [_outline(puzzle) for split in SPLITS for puzzle in library(split)]
    whole = [one for one in known if isinstance(one, Polygon) and not one.interiors]
    chosen = whole[:: max(len(whole) // scenes, 1)][:scenes]
    rng = np.random.default_rng(seed)
    rows = [
        _row(f"{len(chosen)} of the library, by {share:.0%}", drawings, known)
        for share in WOBBLES
        for drawings in [[_wobbly(one, share, rng) for one in chosen]]
    ]
    hand = [_sized(Polygon(corners)) for corners in DRAWN.values()]
    rows.append(_row(f"{len(hand)} by hand", hand, known))
    show("IoU of drawings with figures of seven tans", rows)
    write(out, {"settings": {"scenes": scenes, "seed": seed}, "rows": rows})
    return 0


def _row(what: str, drawings: list[Area], figures: list[Area]) -> dict[str, object]:
    """Medians and least tenths of both."""
    known = [best_known(one, figures) for one in drawings]
    found = [nearest_figure(one, LAYOUT, SECONDS)[1] for one in drawings]
    return {
        "drawings": what,
        "best of the library": float(np.median(known)),
        "its least tenth": float(np.quantile(known, 0.1)),
        "nearest figure": float(np.median(found)),
        "least tenth": float(np.quantile(found, 0.1)),
        "better in": sum(one > other for one, other in zip(found, known, strict=True)),
        "count": len(drawings),
    }


def best_known(drawing: Area, figures: list[Area]) -> float:
    """The largest IoU of a drawing with one of some figures, moved, turned and mirrored to fit."""
    starts = [
        (1.0 - overlap(_laid(figure, drawing, (0.0, 0.0, turn), side), drawing), figure, turn, side)
        for figure, side in product(figures, (1.0, -1.0))
        for turn in np.arange(TURNS) * 2.0 * np.pi / TURNS
    ]
    starts.sort(key=lambda one: one[0])
    step = float(np.sqrt(drawing.area)) / 20.0
    corners = np.vstack([np.zeros(3), np.diag([step, step, 0.1])])

    def loss(figure: Area, side: float) -> Callable[[np.ndarray], float]:
        return lambda pose: 1.0 - overlap(_laid(figure, drawing, tuple(pose), side), drawing)

    fitted = (
        minimize(
            loss(figure, side),
            (0.0, 0.0, turn),
            method="Nelder-Mead",
            options={"initial_simplex": corners + (0.0, 0.0, turn), "maxiter": 200},
        ).fun
        for _, figure, turn, side in starts[:REFINED]
    )
    return 1.0 - float(min(fitted))


def _laid(figure: Area, drawing: Area, pose: tuple[float, ...], side: float) -> Area:
    """A figure on a drawing: centre on centre, then moved by a pose."""
    x, y, turn = pose
    own, there = figure.centroid, drawing.centroid
    cos, sin = np.cos(turn), np.sin(turn)

    def moved(points: np.ndarray) -> np.ndarray:
        u, v = (points[:, 0] - own.x) * side, points[:, 1] - own.y
        return np.column_stack([cos * u - sin * v + there.x + x, sin * u + cos * v + there.y + y])

    return shapely.transform(figure, moved)


def _outline(puzzle: Puzzle) -> Area:
    return silhouette(LAYOUT, Dissection(*placement(puzzle, LAYOUT)))


def _wobbly(area: Polygon, share: float, rng: np.random.Generator) -> Area:
    """Drawn by a hand that is off by so much of the root of the area, smoothly."""
    ring = shapely.LineString(area.exterior.coords)
    points = shapely.get_coordinates(ring.interpolate(np.arange(POINTS) / POINTS, normalized=True))
    off = rng.normal(size=points.shape)
    off = sum(np.roll(off, n, axis=0) * np.exp(-(n**2) / 4.5) for n in range(-4, 5))
    return _sized(Polygon(points + off / off.std() * share * np.sqrt(area.area)))


def _sized(area: Area) -> Area:
    """As large as all tokens."""
    whole = valid(area)
    scale = float(np.sqrt(LAYOUT.areas.sum() / whole.area))
    return shapely.transform(whole, lambda points: points * scale)
