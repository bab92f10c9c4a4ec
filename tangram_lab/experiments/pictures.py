"""The paper's Figs. 1 to 3, made with the project's own tools.

They show the task, the graph and the camera; none of them needs a trained agent.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from tangram_lab.experiments.camera_picture import draw_camera
from tangram_lab.experiments.graph_picture import draw_graph
from tangram_lab.experiments.report.style import WIDTH_IN, drawing, empty_figure, save
from tangram_lab.experiments.scenes import draw_tokens, show_arena
from tangram_sim.assembly import Puzzle
from tangram_sim.config import SimConfig
from tangram_sim.puzzles import load_puzzle
from tangram_sim.sampling import sample_poses

START_SEED = 3  # of Fig. 1 (b)
CAT_SCALE = 0.8


def draw_paper_pictures(out: Path) -> list[tuple[str, str, str]]:
    """Write Figs. 1 to 3 as PNG and SVG; the same version writes the same bytes.

    Args:
        out: folder of the files; made if it is missing.

    Returns:
        Title, file name of the PNG and caption of each; the SVG lies beside it.

    Raises:
        RunError: the files cannot be written.
    """
    shown = []
    cat = load_puzzle("cat_of_six", CAT_SCALE)
    with drawing():
        for name, title, (figure, caption) in (
            (
                "fig1_puzzle",
                "Fig. 1: the puzzle",
                draw_puzzle(cat),
            ),
            ("fig2_graph", "Fig. 2: the graph of a single token", draw_graph()),
            ("fig3_camera", "Fig. 3: what the camera sees", draw_camera()),
        ):
            save(figure, out, name)
            shown.append((title, f"{name}.png", caption))
    return shown


def draw_puzzle(puzzle: Puzzle) -> tuple[Figure, str]:
    """The cat and a random start of its tokens, side by side; and what they are."""
    sim = SimConfig(backend="kinematic")
    start = sample_poses(puzzle.layout, sim, np.random.default_rng(START_SEED))
    figure = empty_figure(WIDTH_IN * 0.8, WIDTH_IN * 0.42)
    panels = figure.subplots(1, 2)
    for panel, poses, label in zip(
        panels, (puzzle.poses, start), ("(a) target", "(b) random start"), strict=True
    ):
        show_arena(panel, sim.arena)
        draw_tokens(panel, puzzle.layout, puzzle.layout.corners(poses))
        panel.set_xlabel(label)
    caption = (
        "Fig. 1: (a) a sitting cat of six tokens as the target, (b) the same tokens at a random "
        "start without overlap."
    )
    return figure, caption
