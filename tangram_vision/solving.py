"""Fill a figure of a file or of the library with tokens, or find their nearest figure."""

import time
from dataclasses import dataclass

from tangram_core.scores import decimal
from tangram_sim.geometry.dissections import Dissection
from tangram_sim.geometry.layout import Layout
from tangram_sim.targets.targets import has_all_tans
from tangram_vision.given.silhouette_files import Silhouette, fill_silhouette
from tangram_vision.silhouettes.approximations import nearest_figure
from tangram_vision.silhouettes.tilts import mapped
from tangram_vision.solution import Picture, Solution, tokens_of

SECONDS = 5.0  # for the search of an exact filling
NEAREST_SECONDS = 2.5  # for the search of the nearest figure


@dataclass(frozen=True, eq=False)
class Answer:
    """The tokens' arrangement for a figure.

    Attributes:
        drawn: the figure as it was read.
        lies: poses of the tokens, which fill the figure or come nearest to it.
        exact: whether the tokens fill the figure.
        iou: intersection over union of figure and tokens.
        told: how the figure was filled, or why not, in words.
        seconds: processor time that was used.
    """

    drawn: Silhouette
    lies: Dissection
    exact: bool
    iou: float
    told: str
    seconds: float

    def solution(self, layout: Layout, scale: float, source: str) -> Solution:
        """The answer as data; `scale` is the full square's side, in units of the layout."""
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
    """Fill a figure, or find the nearest figure of all tokens; arguments as in `fill_silhouette`.

    Raises:
        ConfigError: the file cannot be used.
    """
    begin = time.thread_time()
    drawn = fill_silhouette(name, source, layout, scale, seconds)
    filled = drawn.filled
    if filled.found is not None and filled.solved:
        told = f"filled by the {filled.by} in {filled.seconds:.2f} s, IoU {decimal(filled.iou)}"
        taken = time.thread_time() - begin
        return Answer(drawn, filled.found, True, filled.iou, told, taken)
    starts = [one for one in (filled.found, filled.attempt) if one is not None]
    found, iou = nearest_figure(drawn.area, layout, NEAREST_SECONDS, starts=starts)
    told = f"{_unfilled(drawn, layout)}; the nearest figure has IoU {decimal(iou)} with it"
    return Answer(drawn, found, False, float(iou), told, time.thread_time() - begin)


def _unfilled(drawn: Silhouette, layout: Layout) -> str:
    filled = drawn.filled
    names = ", ".join(shape.name for shape in layout.shapes)
    tokens = "the seven tans" if has_all_tans(layout) else names
    if drawn.share is not None:
        share = f"{drawn.share:.2f}" if 0.01 <= drawn.share < 100.0 else f"{drawn.share:.2g}"
        return f"is {share} times as large as {tokens} by its side, and not filled at their size"
    if filled.complete:
        return f"cannot be filled with {tokens}: all ways were tried, {filled.nodes} steps"
    return f"was not filled with {tokens} in {filled.seconds:.1f} s"
