"""Style and saving of matplotlib figures, without the global state of pyplot."""

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
# Colours of Okabe and Ito, distinguishable with colour blindness.
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
    """A figure of WIDTH_IN inches and its axes, `panels` of them side by side."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        made = figure.subplots(1, panels, sharey=sharey, squeeze=False)
    return figure, list(made.flat)


def legend_below(figure: Figure, panel: Axes) -> None:
    """Add one legend below all panels, with the labels of `panel`."""
    handles, names = panel.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3, frameon=False)


def save(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG file.

    Raises:
        RunError: the file cannot be written.
    """
    data = io.BytesIO()
    figure.savefig(data, format="png", metadata={"Software": None})
    write_whole(path, data.getvalue())
