"""Tokens and arenas in matplotlib's panels, for the pictures of the paper, and their files."""

from matplotlib.axes import Axes
from matplotlib.patches import Polygon

from tangram_lab.experiments.report.style import COLOURS
from tangram_sim.arrays import Floats
from tangram_sim.layout import Layout

FRAME = "#9CA3AF"


def bare(panel: Axes) -> None:
    """No grid, no ticks, no frame, and both axes of one scale."""
    panel.grid(visible=False)
    panel.set_xticks([])
    panel.set_yticks([])
    panel.set_aspect("equal")
    for spine in panel.spines.values():
        spine.set_visible(False)


def show_arena(panel: Axes, arena: float) -> None:
    """The square playground around the origin, with its frame."""
    bare(panel)
    half = arena / 2.0
    panel.set_xlim(-half, half)
    panel.set_ylim(-half, half)
    for spine in panel.spines.values():
        spine.set_visible(True)
        spine.set_color(FRAME)


def draw_tokens(panel: Axes, layout: Layout, corners: Floats, opacity: float = 0.85) -> None:
    """Tokens with corners (V, 2), each in its own colour."""
    for k in range(layout.tokens):
        colour = COLOURS[k % len(COLOURS)]
        outline = corners[layout.corners_of(k)]
        panel.add_patch(
            Polygon(outline, facecolor=(colour, opacity), edgecolor="white", linewidth=1.2)
        )
