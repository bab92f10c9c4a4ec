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
from worker.rollout import Played
from worker.trials import Trials, greedy, with_actions

AT_ONCE = 32
FRAME_MS = 50
FRAMES_PER_ACTION = 20
MAX_FRAMES = 100  # of motion; more actions get fewer each
STILL_START, STILL_END = 10, 30  # frames
SHEET = 720  # pixels across, about
MIN_TILE, MAX_TILE = 64, 240


def play_run(config: PlayConfig) -> int:
    """Play episodes of a run, noise off, and draw them side by side over their targets.

    Returns:
        Exit status 0.

    Raises:
        RunError: a folder or a checkpoint that is missing or corrupt, or `out` is not writable.
    """
    torch.set_num_threads(1)
    (run_dir,) = config.run_dirs
    setup, played = play_episodes(load_run(run_dir), config)
    if Path(config.out).suffix == ".png":
        save_picture(config.out, [draw_sheet(setup, played, played.ends)])
    else:
        save_picture(config.out, draw_motion(setup, played))
    Console(highlight=False).print(
        f"{config.out}: {config.episodes} episodes, raw overlap {played.overlap.mean():.3f}",
        markup=False,
        soft_wrap=True,
    )
    return 0


def play_episodes(run: Run, config: PlayConfig) -> tuple[Setup, Played]:
    """The episodes that the settings name, played by a run; the task as it was played."""
    setup = with_actions(run.setup, config.actions)
    with closing(Trials(setup, config.episodes, AT_ONCE, role="play", seed=config.seed)) as trials:
        return setup, trials.play(greedy(run.policy))


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


def frames_per_action(horizon: int) -> int:
    """Fewer in long episodes: all frames of a film are in memory at a time."""
    return max(min(FRAMES_PER_ACTION, MAX_FRAMES // horizon), 1)


def motion(layout: Layout, corners: Floats, count: int) -> list[Floats]:
    """Corners (E, V, 2) at the start and at `count` equal parts of each action.

    An action turns a token by at most half a turn at constant velocity, so the pose in between is
    that share of the way along the shorter turn, in either backend; nothing is simulated again.

    Args:
        corners: (E, T + 1, V, 2) before each action and after the last.
    """
    poses = layout.poses(corners)
    way = np.diff(poses, axis=1)
    way[..., 2] = wrap(way[..., 2])
    shares = np.arange(1, count + 1) / count
    between = [
        layout.corners(poses[:, t] + share * way[:, t])
        for t in range(way.shape[1])
        for share in shares
    ]
    return [corners[:, 0], *between]
