"""The paper's Figs. 1 to 3, made with the project's own tools.

They show the task, the graph and the camera; none of them needs a trained agent. Legend: N nodes,
W width of an embedding.
"""

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Polygon, Rectangle

from tangram_agent.attention import GraphEncoder
from tangram_agent.config import NetConfig
from tangram_agent.networks import initialise
from tangram_agent.types import Past
from tangram_lab.experiments.report.style import (
    COLOURS,
    GREY,
    WIDTH_IN,
    drawing,
    empty_figure,
    save,
)
from tangram_sim.actions import velocities
from tangram_sim.arrays import Floats, Pixels
from tangram_sim.config import SimConfig
from tangram_sim.errors import ConfigError
from tangram_sim.layout import Layout, TokensConfig, make_layout
from tangram_sim.pictures import token_pixels
from tangram_sim.puzzles import load_puzzle
from tangram_sim.rewards import TargetPictures
from tangram_sim.sampling import sample_poses
from tangram_sim.world import check_world, make_world
from worker.baselines import position_policy

FRAME = "#9CA3AF"


def bare(panel: Axes, framed: bool = False) -> None:
    """No grid, no ticks, both axes of one scale, and no frame unless asked for."""
    panel.grid(visible=False)
    panel.set_xticks([])
    panel.set_yticks([])
    panel.set_aspect("equal")
    for spine in panel.spines.values():
        spine.set_visible(framed)
        spine.set_color(FRAME)


# Fig. 1: the puzzle, and all three


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
    drawn = (
        ("fig1_puzzle", "Fig. 1: the puzzle", draw_puzzle),
        ("fig2_graph", "Fig. 2: the graph of a single token", draw_graph),
        ("fig3_camera", "Fig. 3: what the camera sees", draw_camera),
    )
    shown = []
    with drawing():
        for name, title, draw in drawn:
            figure, caption = draw()
            save(figure, out, name)
            shown.append((title, f"{name}.png", caption))
    return shown


def draw_puzzle() -> tuple[Figure, str]:
    """A cat and a random start of its tokens, side by side; and what they are."""
    puzzle, sim = load_puzzle("cat_of_six", CAT_SCALE), SimConfig(backend="kinematic")
    layout, half = puzzle.layout, sim.arena / 2.0
    start = sample_poses(layout, sim, np.random.default_rng(START_SEED))
    figure = empty_figure(WIDTH_IN * 0.8, WIDTH_IN * 0.42)
    panels = figure.subplots(1, 2)
    shown = ((puzzle.poses, "(a) target"), (start, "(b) random start"))
    for panel, (poses, label) in zip(panels, shown, strict=True):
        bare(panel, framed=True)
        panel.set(xlim=(-half, half), ylim=(-half, half), xlabel=label)
        corners = layout.corners(poses)
        for k in range(layout.tokens):
            face, outline = (COLOURS[k % len(COLOURS)], 0.85), corners[layout.corners_of(k)]
            panel.add_patch(Polygon(outline, facecolor=face, edgecolor="white", linewidth=1.2))
    caption = (
        "Fig. 1: (a) a sitting cat of six tokens as the target, (b) the same tokens at a random "
        "start without overlap."
    )
    return figure, caption


# Fig. 2: the graph of a single token, and what the network makes of it


TOKENS = TokensConfig(("square",), 1.131370849898476)  # tokens=square: side 0.4
TOKEN_POSE, TARGET_POSE = (-0.36, -0.26, 0.30), (0.36, 0.31, 0.72)
NET = NetConfig(width=64, layers=3, heads=4, feed_forward=512, scale="d")  # the paper's
SHOWN = 4  # numbers of an embedding that are drawn
CLASSES = ("token corner", "token base", "target corner")
CLASS_COLOURS = (COLOURS[0], COLOURS[2], COLOURS[1])
WITHIN, BETWEEN = "#4B5563", "#9CA3AF"


def draw_graph() -> tuple[Figure, str]:
    """The graph with its edges, its features and the way through the encoder; and a caption."""
    layout = make_layout(TOKENS)
    corners, goal = (layout.corners(np.array([pose])) for pose in (TOKEN_POSE, TARGET_POSE))
    features = layout.node_features(corners, np.zeros(1, np.bool_), goal)
    figure = empty_figure(WIDTH_IN, WIDTH_IN * 0.5)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.0, 1.45), height_ratios=(0.8, 1.2))
    _draw_scene(figure.add_subplot(grid[:, 0]), layout, features)
    _draw_stages(figure.add_subplot(grid[0, 1]), layout, features)
    _draw_table(figure.add_subplot(grid[1, 1]), layout, features)
    return figure, _graph_caption(layout)


def node_classes(layout: Layout) -> list[int]:
    """(N,) index into CLASSES of every node, in the layout's order."""
    corners = layout.corner_count
    return [0] * corners + [1] * layout.tokens + [2] * corners


def embeddings(layout: Layout, features: Floats) -> tuple[Floats, Floats]:
    """Embeddings (N, W) of features (N, F) before and after message passing; untrained weights."""
    encoder = GraphEncoder(features.shape[-1], NET)
    initialise(encoder, torch.Generator().manual_seed(0))
    nodes = torch.as_tensor(features, dtype=torch.float32)[None]
    with torch.inference_mode():
        first = encoder.embed(nodes)[0]
        last = encoder(nodes, torch.as_tensor(layout.adjacency))[0][0]
    return first.numpy().astype(np.float64), last.numpy().astype(np.float64)


def _draw_scene(panel: Axes, layout: Layout, features: Floats) -> None:
    bare(panel)
    positions = features[:, :2]
    _draw_edges(panel, layout, positions, 1.1)
    for kind, (label, colour) in enumerate(zip(CLASSES, CLASS_COLOURS, strict=True)):
        own = [i for i, one in enumerate(node_classes(layout)) if one == kind]
        x, y = positions[own].T
        panel.scatter(x, y, s=190, color=colour, label=label, zorder=3, linewidths=0)
    for i, (x, y) in enumerate(positions.tolist()):
        panel.text(x, y - 0.003, str(i), color="white", ha="center", va="center", zorder=4)
    panel.margins(0.1)
    panel.set_title("initial graph", loc="left", weight="bold")
    panel.legend(loc="upper left", handletextpad=0.3, labelspacing=0.5, markerscale=0.6)


def _draw_edges(panel: Axes, layout: Layout, positions: Floats, width: float) -> None:
    """All edges of the adjacency: full within a piece, dashed from a base to target corners."""
    kinds = node_classes(layout)
    pairs = [(i, j) for i, j in np.argwhere(np.triu(layout.adjacency)).tolist()]
    across = [{kinds[i], kinds[j]} == {1, 2} for i, j in pairs]
    for between, colour, style in ((True, BETWEEN, "dashed"), (False, WITHIN, "solid")):
        own = [pair for pair, far in zip(pairs, across, strict=True) if far == between]
        lines = LineCollection([positions[list(pair)] for pair in own], linestyles=style, zorder=1)
        lines.set(color=colour, linewidth=width)
        panel.add_collection(lines)


def _draw_stages(panel: Axes, layout: Layout, features: Floats) -> None:
    """Initial graph -> embedding -> rounds of message passing -> action, in units of one graph."""
    bare(panel)
    panel.set_xlim(-0.08, 6.08)
    panel.set_ylim(-0.62, 1.12)
    first, last = embeddings(layout, features)
    places = _in_unit_square(features[:, :2])
    nodes = layout.nodes
    stages = (
        (0.0, features, f"features\n${nodes} \\times {features.shape[1]}$"),
        (1.8, first[:, :SHOWN], f"embedding\n${nodes} \\times {NET.width}$"),
        (3.6, last[:, :SHOWN], f"encoded graph\n${nodes} \\times {NET.width}$"),
    )
    for left, values, label in stages:
        at = places + (left, 0.0)
        _draw_edges(panel, layout, at, 0.5)
        _draw_strips(panel, at, values, node_classes(layout))
        panel.text(left + 0.5, -0.22, label, ha="center", va="top", fontsize=8)
    _arrow(panel, 1.12, 1.7, "Eq. 8")
    _arrow(panel, 2.92, 3.5, f"${NET.layers} \\times$\nEqs. 9-13")
    _arrow(panel, 4.72, 5.15, "base")
    _draw_action(panel)
    panel.set_title("message passing", loc="left", weight="bold")


def _draw_action(panel: Axes) -> None:
    """A box with the three velocities."""
    box = FancyBboxPatch((5.28, 0.16), 0.72, 0.68, "round,pad=0.04", facecolor="#ECFDF5")
    box.set_edgecolor(CLASS_COLOURS[1])
    panel.add_patch(box)
    panel.text(5.64, 0.5, "$v_x$\n$v_y$\n$\\omega$", ha="center", va="center", fontsize=8.5)
    panel.text(5.64, -0.22, "action\n3", ha="center", va="top", fontsize=8)


def _in_unit_square(positions: Floats) -> Floats:
    """The same picture with its larger side from 0 to 1."""
    low, high = positions.min(axis=0), positions.max(axis=0)
    scaled: Floats = (positions - (low + high) / 2.0) / (high - low).max() + 0.5
    return scaled


def _draw_strips(panel: Axes, at: Floats, values: Floats, kinds: Sequence[int]) -> None:
    """At each node the numbers that it carries, one cell each: red is high, blue is low."""
    colours = _shades(values)
    cell = 0.065
    for (x, y), row, kind in zip(at, colours, kinds, strict=True):
        height = cell * len(row)
        for i, colour in enumerate(row):
            corner = (x - cell / 2.0, y + height / 2.0 - cell * (i + 1))
            panel.add_patch(Rectangle(corner, cell, cell, facecolor=colour, zorder=3))
        frame = Rectangle((x - cell / 2.0, y - height / 2.0), cell, height, fill=False, zorder=4)
        frame.set(edgecolor=CLASS_COLOURS[kind], linewidth=1.1)
        panel.add_patch(frame)


def _shades(values: Floats) -> list[list[tuple[float, float, float]]]:
    """Blue through white to red, for each number of (N, C) on one scale."""
    share = np.clip(values / np.abs(values).max(), -1.0, 1.0)
    low, high = np.array([0.13, 0.40, 0.67]), np.array([0.70, 0.09, 0.17])
    ends = np.where(share[..., None] < 0.0, low, high)
    mixed = 1.0 + np.abs(share)[..., None] * (ends - 1.0)
    return [[(float(r), float(g), float(b)) for r, g, b in row] for row in mixed]


def _arrow(panel: Axes, start: float, end: float, label: str) -> None:
    panel.add_patch(
        FancyArrowPatch((start, 0.5), (end, 0.5), arrowstyle="-|>", mutation_scale=9, color=GREY)
    )
    panel.text((start + end) / 2.0, 0.58, label, ha="center", va="bottom", fontsize=7.5, color=GREY)


def _draw_table(panel: Axes, layout: Layout, features: Floats) -> None:
    """One row for each node: its four features."""
    bare(panel)
    panel.set_aspect("auto")
    columns = (0.03, 0.16, 0.52, 0.66, 0.81, 0.96)
    heads = ("node", "class", "x", "y", "target", "placed")
    rows = layout.nodes
    panel.set_xlim(0.0, 1.0)
    panel.set_ylim(-rows - 0.6, 0.6)
    for x, head in zip(columns, heads, strict=True):
        left = head == "class"
        panel.text(x, 0.0, head, ha="left" if left else "center", va="center", color=GREY)
    panel.axhline(-0.45, color="#D8DCE2", linewidth=0.8)
    for i, (kind, row) in enumerate(zip(node_classes(layout), features, strict=True)):
        y = -i - 1.0
        panel.scatter([columns[0]], [y], s=95, color=CLASS_COLOURS[kind], linewidths=0)
        panel.text(columns[0], y, str(i), color="white", ha="center", va="center", fontsize=7.5)
        panel.text(columns[1], y, CLASSES[kind], va="center")
        cells = (f"{row[0]:.2f}", f"{row[1]:.2f}", f"{row[2]:.0f}", f"{row[3]:.0f}")
        for x, text in zip(columns[2:], cells, strict=True):
            panel.text(x, y, f"${text}$", ha="center", va="center")
    panel.set_title("features of a node", loc="left", weight="bold")


def _graph_caption(layout: Layout) -> str:
    edges = int(layout.adjacency.sum()) // 2
    return (
        f"Fig. 2: the graph of a single token: {layout.nodes} nodes, {edges} edges. Corners of a "
        "piece see each other; the base, where the action is read, sees the token's corners and "
        "(dashed) all target corners. Every node starts with four features; an embedding and "
        f"{NET.layers} rounds of {NET.heads}-headed attention give it {NET.width} (of which "
        f"{SHOWN} are drawn, with untrained weights), from which the base's readout makes the "
        "action."
    )


# Fig. 3: the pictures that the camera of the simulation takes in one episode


PIXELS = 192
SEED = 5
TARGET, TOKEN, BOTH = (to_rgb(colour) for colour in (COLOURS[4], COLOURS[5], COLOURS[0]))


class Shots(NamedTuple):
    """Grayscale pictures (P, P) that the camera of a backend took of an episode, and Eq. 14."""

    backend: str
    target: Pixels
    start: Pixels
    end: Pixels
    reward: float


def draw_camera() -> tuple[Figure, str]:
    """The four panels of Fig. 3, and what they show."""
    shots = take_shots()
    figure = empty_figure(WIDTH_IN, WIDTH_IN * 0.28)
    panels = figure.subplots(1, 4)
    gray = [np.repeat(one[..., None], 3, axis=-1) for one in (shots.target, shots.start, shots.end)]
    labels = ("(a) target", "(b) initial position", "(c) after action a")
    overlap = f"(d) overlap, r = {shots.reward:.3f}"
    pictures = [*gray, _overlap(shots.target, shots.end)]
    for panel, picture, label in zip(panels, pictures, (*labels, overlap), strict=True):
        bare(panel, framed=True)
        panel.imshow(picture, interpolation="nearest")
        panel.set_xlabel(label)
    return figure, _camera_caption(shots)


def take_shots(backend: str = "physics") -> Shots:
    """One episode: its action moves the token exactly onto the target's centre, without a turn.

    That is what the paper's agents learn. Without the engine the kinematic world plays it, whose
    camera follows the same convention.
    """
    layout = make_layout(TOKENS)
    sim = SimConfig(backend=backend, pixels=PIXELS)
    try:
        check_world(layout, sim)
    except ConfigError:
        return take_shots("kinematic")
    generator = np.random.default_rng(SEED)
    target, start = (sample_poses(layout, sim, generator) for _ in range(2))
    policy = position_policy(layout, sim)
    placed = np.zeros((1, 1), dtype=np.bool_)
    corners, goals = layout.corners(start)[None], layout.corners(target)[None]
    nothing = Past(
        np.zeros((1, 0, *corners.shape[1:]), np.float32), np.zeros((1, 0, 3), np.float32)
    )
    action = policy(corners, placed, goals, [generator], nothing)
    with closing(make_world(layout, sim)) as world:
        world.place(target)
        wanted = world.picture()
        world.place(start)
        first = world.picture()
        world.move(0, velocities(action.astype(np.float64), sim)[0])
        end = world.picture()
    return Shots(backend, wanted, first, end, TargetPictures(wanted[None]).rewards(end[None])[0])


def _overlap(target: Pixels, end: Pixels) -> Floats:
    """(P, P, 3) colours in [0, 1]: where target, token and both are."""
    wanted, covered = token_pixels(target), token_pixels(end)
    image = np.ones((*target.shape, 3))
    image[wanted] = TARGET
    image[covered] = TOKEN
    image[wanted & covered] = BOTH
    return image


def _camera_caption(shots: Shots) -> str:
    engine = (
        "PyBullet's camera"
        if shots.backend == "physics"
        else "the kinematic world's camera (PyBullet is not installed)"
    )
    raw = (shots.reward + 1.0) / 2.0
    return (
        f"Fig. 3: pictures of {PIXELS} x {PIXELS} pixels from {engine}: (a) the target, (b) the "
        "initial random position, (c) after an action a that meets the target's centre and does "
        "not turn, (d) target (amber), token (light blue) and what both cover (dark blue). "
        f"The share of the target's pixels that are covered is {raw:.3f}, so by Eq. 14, scaled to "
        f"[-1, 1], the reward is r = {shots.reward:.3f}."
    )
