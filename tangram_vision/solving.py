"""A figure, of a file or of the library -> tokens that fill it; else those that come nearest."""

import time
from dataclasses import dataclass

from tangram_sim.geometry.dissections import Dissection
from tangram_sim.geometry.layout import Layout
from tangram_sim.targets.targets import has_all_tans
from tangram_vision.given.silhouette_files import Silhouette, fill_silhouette
from tangram_vision.silhouettes.approximations import nearest_figure
from tangram_vision.silhouettes.tilts import mapped
from tangram_vision.solution import Picture, Solution, tokens_of

SECONDS = 5.0  # of a search, and
NEAREST_SECONDS = 2.5  # of what comes nearest


@dataclass(frozen=True, eq=False)
class Answer:
    """How tokens make a figure.

    Attributes:
        drawn: what was shown.
        lies: how they fill it, or come nearest.
        exact: whether they fill it.
        iou: area that figure and tokens share over the area of both together.
        told: how it was filled, or why not, in words.
        seconds: of processor time that it took.
    """

    drawn: Silhouette
    lies: Dissection
    exact: bool
    iou: float
    told: str
    seconds: float

    def solution(self, layout: Layout, scale: float, source: str) -> Solution:
        """The same as data; the side of the full square is in units of the layout."""
        own = mapped(self.drawn.own, self.drawn.corners(layout, self.lies))
        return Solution(
            source=source,
            kind="filled" if self.exact else "nearest",
            told=self.told,
            iou=round(self.iou, 6),
            seconds=round(self.seconds, 3),
            picture=Picture.of(self.drawn.page),
            tokens=tokens_of(layout, scale, self.lies, own),
        )


def answer(
    name: str, source: str, layout: Layout, scale: float, seconds: float = SECONDS
) -> Answer:
    """Fill a figure, or come near to it with all tokens; see `fill_silhouette`.

    Raises:
        ConfigError: a file that cannot be used.
    """
    begin = time.thread_time()
    drawn = fill_silhouette(name, source, layout, scale, seconds)
    filled = drawn.filled
    if filled.found is not None and filled.solved:
        told = f"filled by the {filled.by} in {filled.seconds:.2f} s, IoU {filled.iou:.3f}"
        taken = time.thread_time() - begin
        return Answer(drawn, filled.found, True, filled.iou, told, taken)
    starts = [one for one in (filled.found, filled.attempt) if one is not None]
    found, iou = nearest_figure(drawn.area, layout, NEAREST_SECONDS, starts=starts)
    told = f"{_unfilled(drawn, layout)}; the nearest figure has IoU {iou:.3f} with it"
    return Answer(drawn, found, False, float(iou), told, time.thread_time() - begin)


def _unfilled(drawn: Silhouette, layout: Layout) -> str:
    filled = drawn.filled
    names = ", ".join(shape.name for shape in layout.shapes)
    tokens = "the seven tans" if has_all_tans(layout) else names
    if drawn.share is not None:
        share = f"{drawn.share:.2f}" if 0.01 <= drawn.share < 100.0 else f"{drawn.share:.2g}"
        return f"is {share} times as large as {tokens} by its side, and not filled in their size"
    if filled.complete:
        return f"cannot be filled with {tokens}: all ways were tried, {filled.nodes} steps"
    return f"was not filled with {tokens} in {filled.seconds:.1f} s"
