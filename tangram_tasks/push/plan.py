"""Pushes as a plan for a robot: way points in metres and seconds."""

from collections.abc import Iterator
from contextlib import closing, nullcontext
from typing import TYPE_CHECKING

import numpy as np

from tangram_core.arrays import Floats
from tangram_core.task import Json, Played
from tangram_sim.world.arm import BASE, LIFTED, METRES, Panda, duration, way_points
from tangram_tasks.push.film import Replayed
from tangram_tasks.push.places import ARENA

if TYPE_CHECKING:
    from tangram_tasks.push.task import Push

FRAME = "origin: middle of the table top; x points right, y away, z up; the arm stands on the left"


def plan_of(task: "Push", played: Played) -> Json:
    """Pushes of the first episode as JSON; with an arm also the angles of its joints."""
    one, layout = Replayed(task, played, 0), task.layout
    tokens = [
        {"shape": layout.shapes[token].name}
        | {
            name: [_rounded(corner * METRES) for corner in corners[layout.corners_of(token)]]
            for name, corners in (
                ("begins", one.corners[0]),
                ("belongs", one.goals),
                ("ends", one.corners[one.count]),
            )
        }
        for token in np.flatnonzero(one.present).tolist()
    ]
    arm = Panda() if task.config.hand == "panda" else None
    with closing(arm) if arm else nullcontext():
        pushes = list(_pushes(one, arm))
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


def _pushes(one: Replayed, arm: Panda | None) -> Iterator[Json]:
    """Each push as four points; times go on from push to push."""
    seconds, here = 0.0, np.array([0.0, 0.0, LIFTED])
    for push in map(one.push, range(one.count)):
        if push is None:
            continue
        begin, way = push.begin * METRES, push.way * METRES
        motion, points = arm and arm.push(begin, way), list[Json]()
        if arm and not motion:
            continue
        for part, there in way_points(begin, way):
            seconds += duration(part, float(np.linalg.norm(there - here)))
            here = there
            points.append({"part": part, "seconds": round(seconds, 6), "tip": _rounded(there)})
            if motion:
                last = max(i for i, name in enumerate(motion.parts) if name == part)
                points[-1]["joints"] = _rounded(motion.joints[last])
        yield {"points": points}


def _rounded(numbers: Floats) -> list[float]:
    return [round(float(one), 6) for one in numbers]
