"""How figures look, and how they are saved; nothing here touches pyplot's global state."""

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from tangram_agent.files import write_whole

WIDTH_IN = 9.0  # a README shows it a little smaller than that
DPI = 160
CROWDED = 1e4  # beyond, two ticks in each decade run into one another
WIDE = 30.0  # most / least of values that need a logarithmic axis
LINES = 6  # of a panel, what they are compared with among them
# Okabe and Ito's colours for all kinds of colour vision, without black and yellow, and two of
# Paul Tol's.
COLOURS = (
    *("#0072B2", "#D55E00", "#009E73", "#CC79A7"),
    *("#E69F00", "#56B4E9", "#882255", "#999933"),
)
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<")
DASHES = ("-", (0, (5, 1.5)), (0, (1.5, 1.2)), (0, (5, 1.5, 1.2, 1.5)))
GREY, LEVEL, PALE = "#6B7280", "#9CA3AF", "#D8DCE2"
SETTINGS: dict[Any, Any] = {
    "axes.edgecolor": "#9CA3AF",
    "axes.labelcolor": "#374151",
    "axes.labelsize": 9.5,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 9.5,
    "axes.unicode_minus": True,
    "figure.constrained_layout.h_pad": 0.07,
    "figure.constrained_layout.w_pad": 0.06,
    "figure.facecolor": "white",
    "font.family": "DejaVu Sans",  # comes with matplotlib, so every machine draws the same
    "font.size": 9.0,
    "legend.fontsize": 9.0,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "svg.hashsalt": "tangram-report",
    "text.color": "#1F2937",
    "xtick.color": "#4B5563",
    "xtick.labelsize": 8.5,
    "ytick.color": "#4B5563",
    "ytick.labelsize": 8.5,
}

Dash = str | tuple[int, tuple[float, ...]]


class Look(NamedTuple):
    """How one training looks in every figure: the colour is its agent's and network's."""

    colour: str
    marker: str
    dash: Dash


@contextmanager
def drawing() -> Iterator[None]:
    """Figures that are made and saved inside look like this house's."""
    with mpl.rc_context(SETTINGS):
        yield


def empty_figure(width_in: float, height_in: float) -> Figure:
    """A figure without panels of that many inches, and without pyplot's global state."""
    figure = Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def new_figure(
    height_in: float, rows: int, columns: int, sharex: bool = False, sharey: bool = False
) -> tuple[Figure, list[Axes]]:
    """A figure as wide as a README with its panels, row after row."""
    figure = empty_figure(WIDTH_IN, height_in)
    panels = figure.subplots(rows, columns, sharex=sharex, sharey=sharey, squeeze=False)
    for panel in panels.flat:
        panel.grid(axis="both", color="#E5E7EB", linewidth=0.7)
        panel.set_axisbelow(True)
        panel.tick_params(length=2.5)
    return figure, list(panels.flat)


def legend_below(figure: Figure, panel: Axes, columns: int = 4) -> None:
    """One legend for all panels, under them, from the labels of one; each label once."""
    handles, labels = panel.get_legend_handles_labels()
    once = dict(zip(labels[::-1], handles[::-1], strict=True))
    names = list(dict.fromkeys(labels))
    if names:
        figure.legend(
            [once[name] for name in names],
            names,
            loc="outside lower center",
            ncols=min(columns, len(names)),
            handlelength=2.4,
            columnspacing=1.6,
        )


def widen(panel: Axes, axis: str, values: Sequence[float]) -> None:
    """A logarithmic axis, x or y, where the values need one; its ticks are plain numbers."""
    if values and min(values) > 0.0 and (ratio := max(values) / min(values)) > WIDE:
        make_logarithmic(panel, axis, (1.0,) if ratio > CROWDED else (1.0, 3.0))


def make_logarithmic(panel: Axes, axis: str, subs: Sequence[float] = (1.0, 3.0)) -> None:
    """A logarithmic axis, x or y, whose ticks are plain numbers: these in each decade."""
    panel.set(**{f"{axis}scale": "log"})
    scaled = panel.xaxis if axis == "x" else panel.yaxis
    scaled.set_major_locator(LogLocator(subs=subs))
    scaled.set_major_formatter(thousands())
    scaled.set_minor_formatter(NullFormatter())


def thousands() -> FuncFormatter:
    """20000 as 20k, 1500 as 1.5k."""
    return FuncFormatter(
        lambda value, _: f"{value / 1000:g}k" if abs(value) >= 1000 else f"{value:g}"
    )


def save(figure: Figure, folder: Path, name: str) -> None:
    """Write a figure as `name`.png and .svg; the same data gives the same bytes.

    Raises:
        RunError: the files cannot be written.
    """
    # Names of the program and times would change with every machine and run.
    for kind, left_out in {"png": ("Software",), "svg": ("Date", "Creator")}.items():
        data = io.BytesIO()
        figure.savefig(data, format=kind, metadata=dict.fromkeys(left_out))
        write_whole(folder / f"{name}.{kind}", data.getvalue())
