"""Pushes as a plan for a robot: way points in metres and seconds."""

from contextlib import ExitStack
from typing import TYPE_CHECKING

import numpy as np

from tangram_core.arrays import Floats
from tangram_core.task import Json, Played
from tangram_sim.world.arm import BASE, METRES, Panda, duration, way_points
from tangram_tasks.push.film import Replayed
from tangram_tasks.push.places import ARENA

if TYPE_CHECKING:
    from tangram_tasks.push.task import Push

FRAME = "the origin is the middle of the table's top, x goes right, y away, z up; the arm is left"
_DIGITS = 6


def plan_of(task: "Push", played: Played) -> Json:
    """The first episode's pushes; where an arm held the finger, with the joints' angles."""
    one, layout = Replayed(task, played, 0), task.layout
    tokens = [
        {
            "shape": layout.shapes[token].name,
            "begins": _metres(one.corners[0][layout.corners_of(token)]),
            "belongs": _metres(one.goals[layout.corners_of(token)]),
            "ends": _metres(one.corners[one.count][layout.corners_of(token)]),
        }
        for token in np.flatnonzero(one.present).tolist()
    ]
    pushes, seconds, here = (
        list[Json](),
        0.0,
        np.array([0.0, 0.0, way_points(*np.zeros((2, 2)))[0][1][2]]),
    )
    with ExitStack() as opened:
        arm = Panda() if task.config.hand == "panda" else None
        if arm:
            opened.callback(arm.close)
        for number in range(one.count):
            push = one.push(number)
            if push is None:
                continue
            begin, way = push.begin * METRES, push.way * METRES
            motion = arm and arm.push(begin, way)
            points = []
            for part, there in way_points(begin, way):
                seconds += duration(part, float(np.linalg.norm(there - here)))
                point = {"part": part, "seconds": round(seconds, _DIGITS), "tip": _rounded(there)}
                if motion:
                    last = max(i for i, name in enumerate(motion.parts) if name == part)
                    point["joints"] = _rounded(motion.joints[last])
                points.append(point)
                here = there
            pushes.append({"points": points})
    return {
        "unit": "metres, seconds and radians",
        "frame": FRAME,
        "table": [ARENA * METRES, ARENA * METRES],
        "finger_radius": task.config.finger * METRES,
        "arm": {"name": "Franka Panda", "base": [*BASE]} if arm else None,
        "solved": bool(played.episodes.terminated[0].any()),
        "tokens": tokens,
        "pushes": pushes,
    }


def _metres(corners: Floats) -> list[list[float]]:
    return [_rounded(corner * METRES) for corner in corners]


def _rounded(numbers: Floats) -> list[float]:
    return [round(float(one), _DIGITS) for one in numbers]
