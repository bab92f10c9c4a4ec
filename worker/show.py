"""What tangram-play shows of several tokens: puzzles or random targets, as pictures or live."""

import time
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np
from PIL import Image

from tangram_agent.runs import Run
from tangram_agent.setup import Setup
from tangram_sim.drawing import contact_sheet
from tangram_sim.errors import ConfigError
from tangram_sim.game_drawing import Held, captions, draw_game, figure_sheet, tiles
from tangram_sim.strokes import SILHOUETTE, colour_of
from tangram_sim.window import Window
from worker.config import MAX_SHOWN, PlayConfig
from worker.film import Frame, film
from worker.puzzles import find_figures, play_figures
from worker.rollout import Played
from worker.trials import greedy, with_actions

WIDTH = 960  # pixels across a film, about
FRAME_S = 0.04  # of a window
PAUSE_S = 1.5  # before and after each scene in it
CARRIED = 0.25  # height of a carried token in a window, half arenas


@dataclass(frozen=True, eq=False)
class Show:
    """Episodes that were played to be looked at.

    Attributes:
        setup: the task as it was played.
        played: E episodes.
        titles: what each is called.
        kind: what all are called.
    """

    setup: Setup
    played: Played
    titles: list[str]
    kind: str

    def told(self) -> str:
        """What was shown and how well it went, in words."""
        mean = float(self.played.overlap.mean())
        score = f"covered {mean:.3f}" if self.kind == "puzzles" else f"raw overlap {mean:.3f}"
        return f"{len(self.titles)} {self.kind}, {score}"


def puzzle_show(run: Run, config: PlayConfig) -> Show:
    """The puzzles that the settings name, their pieces laid out beside them at first.

    Raises:
        ConfigError: puzzles that the run cannot play, or too many of them.
    """
    setup = with_actions(run.setup, config.actions)
    setup = replace(setup, sim=replace(setup.sim, starts="outside"))
    found = find_figures(config.puzzles, setup, config.puzzle)
    if len(found.figures) > MAX_SHOWN:
        raise ConfigError(
            f"there are {len(found.figures)} puzzles, at most {MAX_SHOWN} are shown: name some, as "
            f"in puzzle=[{found.figures[0].name}]"
        )
    played = play_figures(setup, found.figures, greedy(run.policy), config.seed)
    return Show(setup, played, found.titles, "puzzles")


def end_picture(show: Show) -> Image.Image:
    """The ends of all episodes."""
    layout, arena, played = show.setup.layout, show.setup.sim.arena, show.played
    return figure_sheet(layout, arena, played.ends, played.goals, show.titles)


def film_pictures(show: Show) -> list[Image.Image]:
    """All episodes side by side, piece after piece."""
    layout, played = show.setup.layout, show.played
    below = [
        captions(layout, played.corners[:, t], played.goals, show.titles)
        for t in range(played.corners.shape[1])
    ]
    return [_picture(show, frame, below[frame.done]) for frame in film(show.setup, played)]


def _picture(show: Show, frame: Frame, below: list[str]) -> Image.Image:
    layout, arena = show.setup.layout, show.setup.sim.arena
    columns, size = tiles(len(below), WIDTH)
    corners = frame.corners(layout)
    scenes = [
        draw_game(layout, arena, corners[e], show.played.goals[e], size, _held(frame, e))
        for e in range(len(below))
    ]
    return contact_sheet(scenes, columns, below)


def _held(frame: Frame, episode: int) -> Held | None:
    token = int(frame.held[episode])
    if token < 0:
        return None
    return Held(token, frame.height, bool(frame.stopped[episode]))


def show_live(show: Show) -> None:
    """Play the episodes one after the other in a window, until the last ends or it is closed.

    Raises:
        TangramError: no display.
        ConfigError: no engine to open a window.
    """
    try:
        # Only here: other pictures need no engine.
        from tangram_sim.physics import open_window  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"live=true needs PyBullet ({error}): install pybullet, or leave live out"
        ) from None
    layout, played = show.setup.layout, show.played
    colours = [_unit(colour_of(k)) for k in range(layout.tokens)]
    frames = film(show.setup, played)
    colours.append(_unit(SILHOUETTE))
    with closing(open_window(layout, show.setup.sim.arena, colours)) as window:
        for e in range(len(played.ends)):
            if not window.is_open:
                return
            window.show_target(layout.poses(played.goals[e]), layout.flipped(played.goals[e]))
            _play_scene(window, frames, e)


def _play_scene(window: Window, frames: list[Frame], episode: int) -> None:
    """One episode at its pace: a slow machine leaves frames out."""
    _put(window, frames[0], episode)
    time.sleep(PAUSE_S)
    began = time.monotonic()
    for i, frame in enumerate(frames):
        early = began + i * FRAME_S - time.monotonic()
        if not window.is_open:
            return
        if early > -FRAME_S or frame is frames[-1]:
            _put(window, frame, episode)
            time.sleep(max(early, 0.0))
    time.sleep(PAUSE_S)


def _put(window: Window, frame: Frame, episode: int) -> None:
    held = np.arange(frame.poses.shape[1]) == frame.held[episode]
    heights = np.where(held, CARRIED * frame.height, 0.0)
    window.show(frame.poses[episode], frame.rolls[episode], heights)


def _unit(colour: tuple[int, int, int]) -> tuple[float, ...]:
    return tuple(channel / 255.0 for channel in colour)
