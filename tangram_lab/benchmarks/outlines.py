"""How many exact outlines an agent fills by itself, and by a beam; beside it, who learned nothing.

The figures are those of `silhouettes.py`, but for convex ones that agents may have trained on: the
train split draws some of them. All ways lay tokens at the same places: they differ in
which they take. *Largest first* takes the first place, as the search orders them; *by chance*
values places at random. So what stands above them is what was learned.

An agent that learned from pictures fills pictures by its own camera, beside the one that comes with
the package and learned from exact outlines.
"""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import torch
from rich.progress import track
from torch import nn

from tangram_agent.filler import Fillable, Filler
from tangram_agent.filling import UNUSED, Filling
from tangram_agent.runs import Run, load_run
from tangram_agent.setup import Setup
from tangram_agent.values import Corners, taken
from tangram_lab.benchmarks.measure import show, write
from tangram_lab.benchmarks.seeing import SCALE
from tangram_lab.benchmarks.silhouettes import Shape, area_of, figures_of, pictured, row_of
from tangram_sim.areas import Area, overlap
from tangram_sim.arrays import Floats
from tangram_sim.dissections import Dissection, Tokens, dissection
from tangram_sim.errors import ConfigError
from tangram_sim.layout import Layout
from tangram_sim.puzzles import library
from tangram_sim.targets import placement
from tangram_vision.silhouettes import Filled, Method, covered, silhouette
from worker.methods import JUDGE

BEAMS = (1, 4, 12)
_NEAR = 1e-3  # of an arena's half, and radians: two outlines are one


class ByChance(nn.Module):
    """States are worth what chance says."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self._generator = torch.Generator().manual_seed(seed)

    def forward(self, corners: Corners) -> torch.Tensor:
        """(n,) random numbers."""
        return torch.rand(len(corners.points), generator=self._generator)


class Simplest(nn.Module):
    """States are worth the more, the simpler what is left: few corners, or a short outline."""

    def __init__(self, corners: float, length: float) -> None:
        """What a corner costs, and what a length of the root of all tokens' area does."""
        super().__init__()
        self._corners, self._length = corners, length

    def forward(self, corners: Corners) -> torch.Tensor:
        """(n,) minus the costs."""
        sides = (taken(corners.points, corners.follow) - corners.points).norm(dim=-1)
        used = corners.part != UNUSED
        costs: torch.Tensor = used * (self._corners + self._length * sides)
        return -costs.sum(dim=1)


def run_outlines(run_dir: str, scenes: int, seed: int, out: Path | None) -> int:
    """Print the table; returns the exit status, 0 whatever was found.

    Raises:
        ConfigError: a run whose agent fills no outlines.
    """
    run = load_run(run_dir)
    if not run.setup.fills:
        raise ConfigError(f"run_dir={run_dir} fills no outlines: take one of agent=outline")
    torch.set_num_threads(1)
    figures = _never_drawn(run.setup.layout, list(figures_of(run.setup.layout, scenes, seed)))
    rows = list(_seen_rows(run, figures) if run.setup.traces else _rows(run, figures, seed))
    show("silhouettes filled with seven tans, one core", rows)
    write(out, {"run": run_dir, "scenes": scenes, "seed": seed, "rows": rows})
    return 0


def _rows(run: Run, figures: list[Shape], seed: int) -> Iterator[dict[str, Any]]:
    """Exact outlines, by the agent and by who learned nothing."""
    ways: dict[str, nn.Module] = {
        "the agent": run.policy.network,
        "largest first": run.unlearned().policy.network,
        "fewest corners": Simplest(1.0, 0.0),
        "shortest outline": Simplest(0.0, 1.0),
        "by chance": ByChance(seed),
    }
    for name, value in ways.items():
        for beam in BEAMS:
            told = f"{name}, {f'beam of {beam}' if beam > 1 else 'no search'}"
            found = list(_filled(value, run.setup, figures, beam, told))
            yield row_of(told, run.setup.layout, figures, found)


def _seen_rows(run: Run, figures: list[Shape]) -> Iterator[dict[str, Any]]:
    """Pictures by the run's camera, by beams that differ in who judges their states."""
    layout = run.setup.layout
    judges = {
        "the agent": Fillable(run.policy.network, layout),
        "learned from exact outlines": Fillable(load_run(JUDGE).policy.network, layout),
        "largest first": None,
    }
    for name, values in judges.items():
        for beam in (1, BEAMS[-1]):
            told = f"{name}, beam of {beam}"
            method = Method(search=False, width=beam, values=values)
            found = list(pictured(layout, figures, run.setup.sim, method, told))
            yield row_of(told, layout, figures, found)


def _never_drawn(layout: Layout, figures: list[Shape]) -> list[Shape]:
    """All but those whose outline is one of the train split, at any angle or in a mirror."""
    drawn = [Dissection(*placement(puzzle, layout)) for puzzle in library("train", SCALE)]
    known = [_reading(silhouette(layout, laid)) for laid in drawn]
    own = (_reading(silhouette(layout, one.laid)) for one in figures)
    return [
        one
        for one, reading in zip(figures, own, strict=True)
        if not any(_alike(reading, other) for other in known)
    ]


def _reading(area: Area) -> Floats:
    """(n, 2) sides and turns along the largest ring of an outline."""
    part = max(shapely.get_parts(area).tolist(), key=lambda one: one.area)
    z = shapely.get_coordinates(part.exterior)[:-1] @ (1.0, 1.0j)
    side = np.roll(z, -1) - z
    return np.column_stack([np.abs(side), np.angle(side / np.roll(side, 1))])


def _alike(one: Floats, other: Floats) -> bool:
    """Whether two readings are the same but for where they begin, or in a mirror."""
    if len(one) != len(other):
        return False
    # Back along the ring, the turn comes after the side; in a mirror it has the other sign.
    mirrored = np.column_stack([other[::-1, 0], np.roll(other[::-1, 1], 1)])
    return any(
        np.allclose(one, np.roll(reading, i, axis=0), atol=_NEAR)
        for reading in (other, mirrored)
        for i in range(len(one))
    )


def _filled(
    value: nn.Module, setup: Setup, figures: list[Shape], beam: int, told: str
) -> Iterator[Filled]:
    filler, filling = Filler(value, setup), Filling(setup.layout)
    tokens = Tokens(setup.layout)
    every = np.ones(setup.layout.tokens, np.bool_)
    for figure in track(figures, told):
        area, begin = area_of(setup.layout, figure), time.process_time()
        plan = filler.plan(area, filling.left(every), beam)
        seconds = time.process_time() - begin
        laid = [place.laid for place in plan]
        found, iou = None, 0.0
        if plan and plan[-1].filled:
            found = dissection(tokens, laid)
            iou = overlap(covered(setup.layout, found), area)
        yield Filled(found, iou, seconds, len(plan), False)
