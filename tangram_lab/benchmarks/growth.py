"""How cost grows with tokens, width, batch, replay and workers, beside what one would expect."""

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tangram_agent.setup import Setup
from tangram_lab.benchmarks.learner import updates
from tangram_lab.benchmarks.measure import Row, Work, rate, told
from tangram_lab.benchmarks.replay import filled
from tangram_lab.benchmarks.setups import played, preset, several
from tangram_lab.benchmarks.sim import Episodes
from tangram_lab.benchmarks.wire import LARGE, connected, take_batches
from tangram_lab.experiments.report.style import COLOURS, WIDTH_IN, drawing, empty_figure, save

TOKENS = (1, 2, 3, 4, 5, 6, 7)
WIDTHS = (32, 64, 128, 256)
SIZES = (1_000, 10_000, 100_000, 1_000_000)
WORKERS = (1, 4, 16, 64)
SAMPLE = 256
SPAN_S = 0.2
WARM = 3


@dataclass(frozen=True)
class Curve:
    """One cost by one size.

    Attributes:
        name: "what by what".
        law: the expected one, in words.
        sizes: that are measured.
        work: context that gives the work of a size.
        cost: what the law says, up to a factor.
    """

    name: str
    law: str
    sizes: Sequence[int]
    work: Callable[[int], AbstractContextManager[Work]]
    cost: Callable[[int], float]


def measure_growth(runs: int) -> list[Row]:
    """Milliseconds of CPU by size; `theirs` is the expected law through the last point."""
    return [row for curve in _curves() for row in _measured(curve, runs)]


def _curves() -> list[Curve]:
    products = "multiplications"
    constant = "the same for all"

    def by_tokens(count: int) -> AbstractContextManager[Work]:
        return nullcontext(updates(several(count)))

    def by_width(width: int) -> AbstractContextManager[Work]:
        return nullcontext(updates(_wide(width)))

    return [
        Curve("update by tokens", constant, TOKENS[1:], by_tokens, lambda _: 1.0),
        Curve("episode by tokens", "tokens squared", TOKENS, _episodes, lambda k: float(k**2)),
        Curve("update by width", products, WIDTHS, by_width, lambda w: _products(_wide(w))),
        Curve("sample by replay size", constant, SIZES, _samples, lambda _: 1.0),
        Curve("message by workers", constant, WORKERS, _messages, lambda _: 1.0),
    ]


def _measured(curve: Curve, runs: int) -> list[Row]:
    """The law goes through the largest size, where it should hold; above it are fixed costs."""
    spent = {size: _spent(curve, size, runs) for size in curve.sizes}
    last = curve.sizes[-1]
    scale = statistics.median(spent[last]) / curve.cost(last)
    return [_row(curve, size, spent[size], scale * curve.cost(size)) for size in curve.sizes]


def _spent(curve: Curve, size: int, runs: int) -> list[float]:
    """Milliseconds of CPU, `runs` times."""
    with curve.work(size) as work:
        for _ in range(WARM):
            work()
        return [1e3 / rate(work, SPAN_S, time.thread_time) for _ in range(runs)]


def _row(curve: Curve, size: int, spent: list[float], expected: float) -> Row:
    found = statistics.median(spent)
    return told(
        Row(
            "growth",
            f"{curve.name}: {size:,}",
            "ms of CPU",
            ours=found,
            against=curve.law,
            theirs=expected,
            ratio=found / expected,
            least=min(spent) / expected,
            most=max(spent) / expected,
        )
    )


def _products(setup: Setup) -> float:
    """Of one pass over one graph: linear in the nodes, and attention among them."""
    net, nodes = setup.net, setup.layout.nodes
    linear = 4 * net.width**2 + 2 * net.width * net.feed_forward
    return float(net.layers * (nodes * linear + 2 * nodes**2 * net.width))


def _wide(width: int) -> Setup:
    setup = preset()
    return replace(setup, net=replace(setup.net, width=width, feed_forward=2 * width))


@contextmanager
def _episodes(tokens: int) -> Iterator[Work]:
    with closing(Episodes(several(tokens))) as episodes:
        yield episodes.play


@contextmanager
def _samples(size: int) -> Iterator[Work]:
    replay, rng = filled(preset(), size), np.random.default_rng(0)
    yield lambda: replay.sample(SAMPLE, rng).count / SAMPLE


@contextmanager
def _messages(workers: int) -> Iterator[Work]:
    """Received, decoded, checked and acknowledged; what the master learns of it comes on top."""
    setup = several(1)
    with connected(LARGE, setup, played(setup, LARGE.batch), workers) as hub:
        yield lambda: take_batches(hub) / LARGE.batch


def draw_growth(rows: Sequence[Row], path: Path) -> None:
    """One panel for each curve: measured, and the expected law dashed.

    Args:
        rows: of `measure_growth`.
        path: of the picture; its folder and name without ending are used.
    """
    curves: dict[str, list[Row]] = {}
    for row in rows:
        curves.setdefault(row.case.partition(":")[0], []).append(row)
    with drawing():
        figure = empty_figure(WIDTH_IN, WIDTH_IN * 0.7)
        panels = list(figure.subplots(2, 3).flat)
        for spare in panels[len(curves) :]:
            spare.axis("off")
        for (name, points), panel in zip(curves.items(), panels, strict=False):
            sizes = [int(point.case.partition(": ")[2].replace(",", "")) for point in points]
            panel.plot(sizes, [p.ours for p in points], "o-", color=COLOURS[0], label="measured")
            expected = [p.theirs or 0.0 for p in points]
            panel.plot(sizes, expected, "--", color=COLOURS[1], label=points[0].against)
            panel.set_xlabel(name.partition(" by ")[2])
            panel.set_ylabel(f"{name.partition(' by ')[0]} (ms of CPU)")
            panel.set_ylim(bottom=0)
            if max(sizes) > 1000:
                panel.set_xscale("log")
            panel.legend()
        save(figure, path.parent, path.stem)
