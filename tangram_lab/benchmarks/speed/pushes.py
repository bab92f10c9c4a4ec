"""Pushes in a second: driven inside the engine, against a loop over its steps."""

import math

import numpy as np

from tangram_lab.benchmarks.measure import Row, Work, compare
from tangram_sim.geometry.layout import TokensConfig
from tangram_sim.world.engine import pybullet
from tangram_sim.world.pushing import _STEP, PushTable
from tangram_tasks.push.places import Push as Pushed
from tangram_tasks.push.places import begin, corners_of, push_of
from tangram_tasks.push.task import Push, PushConfig
from tangram_tasks.push.trials import middle
from tangram_tasks.register import SEVEN

COUNTS, PUSHES = (1, 2, 7), 64


def measure_pushes(runs: int) -> list[Row]:
    """With one, two and all seven tans on the table."""
    rows = []
    for count in COUNTS:
        labels = "sim", f"{count} of the seven tans", "pushes/s"
        _, ours, theirs = ways(count)
        rows.append(compare(labels, ours, ("a bare loop", theirs), runs))
    return rows


def ways(count: int) -> tuple[PushTable, Work, Work]:
    """A table, and the same pushes on it by `PushTable` and step by step."""
    task = Push(TokensConfig(SEVEN, 0.6), PushConfig(count=count))
    table, layout, rng = PushTable(task.layout, 0.04), task.layout, np.random.default_rng(0)
    tokens, starts, _ = begin(layout, count, rng)
    poses, there = np.zeros((7, 3)), np.isin(np.arange(7), tokens)
    poses[tokens] = starts
    table.place(poses, there, middle(task))
    corners, pushes = corners_of(layout, poses, there), list[Pushed]()
    while len(pushes) < PUSHES:
        named = (rng.choice(tokens) + 0.5) / 7.0 * 2.0 - 1.0
        action = np.array([named, *rng.uniform(-1.0, 1.0, 3)])
        push = push_of(layout, corners, action, 0.04, task.config.longest)
        pushes += [] if push.refused else [push]

    def ours() -> float:
        for push in pushes:
            table.lay(poses)
            table.push(push.begin, push.way)
            table.poses()
        return PUSHES

    def theirs() -> float:
        client, finger, bodies = table._client, table._pusher, table._bodies
        for push in pushes:
            table.lay(poses)
            table._finger_at(push.begin, 0.0)
            length = math.hypot(*push.way)
            steps = max(1, math.ceil(length / _STEP))
            pybullet.setPhysicsEngineParameter(
                fixedTimeStep=length / steps, numSubSteps=1, physicsClientId=client
            )
            for _ in range(steps):
                for joint, speed in enumerate((*(push.way / length), 0.0)):
                    pybullet.setJointMotorControl2(
                        finger,
                        joint,
                        pybullet.VELOCITY_CONTROL,
                        targetVelocity=speed,
                        force=1e4,
                        physicsClientId=client,
                    )
                pybullet.stepSimulation(physicsClientId=client)
            for body in bodies.values():
                pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
        return PUSHES

    return table, ours, theirs
