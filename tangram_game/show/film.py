"""Episodes of several tokens as a film: one token after the other is taken, carried and set down.

Legend: E episodes, T steps, K tokens, V corners.
"""

from dataclasses import dataclass, replace

import numpy as np
from PIL import Image

from tangram_core.arrays import Bools, Floats, Ints
from tangram_core.run.outcome import plural
from tangram_core.scores import decimal
from tangram_sim.drawing.game_drawing import Held, captions, draw_game, tiles
from tangram_sim.drawing.scenes import contact_sheet
from tangram_sim.geometry.layout import Layout
from tangram_sim.motion.actions import chosen_tokens, flips, velocities
from tangram_sim.motion.kinematics import wrap
from tangram_tasks.place import Place
from tangram_tasks.played import Played

FRAMES_PER_ACTION = 20
MAX_FRAMES = 100  # of motion; with more actions, each gets fewer
WIDTH = 960  # pixels across a film, about


@dataclass(frozen=True, eq=False)
class Show:
    """Played episodes, and their titles in a picture or a film.

    Attributes:
        task: the task as it was played.
        played: E episodes.
        titles: title of each episode.
        kind: noun for one episode, such as puzzle.
        seen: picture from which the target comes, if any.
        note: further remark for the printed line.
    """

    task: Place
    played: Played
    titles: list[str]
    kind: str
    seen: Image.Image | None = None
    note: str = ""

    def told(self) -> str:
        """Number of episodes, mean score and note, as one line of text."""
        mean = float(self.played.coverage.mean())
        note = f"; {self.note}" if self.note else ""
        return f"{plural(len(self.titles), self.kind)}, coverage {decimal(mean)}{note}"


def frames_per_action(horizon: int) -> int:
    """Frames of an action; fewer in long episodes, as memory holds all frames of a film."""
    return max(min(FRAMES_PER_ACTION, MAX_FRAMES // horizon), 1)


@dataclass(frozen=True, eq=False)
class Frame:
    """State of E scenes at one moment.

    Attributes:
        poses: (E, K, 3) poses of the tokens.
        rolls: (E, K) angles in radians about the x axis of the token's body: pi on the other side.
        held: (E,) number of the token that is moved, -1 if none is.
        height: height of that token, from 0 (on the table) to 1 (carried).
        stopped: (E,) whether that token cannot be set down at its goal.
        done: number of actions that are over.
    """

    poses: Floats
    rolls: Floats
    held: Ints
    height: float
    stopped: Bools
    done: int

    def corners(self, layout: Layout) -> Floats:
        """Corners (E, V, 2) seen from above; a token gets narrow while it is turned over."""
        pose = self.poses[..., layout.token_of_corner, :]
        cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
        x, y = layout.body.T
        y = y * np.cos(self.rolls)[..., layout.token_of_corner]
        turned: Floats = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
        return turned + pose[..., :2]

    def at_rest(self) -> "Frame":
        """The same frame with no token being moved."""
        stopped = np.zeros_like(self.stopped)
        return replace(self, held=np.full_like(self.held, -1), height=0.0, stopped=stopped)


def film(task: Place, played: Played) -> list[Frame]:
    """Frames of a film: the start, equally many for each action, and the end."""
    count = frames_per_action(played.episodes.actions.shape[1])
    moves = [_Move(task, played, t) for t in range(played.episodes.actions.shape[1])]
    frames = [move.at((i + 1) / count) for move in moves for i in range(count)]
    return [moves[0].start(), *frames, frames[-1].at_rest()]


class _Move:
    """One action in E scenes."""

    def __init__(self, task: Place, played: Played, step: int) -> None:
        layout, sim = task.layout, task.sim
        self._step = step
        ends = played.corners[:, step : step + 2]
        poses, sides = layout.poses(ends), layout.flipped(ends)
        rolls: Floats = np.pi * sides.astype(np.float64)
        self._poses, self._way = poses[:, 0], poses[:, 1] - poses[:, 0]
        self._rolls, self._roll = rolls[:, 0], rolls[:, 1] - rolls[:, 0]
        self._stopped, idle = played.blocked[:, step], played.refused[:, step]
        actions = played.episodes.actions[:, step].astype(np.float64)
        self._rows, token = np.arange(len(actions)), chosen_tokens(actions, layout.tokens)
        # A token that was stopped is shown on its way there and back.
        stopped = (self._rows[self._stopped], token[self._stopped])
        self._way[stopped] = velocities(actions, sim)[self._stopped]
        over = flips(actions, layout, sim)[self._stopped]
        self._roll[stopped] = np.where(over, np.pi - 2.0 * self._rolls[stopped], 0.0)
        self._way[..., 2] = wrap(self._way[..., 2])
        self._token, self._held = token, np.where(idle, -1, token)

    def start(self) -> Frame:
        """The frame before the action."""
        frame = Frame(self._poses, self._rolls, self._held, 0.0, self._stopped, self._step)
        return frame.at_rest()

    def at(self, share: float) -> Frame:
        """The frame after a share of the action's time in (0, 1]."""
        way = share * share * (3.0 - 2.0 * share)  # slow at start and end
        # Other tokens do not move until the carried one is set down.
        gone: Floats = np.full(self._poses.shape[:2], float(share == 1.0))
        there_and_back = 1.0 - abs(2.0 * way - 1.0)
        gone[self._rows, self._token] = np.where(self._stopped, there_and_back, way)
        return Frame(
            poses=self._poses + gone[..., None] * self._way,
            rolls=self._rolls + gone * self._roll,
            held=self._held,
            height=float(np.sin(np.pi * share) ** 0.5) if share < 1.0 else 0.0,
            stopped=self._stopped,
            done=self._step + (share == 1.0),
        )


def film_pictures(show: Show) -> list[Image.Image]:
    """Pictures of a film: all episodes side by side, token after token."""
    layout, played = show.task.layout, show.played
    below = [
        captions(layout, played.corners[:, t], played.goals, show.titles)
        for t in range(played.corners.shape[1])
    ]
    return [_picture(show, frame, below[frame.done]) for frame in film(show.task, played)]


def _picture(show: Show, frame: Frame, below: list[str]) -> Image.Image:
    layout, arena = show.task.layout, show.task.sim.arena
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
