"""How figures look, and how they are saved; pyplot's global state is left alone."""

import io
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tangram_core.store.files import write_whole

DPI = 100
WIDTH_IN = 9.0
# Okabe and Ito's colours, for all kinds of colour vision.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#882255")
STYLE: dict[Any, Any] = {
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "font.size": 9.0,
    "grid.color": "#E5E7EB",
    "legend.frameon": False,
}


def new_figure(
    height_in: float, panels: int = 1, sharey: bool = False
) -> tuple[Figure, list[Axes]]:
    """A figure as wide as a README, with panels beside each other."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        made = figure.subplots(1, panels, sharey=sharey, squeeze=False)
    return figure, list(made.flat)


def legend_below(figure: Figure, panel: Axes) -> None:
    """One legend for all panels, from the labels of one."""
    handles, names = panel.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3, frameon=False)


def save(figure: Figure, path: Path) -> None:
    """Write a PNG.

    Raises:
        RunError: it cannot be written.
    """
    data = io.BytesIO()
    figure.savefig(data, format="png", metadata={"Software": None})
    write_whole(path, data.getvalue())
