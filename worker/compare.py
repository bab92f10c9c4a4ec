"""tangram-play compare=[...]: several runs on the same starts, side by side."""

from collections.abc import Sequence
from pathlib import Path

import torch
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console

from tangram_agent.runs import Run, load_run
from tangram_agent.setup import Setup
from tangram_sim.arrays import Floats
from tangram_sim.errors import RunError
from worker.config import PlayConfig
from worker.film import frames_per_action
from worker.play import (
    draw_sheet,
    motion,
    play_episodes,
    save_picture,
    with_stills,
)
from worker.rollout import Played

WIDTH = 1080  # pixels across, about, of all runs together
HEADER = 44  # pixels above a run's episodes
TITLE, SCORE = 18, 13  # pixels of the header's two lines
GAP = 24  # pixels between runs
PAPER, TEXT, FAINT, RULE = (250, 250, 247), (31, 41, 55), (107, 114, 128), (214, 214, 208)


def compare_runs(config: PlayConfig) -> int:
    """Play the same episodes with several runs, noise off, and draw each run's in a column.

    Episodes stand at the same place in every column; a shorter one waits for the others.

    Returns:
        Exit status 0.

    Raises:
        RunError: a run that cannot be loaded or has other tokens or another arena than the
            first, or `out` is not writable.
    """
    torch.set_num_threads(1)
    runs = [load_run(run_dir) for run_dir in config.run_dirs]
    check_same_task(runs)
    shown = [play_episodes(run, config) for run in runs]
    labels = distinct_names([run.folder for run in runs])
    scores = [f"mean raw overlap {played.overlap.mean():.3f}" for _, played in shown]
    panels = [
        [headed(frame, *text) for frame in frames]
        for frames, *text in zip(_films(config, shown), labels, scores, strict=True)
    ]
    frames = [side_by_side(row) for row in zip(*panels, strict=True)]
    save_picture(config.out, with_stills(frames))
    line = "; ".join(f"{label}: {score}" for label, score in zip(labels, scores, strict=True))
    Console(highlight=False).print(
        f"{config.out}: {config.episodes} episodes; {line}", markup=False, soft_wrap=True
    )
    return 0


def check_same_task(runs: Sequence[Run]) -> None:
    """Refuse runs that cannot have the same starts; their agents may differ.

    Raises:
        RunError: names the run that differs from the first, and in what.
    """
    first = runs[0]
    for run in runs[1:]:
        for what, one, other in (
            ("tokens", _tokens(first.setup), _tokens(run.setup)),
            ("sim.arena", f"{first.setup.sim.arena:g}", f"{run.setup.sim.arena:g}"),
        ):
            if one != other:
                raise RunError(
                    f"cannot compare {run.folder} with {first.folder}: {what} is {other} here and "
                    f"{one} there; the same starts need the same tokens and arena"
                )
        if run.setup.layout.fingerprint() != first.setup.layout.fingerprint():
            raise RunError(
                f"cannot compare {run.folder} with {first.folder}: their tokens have other "
                "corners; the same starts need the same tokens and arena"
            )


def _tokens(setup: Setup) -> str:
    names = ", ".join(shape.name for shape in setup.layout.shapes)
    return f"[{names}] of scale {setup.tokens.scale:.6g}"


def distinct_names(folders: Sequence[Path]) -> list[str]:
    """The folders' names, with as many parents before them as tell all of them apart."""
    longest = max(len(folder.parts) for folder in folders)
    for depth in range(1, longest + 1):
        names = ["/".join(folder.parts[-depth:]) for folder in folders]
        if len(set(names)) == len(names):
            return names
    return [str(folder) for folder in folders]


def _films(config: PlayConfig, shown: Sequence[tuple[Setup, Played]]) -> list[list[Image.Image]]:
    """For each run its frames, equally many: only the last one for a PNG."""
    if Path(config.out).suffix == ".png":
        scenes = [[played.ends] for _, played in shown]
    else:
        scenes = equally_long(shown)
    return [
        [draw_sheet(setup, played, corners, WIDTH // len(shown)) for corners in film]
        for (setup, played), film in zip(shown, scenes, strict=True)
    ]


def equally_long(shown: Sequence[tuple[Setup, Played]]) -> list[list[Floats]]:
    """For each run the corners (E, V, 2) of every frame; a shorter film keeps its last one."""
    count = frames_per_action(max(played.actions.shape[1] for _, played in shown))
    films = [motion(setup.layout, played.corners, count) for setup, played in shown]
    longest = max(map(len, films))
    return [film + [film[-1]] * (longest - len(film)) for film in films]


def headed(panel: Image.Image, title: str, score: str) -> Image.Image:
    """A run's picture below its name and its score; a long name loses its beginning."""
    canvas = Image.new("RGB", (panel.width, panel.height + HEADER), PAPER)
    canvas.paste(panel, (0, HEADER))
    draw = ImageDraw.Draw(canvas)
    font = ImageFont.load_default(TITLE)
    left = panel.width // 30
    short = title
    while len(short) > 1 and draw.textlength(short, font) > panel.width - 2 * left:
        short = "…" + short.lstrip("…")[1:]
    draw.text((left, 6), short, TEXT, font)
    draw.text((left, 6 + TITLE + 4), score, FAINT, ImageFont.load_default(SCORE))
    return canvas


def side_by_side(panels: Sequence[Image.Image]) -> Image.Image:
    """Pictures in a row, their tops in line, with a rule between them."""
    height = max(panel.height for panel in panels)
    width = sum(panel.width for panel in panels) + GAP * (len(panels) - 1)
    canvas = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(canvas)
    left = 0
    for panel in panels:
        if left:
            draw.line((left - GAP // 2, 8, left - GAP // 2, height - 8), RULE)
        canvas.paste(panel, (left, 0))
        left += panel.width + GAP
    return canvas
