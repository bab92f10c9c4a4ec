"""tangram-play: episodes of a run as an animation, a picture or data."""

import json
import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageOps
from rich.console import Console

from tangram_agent.runs import Run, load_changed
from tangram_core import scores
from tangram_core.agent import AT_ONCE
from tangram_core.arrays import Floats
from tangram_core.errors import ConfigError
from tangram_core.run.code import argument
from tangram_core.run.outcome import plural
from tangram_core.store.files import write_whole
from tangram_game.config import MAX_SHOWN, PlayConfig, source_and_names
from tangram_game.figures.photographs import draw_photograph, read_photograph
from tangram_game.figures.puzzles import by, find_figures, play_figures
from tangram_game.figures.silhouettes import Shown, draw_silhouette, read_silhouette
from tangram_game.show.film import WIDTH, Show, film_pictures, frames_per_action
from tangram_game.show.views import beside, camera_sheets
from tangram_sim.drawing.game_drawing import figure_sheet, tiles
from tangram_sim.drawing.scenes import episode_sheet, save_gif, save_mp4
from tangram_sim.drawing.strokes import FRAME, PAPER
from tangram_sim.geometry.layout import Layout
from tangram_sim.motion.kinematics import wrap
from tangram_tasks.metrics import SOLVED, assembled
from tangram_tasks.place import Place
from tangram_tasks.played import Played
from worker.play.rollout import greedy
from worker.score.test_set import FixedTests

FRAME_MS = 50
STILL_START, STILL_END = 10, 30  # frames
SHOWN = "what the agent is shown"
SEEN = 30  # frames of the picture with the target, before a film
SHEET = 720  # pixels across, about
MIN_TILE, MAX_TILE = 64, 240
GAP = 24  # pixels between pictures


def play_run(config: PlayConfig, silhouette: Shown | None = None) -> int:
    """Play puzzles, a photograph or random episodes without exploration, and draw them.

    Args:
        config: the settings.
        silhouette: the filled silhouette, if its search is done.

    Returns:
        Exit status 0.

    Raises:
        RunError: a folder or a checkpoint is missing or corrupt, or `out` is not writable.
        ConfigError: the run cannot play the puzzles.
    """
    torch.set_num_threads(1)
    run = load_changed(config.run, config.changes)
    figures = (config.puzzle, config.target, config.silhouette)
    if isinstance(run.setup.task, Place) or figures != (None, None, None):
        show = make_show(run, config, silhouette)
        line = show.told()
        save_picture(config.out, _frames(show, config.out))
    else:
        line = _shown(run, config)
    Console(highlight=False).print(f"{config.out}: {line}", markup=False, soft_wrap=True)
    return 0


def _shown(run: Run, config: PlayConfig) -> str:
    """Write a plan, a film or a picture of a task other than `Place`; returns the line to print."""
    task, kind = run.setup.task, Path(config.out).suffix
    count = 1 if kind == ".json" else config.episodes
    with closing(FixedTests(task, count, AT_ONCE, role="play", seed=config.seed)) as tests:
        played = tests.play(greedy(run.actor))
    shown = scores.told(task.scores[: scores.SHOWN], task.score(played))
    line = f"{plural(count, 'episode')}, {shown}"
    if kind == ".json":
        plan = json.dumps(task.plan(played), indent=1) + "\n"
        write_whole(Path(config.out), plan.encode())
        return line
    film = None if kind == ".png" else task.film(played)
    picture = task.draw(played) if film is None else None
    frames = [] if picture is None else [picture]
    if film is None and not frames:
        raise ConfigError(
            f"{run.folder} plays task={run.setup.task_kind}, which draws no pictures: "
            f"tangram-eval {argument('run_dir', run.folder)} scores it"
        )
    save_picture(config.out, [Image.fromarray(one) for one in film or frames])
    return line


def make_show(run: Run, config: PlayConfig, silhouette: Shown | None = None) -> Show:
    """Play what the settings name; see `play_run`.

    Raises:
        ConfigError: the run cannot play the target.
    """
    if config.puzzle is not None:
        return puzzle_show(run, config)
    if config.target is not None:
        return photograph_show(run, config, config.target)
    if config.silhouette is not None:
        name = config.silhouette
        found = silhouette or read_silhouette(name, f"silhouette={name}", run.task)
        return silhouette_show(run, config, found)
    titles = [f"target {i + 1}" for i in range(config.episodes)]
    return Show(run.task, play_episodes(run, config), titles, "episode")


def play_episodes(run: Run, config: PlayConfig) -> Played:
    """Play episodes with random targets."""
    with closing(
        FixedTests(run.task, config.episodes, AT_ONCE, role="play", seed=config.seed)
    ) as tests:
        return Played.of(tests.play(greedy(run.actor)))


def puzzle_show(run: Run, config: PlayConfig) -> Show:
    """Play the puzzles that the settings name; the tokens start beside the target.

    Raises:
        ConfigError: the run cannot play the puzzles, or there are too many.
    """
    task = _beside(run.task)
    source, names = source_and_names(config.puzzle or ())
    figures = find_figures(source, task, names, config.turns)
    if len(figures) > MAX_SHOWN:
        first = ",".join((source, figures[0].name) if source else (figures[0].name,))
        raise ConfigError(
            f"{len(figures)} figures are too many to show, at most {MAX_SHOWN}: name some, as in "
            f"puzzle=[{first}], or lower turns"
        )
    played = play_figures(task, figures, by(run.actor), config.seed)
    return Show(task, played, [one.title for one in figures], "puzzle")


def photograph_show(run: Run, config: PlayConfig, target: str) -> Show:
    """Play the figure in a photograph; the tokens start anywhere.

    Raises:
        ConfigError: the photograph does not show the run's tokens.
    """
    photograph = read_photograph(target, run.task)
    figure, player = photograph.figure, by(run.actor)
    played = play_figures(run.task, [figure], player, config.seed, touching=False)
    seen = draw_photograph(photograph, run.task.layout, tiles(1, WIDTH)[1])
    return Show(run.task, played, [figure.title], "photograph", seen)


def silhouette_show(run: Run, config: PlayConfig, found: Shown) -> Show:
    """Play a silhouette; the tokens start outside of it.

    A run lays the tokens as the search found. An agent of outlines sees only the outline of what
    the search found, which equals the silhouette within the search's tolerance.
    """
    task, fills = _beside(run.task), run.task.outlines
    played = play_figures(task, [found.figure], by(run.actor), config.seed)
    seen = draw_silhouette(found, task.layout, bare=SHOWN * fills)
    told = found.told
    if fills and found.exact:
        solved = assembled(task.layout, played).iou[0] >= SOLVED
        told = "filled by the run itself" if solved else f"not filled by the run itself, but {told}"
    return Show(task, played, [found.figure.title], "silhouette", seen, told)


def _beside(task: Place) -> Place:
    """The same task with all tokens beside the target at first."""
    return replace(task, sim=replace(task.sim, starts="outside"))


def _frames(show: Show, out: str) -> list[Image.Image]:
    """Frames of the film, or one picture of the ends."""
    task, played = show.task, show.played
    game, count = task.layout.tokens > 1 or show.seen is not None, len(show.titles)
    columns, size = tiles(count, WIDTH) if game else _tiles(count, SHEET)
    sheets = camera_sheets(task, played, columns, size)
    before = [] if show.seen is None else [show.seen]  # from which the target comes
    if _is_still(out):
        ends = (played.ends, played.goals, show.titles)
        end = (
            figure_sheet(task.layout, task.sim.arena, *ends)
            if game
            else draw_sheet(task, played, played.ends)
        )
        return [side_by_side([*before, end, *sheets[-1:]])]
    frames = film_pictures(show) if game else draw_motion(task, played)
    if sheets:
        pairs = zip(frames, beside(frames, sheets), strict=True)
        frames = [side_by_side(pair) for pair in pairs]
    first = [ImageOps.pad(one, frames[0].size, color=PAPER) for one in before]
    stills = [frames[0]] * STILL_START, [frames[-1]] * STILL_END
    return [*(one for one in first for _ in range(SEEN)), *stills[0], *frames, *stills[1]]


def _is_still(out: str) -> bool:
    return Path(out).suffix == ".png"


def save_picture(out: str, frames: Sequence[Image.Image]) -> None:
    """Write one frame as a PNG or all of them as a GIF or MP4, whole or not at all.

    Raises:
        RunError: `out` is not writable.
    """
    picture = BytesIO()
    if _is_still(out):
        frames[-1].save(picture, format="PNG")
    else:
        save = save_mp4 if Path(out).suffix == ".mp4" else save_gif
        save(frames, picture, FRAME_MS)
    write_whole(Path(out), picture.getvalue())


def draw_sheet(task: Place, played: Played, corners: Floats) -> Image.Image:
    """A sheet with a tile for each of E episodes, its tokens at corners (E, V, 2)."""
    columns, size = _tiles(len(corners), SHEET)
    scenes = (played.starts, corners, played.goals)
    return episode_sheet(task.layout, task.sim.arena, *scenes, columns, size)


def _tiles(count: int, width: int) -> tuple[int, int]:
    """Number of tiles in a row of `width` pixels, and the side of a tile in pixels."""
    columns = math.ceil(math.sqrt(count))
    return columns, min(max(width // columns, MIN_TILE), MAX_TILE)


def draw_motion(task: Place, played: Played) -> list[Image.Image]:
    """Frames of the episodes: start, each action as a motion at constant velocity, end."""
    count = frames_per_action(played.episodes.actions.shape[1])
    return [
        draw_sheet(task, played, corners) for corners in motion(task.layout, played.corners, count)
    ]


def motion(layout: Layout, corners: Floats, count: int) -> list[Floats]:
    """Corners (E, V, 2) at the start and at `count` equal parts of each action.

    An action moves a token at constant velocity, and turns it by at most half a turn. So poses in
    between are interpolated along the shorter turn, for either backend. Nothing is simulated.

    Args:
        corners: (E, T + 1, V, 2) before each action and after the last.
    """
    poses, flipped = layout.poses(corners), layout.flipped(corners)
    way = np.diff(poses, axis=1)
    way[..., 2] = wrap(way[..., 2])
    shares = np.arange(1, count + 1) / count
    between = [
        layout.corners(poses[:, t] + share * way[:, t], flipped[:, t + 1])
        for t in range(way.shape[1])
        for share in shares
    ]
    return [corners[:, 0], *between]


def side_by_side(panels: Sequence[Image.Image]) -> Image.Image:
    """Pictures in a row, aligned at the top, with a rule between them."""
    height = max(panel.height for panel in panels)
    width = sum(panel.width for panel in panels) + GAP * (len(panels) - 1)
    canvas = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(canvas)
    left = 0
    for panel in panels:
        if left:
            draw.line((left - GAP // 2, 8, left - GAP // 2, height - 8), FRAME)
        canvas.paste(panel, (left, 0))
        left += panel.width + GAP
    return canvas
