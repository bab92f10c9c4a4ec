"""Puzzles whose pieces are hidden: filled by a search, laid by a run, judged by the silhouette.

A player gets what the search found in the place of the pieces, and nothing else of a puzzle. Any
dissection counts: scores compare areas.

Legend: E puzzles, F of them for which something was found, K tokens, V corners.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tangram_core.agent import AT_ONCE
from tangram_core.arrays import Floats, Ints
from tangram_game.figures.puzzles import Figure, Player, play_figures
from tangram_game.figures.silhouettes import SECONDS
from tangram_sim.config import SimConfig
from tangram_sim.geometry.dissections import Dissection
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import overlap_share
from tangram_tasks.metrics import SOLVED, iou
from tangram_tasks.place import Place
from tangram_tasks.played import Played
from tangram_vision.silhouettes.silhouettes import (
    UNLEARNED,
    Method,
    fill_outline,
    silhouette,
)

_BEYOND = 10.0  # arenas from the middle: where tokens are drawn that nothing is to be laid of


@dataclass(frozen=True, eq=False)
class Search:
    """What a search made of one silhouette.

    Attributes:
        laid: where the tokens are to be laid; None where nothing was found.
        iou: of what was found with the outline.
        seconds: that it took.
        by: what found it, the search or the beam; empty where nothing was found.
    """

    laid: Figure | None
    iou: float
    seconds: float
    by: str

    @property
    def filled(self) -> bool:
        """Whether the search fills the silhouette, as far as it can tell."""
        return self.laid is not None and self.iou >= SOLVED


@dataclass(frozen=True, eq=False)
class Hidden:
    """Puzzles by their silhouettes.

    Attributes:
        task: the task, as a player of what was found sees it.
        figures: E, with the pieces that nobody is shown.
        searches: E.
    """

    task: Place
    figures: tuple[Figure, ...]
    searches: tuple[Search, ...]

    @property
    def filled_by(self) -> dict[str, int]:
        """How many the search fills, and how many the beam."""
        return {
            by: sum(search.filled and search.by == by for search in self.searches)
            for by in ("search", "beam")
        }

    @property
    def filled(self) -> int:
        """How many are filled, as far as who looked for it can tell."""
        return sum(self.filled_by.values())

    @cached_property
    def found(self) -> Ints:
        """(F,) the puzzles for which something was found."""
        return np.flatnonzero([search.laid is not None for search in self.searches])

    @cached_property
    def goals(self) -> Floats:
        """(E, V, 2) corners of the pieces."""
        layout = self.task.layout
        return np.stack([layout.corners(one.poses, one.flipped) for one in self.figures])

    @property
    def titles(self) -> list[str]:
        """What the puzzles are called on a sheet."""
        return [
            figure.title if search.filled else f"{figure.title}, not filled"
            for figure, search in zip(self.figures, self.searches, strict=True)
        ]


@dataclass(frozen=True, eq=False)
class Laid:
    """How E puzzles ended.

    Attributes:
        ends: (E, V, 2) corners of the tokens; outside of the arena where nothing was laid.
        coverage: (E,) share of the silhouette that the tokens cover.
        iou: (E,) area that tokens and silhouette share over the area of both together.
        blocked: (E,) tokens that could not be set down because of others.
        refused: (E,) actions that named a placed token.
        actions_used: (E,) actions that were not refused.
        seconds: (E,) of the search, and of choosing and moving.
    """

    ends: Floats
    coverage: Floats
    iou: Floats
    blocked: Ints
    refused: Ints
    actions_used: Ints
    seconds: Floats


def hide(task: Place, figures: Sequence[Figure], method: Method = UNLEARNED) -> Hidden:
    """Search how a run's tokens fill puzzles of which only the silhouettes are shown.

    Args:
        task: with `sim.observe=silhouette`.
        figures: E puzzles.
        method: how they are filled.
    """
    searches = tuple(_search(task.layout, figure, method) for figure in figures)
    # Which targets training drew does not matter.
    seen = task.with_sim(observe="corners", targets=SimConfig.targets)
    return Hidden(seen, tuple(figures), searches)


def _search(layout: Layout, figure: Figure, method: Method) -> Search:
    """What was found, by the name that decides where tokens start."""
    outline = silhouette(layout, Dissection(figure.poses, figure.flipped))
    (filled,) = fill_outline(outline, layout, SECONDS, method=method)
    found, laid = filled.found, None
    if found is not None:
        laid = Figure(figure.name, figure.degrees, found.poses, found.flipped)
    return Search(laid, filled.iou, filled.seconds, filled.by if laid else "")


def play_hidden(hidden: Hidden, player: Player, seed: int, at_once: int = AT_ONCE) -> Laid:
    """Lay what was found and judge it by the silhouettes."""
    layout, arena, count = hidden.task.layout, hidden.task.sim.arena, len(hidden.figures)
    seconds = np.array([search.seconds for search in hidden.searches])
    ends: Floats = hidden.goals + _BEYOND * arena
    blocked, refused, used = (np.zeros(count, np.int64) for _ in range(3))
    if len(hidden.found):
        played, rows = lay(hidden, player, seed, at_once), hidden.found
        ends[rows] = played.ends
        blocked[rows], refused[rows] = played.blocked.sum(axis=1), played.refused.sum(axis=1)
        used[rows] = played.refused.shape[1] - refused[rows]
        seconds[rows] += played.seconds
    coverage = overlap_share(ends, hidden.goals, layout)
    return Laid(ends, coverage, iou(layout, ends, coverage), blocked, refused, used, seconds)


def lay(hidden: Hidden, player: Player, seed: int, at_once: int = AT_ONCE) -> Played:
    """Lay what was found, F episodes; the targets are what was found, too."""
    laid = [search.laid for search in hidden.searches if search.laid is not None]
    return play_figures(hidden.task, laid, player, seed, at_once=at_once)
