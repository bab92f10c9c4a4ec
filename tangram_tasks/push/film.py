"""Films of a finger that pushes: from above, or of the arm that holds it.

Poses between pushes are recorded; the motion during a push is simulated again.
"""

from collections.abc import Iterator
from contextlib import closing
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw

from tangram_core.arrays import Floats
from tangram_core.task import Played
from tangram_sim.drawing.game_drawing import tiles
from tangram_sim.drawing.scenes import contact_sheet, draw_scene
from tangram_sim.drawing.strokes import MARGIN, TEXT
from tangram_sim.world.arm import HOME, LIFTED, METRES, Motion, Panda
from tangram_sim.world.pushing import PushTable, Unknowns
from tangram_sim.world.stage import Stage
from tangram_tasks.push.places import ARENA, Push, corners_of, on_table, push_of

if TYPE_CHECKING:
    from tangram_tasks.push.task import Push as Task

WIDTH, PARTS = 720, 6  # pixels; frames of a push from above
FRAMES = 150  # for each episode, in the film of an arm


class Replayed:
    """One played episode, push by push."""

    def __init__(self, task: "Task", played: Played, episode: int) -> None:
        facts = {name: one[episode] for name, one in played.facts.items()}
        self.task, self.corners, self.goals = task, facts["corners"], facts["goals"][0]
        self.present = on_table(self.goals, task.layout)
        self.actions = played.episodes.actions[episode]
        self.shown = self.corners  # corners that the agent saw
        if task.config.pixels:
            self.shown = played.episodes["corners"][episode].astype(np.float64)
        self.count = int(played.episodes.lengths[episode])
        names = ("table", "spread", "finger", "centres")
        table, spread, finger, centres = (facts[name][0] for name in names)
        self.unknowns = Unknowns(table, spread, float(finger), centres)

    def push(self, number: int) -> Push | None:
        """The push with this number; None if the finger could not come down."""
        config = self.task.config
        given = self.shown[number], self.actions[number], config.finger, config.longest
        push = push_of(self.task.layout, *given)
        return None if push.refused else push

    def followed(self, table: PushTable, number: int, path: Floats) -> list[Floats]:
        """Corners (V, 2) of all tokens along a finger's path, shifted to end as recorded."""
        layout = self.task.layout
        table.place(layout.poses(self.corners[number]), self.present, self.unknowns)
        found = [self.corners[number] for _ in path]
        for at in table.follow(path):
            corners = corners_of(layout, table.poses(), self.present)
            found[at:] = [corners for _ in found[at:]]
        off = self.corners[number + 1] - found[-1]
        return [one + off * i / (len(path) - 1) for i, one in enumerate(found)]


def from_above(task: "Task", played: Played) -> Iterator[Image.Image]:
    """Frames of all episodes side by side, push after push."""
    episodes = [Replayed(task, played, e) for e in range(len(played.episodes.actions))]
    columns, size = tiles(len(episodes), WIDTH)
    with closing(PushTable(task.layout, task.config.finger)) as table:
        for number in range(max(one.count for one in episodes)):
            ways = [_way(one, table, number, size) for one in episodes]
            for frame in zip(*ways, strict=True):
                yield contact_sheet(frame, columns)


def _way(one: Replayed, table: PushTable, number: int, size: int) -> list[Image.Image]:
    layout = one.task.layout
    push = one.push(number) if number < one.count else None
    if push is None:
        last = one.corners[min(number, one.count)]
        return [draw_scene(layout, ARENA, last, one.goals, size)] * (PARTS + 1)
    path = push.begin + np.linspace(0.0, 1.0, PARTS + 1)[:, None] * push.way
    corners = one.followed(table, number, path)
    frames = [draw_scene(layout, ARENA, own, one.goals, size) for own in corners]
    unit = size * (1.0 - 2.0 * MARGIN) / ARENA
    for frame, (x, y) in zip(frames, path, strict=True):
        middle, radius = (size / 2.0 + x * unit, size / 2.0 - y * unit), one.task.config.finger
        ImageDraw.Draw(frame).circle(middle, radius * unit, TEXT)
    return frames


def from_the_side(task: "Task", played: Played) -> Iterator[Image.Image]:
    """Frames of the arm that pushes, one episode after the other."""
    for episode in range(len(played.episodes.actions)):
        one, arm = Replayed(task, played, episode), Panda()
        with closing(arm), closing(PushTable(task.layout, task.config.finger)) as table:
            stage = Stage(task.layout, arm, one.goals, one.present, task.config.finger)
            moments = list[tuple[Floats, Floats, Floats]]()
            for number in range(one.count):
                push = one.push(number)
                motion = push and arm.push(push.begin * METRES, push.way * METRES)
                if motion:
                    moments += _moments(one, table, number, motion)
            if not moments:  # nothing was pushed
                moments.append((np.array(HOME), np.array([0.0, 0.0, LIFTED]), one.corners[0]))
            for at in np.linspace(0, len(moments) - 1, min(FRAMES, len(moments))).astype(int):
                yield stage.seen(*moments[at])


def _moments(
    one: Replayed, table: PushTable, number: int, motion: Motion
) -> Iterator[tuple[Floats, Floats, Floats]]:
    """Joints, tip and corners of each moment."""
    during = one.followed(table, number, motion.pushed / METRES)
    before = motion.parts.index("push")
    for at, (joints, tip) in enumerate(zip(motion.joints, motion.tips, strict=True)):
        yield joints, tip, during[min(max(at - before, 0), len(during) - 1)]
