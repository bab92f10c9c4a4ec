"""tangram-play: episodes of a finished run as an animation or as one picture."""

import math
from collections.abc import Sequence
from contextlib import closing
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from rich.console import Console

from tangram_agent.files import write_whole
from tangram_agent.runs import Run, load_run
from tangram_agent.setup import Setup
from tangram_sim.arrays import Floats
from tangram_sim.drawing import episode_sheet, save_gif
from tangram_sim.kinematics import wrap
from tangram_sim.layout import Layout
from worker.config import PlayConfig
from worker.film import frames_per_action
from worker.rollout import Played
from worker.show import Show, end_picture, film_pictures, puzzle_show, show_live
from worker.trials import Trials, greedy, with_actions

AT_ONCE = 32
FRAME_MS = 50
STILL_START, STILL_END = 10, 30  # frames
SHEET = 720  # pixels across, about
MIN_TILE, MAX_TILE = 64, 240


def play_run(config: PlayConfig) -> int:
    """Play puzzles or random episodes of a run, noise off, and draw them side by side.

    Returns:
        Exit status 0.

    Raises:
        RunError: a folder or a checkpoint that is missing or corrupt, or `out` is not writable.
        ConfigError: puzzles that the run cannot play.
        TangramError: `live` without a display.
    """
    torch.set_num_threads(1)
    (run_dir,) = config.run_dirs
    show = make_show(load_run(run_dir), config)
    if config.live:
        show_live(show)
        return 0
    save_picture(config.out, _frames(show, config.out))
    Console(highlight=False).print(f"{config.out}: {show.told()}", markup=False, soft_wrap=True)
    return 0


def make_show(run: Run, config: PlayConfig) -> Show:
    """What the settings name, played by a run.

    Raises:
        ConfigError: puzzles that the run cannot play.
    """
    if config.plays_puzzles:
        return puzzle_show(run, config)
    setup, played = play_episodes(run, config)
    titles = [f"target {i + 1}" for i in range(config.episodes)]
    return Show(setup, played, titles, "episodes")


def play_episodes(run: Run, config: PlayConfig) -> tuple[Setup, Played]:
    """The episodes that the settings name, played by a run; the task as it was played."""
    setup = with_actions(run.setup, config.actions)
    with closing(Trials(setup, config.episodes, AT_ONCE, role="play", seed=config.seed)) as trials:
        return setup, trials.play(greedy(run.policy))


def _frames(show: Show, out: str) -> list[Image.Image]:
    """One picture of the ends, or the film."""
    setup, played = show.setup, show.played
    still = Path(out).suffix == ".png"
    if setup.layout.tokens > 1:
        return [end_picture(show)] if still else with_stills(film_pictures(show))
    return [draw_sheet(setup, played, played.ends)] if still else draw_motion(setup, played)


def save_picture(out: str, frames: Sequence[Image.Image]) -> None:
    """Write one frame as a PNG or all of them as a GIF, whole or not at all.

    Raises:
        RunError: `out` is not writable.
    """
    picture = BytesIO()
    if Path(out).suffix == ".png":
        frames[-1].save(picture, format="PNG")
    else:
        save_gif(frames, picture, FRAME_MS)
    write_whole(Path(out), picture.getvalue())


def draw_sheet(setup: Setup, played: Played, corners: Floats, width: int = SHEET) -> Image.Image:
    """One tile for each of E episodes while its tokens are at corners (E, V, 2).

    Args:
        width: of all tiles of a row together, about, in pixels.
    """
    columns = math.ceil(math.sqrt(len(corners)))
    size = min(max(width // columns, MIN_TILE), MAX_TILE)
    scenes = (played.starts, corners, played.goals)
    return episode_sheet(setup.layout, setup.sim.arena, *scenes, columns, size)


def draw_motion(setup: Setup, played: Played) -> list[Image.Image]:
    """The episodes' frames: start, every action as a motion at constant velocity, end."""
    count = frames_per_action(played.actions.shape[1])
    return with_stills(
        [
            draw_sheet(setup, played, corners)
            for corners in motion(setup.layout, played.corners, count)
        ]
    )


def with_stills(frames: list[Image.Image]) -> list[Image.Image]:
    """The same film with a rest before and after."""
    return [frames[0]] * STILL_START + frames + [frames[-1]] * STILL_END


def motion(layout: Layout, corners: Floats, count: int) -> list[Floats]:
    """Corners (E, V, 2) at the start and at `count` equal parts of each action.

    An action turns a token by at most half a turn at constant velocity, so the pose in between is
    that share of the way along the shorter turn, in either backend; nothing is simulated again.

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
