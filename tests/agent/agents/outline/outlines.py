"""Small games of outlines that the tests of their agent share."""

from typing import Any

import numpy as np

from tangram_core.arrays import Floats
from tangram_core.setup import Setup
from tangram_core.spec import Episodes
from tangram_sim.geometry.rings import as_rows, covered_area
from tests.agent.builders import SMALL, setup
from tests.sim.builders import SEVEN

TWO = {"shapes": ["small_triangle", "small_triangle"], "scale": 1.0}
ALL = {"shapes": list(SEVEN), "scale": 0.6}
AGENT = {"kind": "outline", "copies": 3}
SIM = {"observe": "silhouette", "starts": "outside", "targets": "connected"}


def outline_setup(
    tokens: dict[str, Any] = TWO,
    agent: dict[str, Any] | None = None,
    net: dict[str, Any] | None = None,
    **sim: Any,
) -> Setup:
    """A kinematic one with a small network, of corners unless another one is given."""
    flips = {"allow_flip": True} if "parallelogram" in tokens["shapes"] else {}
    own = AGENT | (agent or {})
    return setup(tokens, own, net or SMALL, **(SIM | flips | sim))


def played_in(made: Setup, ways: list[Floats], goal: Floats) -> Episodes:
    """One episode: tokens in order go to poses (K, 3), each list entry after one step.

    Args:
        made: the task.
        ways: poses (K, 3) before each step and after the last.
        goal: (K, 3) poses of the target's pieces.
    """
    layout = made.task.layout
    corners = np.stack([layout.corners(poses) for poses in ways])[None].astype(np.float32)
    placed = np.tril(np.ones((len(ways), layout.tokens), np.uint8), -1)[None]
    outline = covered_area(layout.corners(goal), layout)
    return Episodes(
        {
            "corners": corners,
            "placed": placed,
            "goals": as_rows(outline, layout, made.task.goal_rows)[None].astype(np.float32),
            "actions": np.zeros((1, len(ways) - 1, made.task.spec.action_size), np.float32),
            "rewards": np.zeros((1, len(ways) - 1), np.float32),
            "terminated": placed[:, 1:].all(axis=2).astype(np.uint8),
        }
    )
