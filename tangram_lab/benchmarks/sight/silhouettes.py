"""How many silhouettes are filled, and how fast: of exact outlines and of pictures, one core.

Figures are the library's test split at eight angles, the 13 convex ones, and random gluings; the
search knows none of them. A figure counts as filled where tokens and figure have an IoU of 0.95, on
exact polygons.
"""

import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track
from shapely import Polygon

from tangram_core.arrays import Complex
from tangram_game.figures.methods import together
from tangram_lab.benchmarks.measure import show, write
from tangram_lab.benchmarks.sight.seeing import ARENA, SCALE, SEVEN
from tangram_sim.config import SimConfig
from tangram_sim.geometry.areas import Area, grown, overlap
from tangram_sim.geometry.dissections import Dissection
from tangram_sim.geometry.layout import Layout, TokensConfig, make_layout
from tangram_sim.puzzles.figures import library
from tangram_sim.targets.connected import sample_connected
from tangram_sim.targets.targets import placement, turned_figure
from tangram_sim.world.world import World, make_world
from tangram_vision.pictures.levels import coverage
from tangram_vision.silhouettes.silhouette_pictures import fill_picture
from tangram_vision.silhouettes.silhouettes import SOLVED, Filled, Method, covered, fill_outline

SECONDS = 5.0  # of processor time for each figure
TURNS = 8
CAMERAS = tuple(product((256, 128, 64), ("grey", "binary")))
_SEAM = 2e-3  # arena units: gaps between pieces that are drawn by hand


@dataclass(frozen=True, eq=False)
class Shape:
    """A figure by tokens that make it up."""

    kind: str
    laid: Dissection


def run_silhouettes(scenes: int, seed: int, out: Path | None) -> int:
    """Print the tables; returns the exit status, 0 whatever was found."""
    layout = make_layout(TokensConfig(SEVEN, SCALE))
    figures = list(figures_of(layout, scenes, seed))
    outlined = list(_outlined(layout, figures))
    rows = [row_of("exact outline", layout, figures, outlined)]
    method = together(layout)
    for pixels, picture in CAMERAS:
        title = f"{pixels} px {picture}"
        sim = SimConfig(arena=ARENA, pixels=pixels, picture=picture)
        rows.append(
            row_of(title, layout, figures, list(_pictured(layout, figures, sim, method, title)))
        )
    show("silhouettes filled with seven tans, one core", rows)
    convex = [_convex_row(layout)]
    show("convex figures of the area of seven tans", convex)
    write(out, {"scenes": scenes, "seed": seed, "rows": rows, "convex": convex})
    return 0


def figures_of(layout: Layout, scenes: int, seed: int) -> Iterator[Shape]:
    """The test split at all angles, the 13 convex figures at a random one, and random gluings."""
    generator = np.random.default_rng(seed)
    for puzzle in library("test", SCALE):
        poses, flipped = placement(puzzle, layout)
        for turn in range(TURNS):
            angle = 2.0 * np.pi * (turn + generator.random()) / TURNS
            yield Shape("test", Dissection(turned_figure(layout, (poses, flipped), angle), flipped))
    for z in convex_outlines(float(np.sqrt(layout.areas.sum()))):
        turned = (z - z.mean()) * np.exp(1j * generator.uniform(0.0, 2.0 * np.pi))
        outline = Polygon(np.column_stack([turned.real, turned.imag]))
        (filled,) = fill_outline(outline, layout, 60.0)
        if filled.found is not None:
            yield Shape("convex", filled.found)
    sim = SimConfig(arena=ARENA)
    for number in range(scenes):
        own = np.random.default_rng([seed, number])
        flipped = (own.random(layout.tokens) < 0.5) & layout.chiral
        poses = sample_connected(layout, sim, own)
        sides = np.zeros_like(flipped)
        laid = layout.mirrored(poses, sides) if flipped.any() else (poses, sides)
        yield Shape("gluing", Dissection(*laid))


def convex_outlines(side: float) -> list[Complex]:
    """The 20 convex outlines that 16 equal right triangles with two equal sides can have.

    The seven tans consist of such triangles, and fill 13 of these outlines (Wang and Hsiung, 1942).

    Args:
        side: of a square of the same area.

    Returns:
        Corners (n,) as complex numbers, counter-clockwise.
    """
    found: dict[tuple[tuple[int, int], ...], Complex] = {}
    for width, height in product(range(1, 17), repeat=2):
        # A rectangle without a triangle at each of its corners.
        for a, b, c, d in product(range(min(width, height) + 1), repeat=4):
            fits = a + b <= width and c + d <= width and b + c <= height and a + d <= height
            if not fits or 2 * width * height - a * a - b * b - c * c - d * d != 16:
                continue
            z = np.array(
                [a, width - b, width + 1j * b, width + 1j * (height - c)]
                + [width - c + 1j * height, d + 1j * height, 1j * (height - d), 1j * a]
            )
            z = z[np.abs(z - np.roll(z, 1)) > 0.5]
            ahead, behind = np.roll(z, -1) - z, z - np.roll(z, 1)
            z = z[np.abs((behind.conj() * ahead).imag) > 0.5]
            image = np.conj(z[::-1])
            found.setdefault(min(*_readings(z), *_readings(image)), z * side / np.sqrt(8.0))
    return list(found.values())


def _readings(z: Complex) -> list[tuple[tuple[int, int], ...]]:
    """Squared sides and turns of an outline, begun at each of its corners."""
    ahead = np.roll(z, -1) - z
    turns = np.degrees(np.angle(ahead / np.roll(ahead, 1)))
    sides = [
        (round(float(abs(way) ** 2)), round(float(turn)))
        for way, turn in zip(ahead, turns, strict=True)
    ]
    return [(*sides[i:], *sides[:i]) for i in range(len(sides))]


def _convex_row(layout: Layout) -> dict[str, Any]:
    every = [
        fill_outline(Polygon(np.column_stack([z.real, z.imag])), layout, 60.0)[0]
        for z in convex_outlines(float(np.sqrt(layout.areas.sum())))
    ]
    return {
        "outlines": len(every),
        "filled": sum(one.found is not None for one in every),
        "searched through, none found": sum(one.found is None and one.complete for one in every),
        "s, most": max(one.seconds for one in every),
    }


def area_of(layout: Layout, figure: Shape) -> Area:
    """The outline of a figure without the seams of its pieces."""
    whole = covered(layout, figure.laid)
    if figure.kind != "gluing":  # drawn by hand, or laid with a tolerance
        whole = grown(grown(whole, _SEAM), -_SEAM)
    return whole


def _outlined(layout: Layout, figures: list[Shape]) -> Iterator[Filled]:
    for figure in track(figures, "exact outlines"):
        area, begin = area_of(layout, figure), time.process_time()
        (filled,) = fill_outline(area, layout, SECONDS)
        yield replace(filled, seconds=time.process_time() - begin)


def _pictured(
    layout: Layout, figures: list[Shape], sim: SimConfig, method: Method, title: str
) -> Iterator[Filled]:
    """What the camera shows of figures, filled one after the other."""
    with closing(make_world(layout, sim)) as world:
        for figure in track(figures, title):
            yield _seen(layout, world, figure, method)


def _seen(layout: Layout, world: World, figure: Shape, method: Method) -> Filled:
    world.place(figure.laid.poses, figure.laid.flipped)
    cover = coverage(world.picture())
    assert cover is not None
    begin = time.process_time()
    filled = fill_picture(cover, layout, ARENA, SECONDS, method)
    filled = replace(filled, seconds=time.process_time() - begin)
    if filled.found is None:
        return filled
    middle = np.array([-ARENA / 2.0, ARENA / 2.0, 0.0])
    return replace(filled, found=Dissection(filled.found.poses + middle, filled.found.flipped))


def row_of(what: str, layout: Layout, figures: list[Shape], found: list[Filled]) -> dict[str, Any]:
    """A row of the table."""
    iou = np.array(
        [
            overlap(covered(layout, one.found), covered(layout, figure.laid)) if one.found else 0.0
            for figure, one in zip(figures, found, strict=True)
        ]
    )
    kinds = np.array([figure.kind for figure in figures])
    seconds = np.array([one.seconds for one in found])
    solved = iou >= SOLVED
    return {
        "silhouette": what,
        "figures": len(figures),
        "filled": float(solved.mean()),
        **{
            f"{kind} ({(kinds == kind).sum()})": float(solved[kinds == kind].mean())
            for kind in dict.fromkeys(kinds.tolist())
        },
        "IoU, median": float(np.median(iou)),
        "CPU s, median": float(np.median(seconds)),
        "95th perc.": float(np.percentile(seconds, 95)),
        "99th perc.": float(np.percentile(seconds, 99)),
        "by the beam": float(np.mean([one.by == "beam" for one in found])),
        "steps, median": float(np.median([one.nodes for one in found])),
    }
