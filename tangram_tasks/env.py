"""Environments of tokens on the interface of `tangram_core.task.Env`.

Legend: B environments, K tokens, V corners.
"""

from typing import TYPE_CHECKING

import numpy as np

from tangram_core.arrays import Bools, Pixels, Singles
from tangram_core.spec import Array, Arrays
from tangram_core.task import Env, Generators, Json, Purpose, Step
from tangram_sim.batch import BatchedEnv, StepResult
from tangram_sim.config import MAX_OVERLAP
from tangram_sim.sight.perception import Eye, Look
from tangram_sim.sight.pictures import coverage
from tangram_sim.targets.targets import Sides
from tangram_sim.world.world import no_opencv

if TYPE_CHECKING:
    from tangram_tasks.place import Place

PIXELS = 64  # side of the pictures in tests, if training takes none


class PlaceEnv(Env):
    """B simulated worlds of tokens, for task=place and task=fill.

    Attributes:
        world: the worlds.
    """

    def __init__(self, task: "Place", count: int, purpose: Purpose) -> None:
        """Open the worlds; purpose `test` turns the camera on, unless agents see outlines."""
        self.count, self._outlines = count, task.outlines
        shown = task.sim.observe == "silhouette"
        if purpose == "test" and not shown and not task.sim.pixels:
            task = task.with_sim(pixels=PIXELS)
        self.world = BatchedEnv(
            task.layout, task.sim, task.reward, count, make_eye(task), task.outlines
        )
        self._result: StepResult | None = None

    def reset(self, generators: Generators, targets: Sides | None = None) -> Arrays:
        """Begin an episode in every environment; see `BatchedEnv.reset`."""
        self._result = None
        self.world.reset(generators, targets)
        return self._seen()

    def step(self, actions: Singles) -> Step:
        """Play one action (B, A) in every environment."""
        self._result = self.world.step(np.asarray(actions, np.float64))
        over: Bools = np.asarray(self.world.placed.all(axis=1))
        return Step(self._seen(), self._result.rewards, over)

    def _seen(self) -> Arrays:
        world = self.world
        seen: dict[str, Array] = {"corners": world.seen, "placed": world.placed}
        if world.sight is not None:
            # One of several tokens may have left the picture and counts as seen; a single token
            # outside of the picture does not.
            several = world.layout.tokens > 1
            seen["seen"] = ~world.sight.missing | (world.sight.away & several)
            seen["closed"] = world.closed
            seen["goals_seen"] = world.sight.goals_sure
        return seen | {"goals": world.seen_goals}

    def facts(self) -> Arrays:
        """Exact corners and goals, coverage, refused and blocked actions, and what cameras saw."""
        world, result, none = self.world, self._result, np.zeros(self.count, np.bool_)
        facts: dict[str, Array] = {
            "corners": world.corners,
            "goals": world.goals,
            "coverage": np.zeros(self.count) if result is None else result.coverage,
            "refused": none if result is None else result.refused,
            "blocked": none if result is None else result.blocked,
        }
        if world.sim.pixels:
            camera = None if result is None else result.camera_rewards
            facts["camera"] = np.zeros(self.count) if camera is None else camera
        if world.sight is not None:
            facts["pictures"] = world.pictures
        return facts

    def told(self) -> Json:
        """Coverage, success, reward by pictures (Eq. 14), and why nothing moved."""
        from tangram_tasks.metrics import SOLVED, iou  # noqa: PLC0415  # scipy, no worker needs it

        world, result = self.world, self._result
        if result is None:
            return {}
        share, token = float(result.coverage[0]), int(result.tokens[0])
        solved = share
        if self._outlines:
            solved = float(iou(world.layout, world.corners, result.coverage)[0])
        info: Json = {"coverage": share, "is_success": solved >= SOLVED}
        if result.camera_rewards is not None:
            info["reward_camera"] = float(result.camera_rewards[0])
        if result.refused[0]:
            count = world.sim.actions_per_token
            info["refused"] = f"token {token} is placed already: it had its {count} actions"
        if result.blocked[0]:
            info["refused"] = (
                f"token {token} would lie on others by {result.covered[0]:.3%} of its area, "
                f"at most {MAX_OVERLAP:.3%} allowed: set it down where there is room"
            )
        return info

    def picture(self, size: int) -> Pixels:
        """Draw tokens and target of the first world; the token that moved last is marked."""
        from tangram_sim.drawing.scenes import draw_scene  # noqa: PLC0415

        world, moved = self.world, None if self._result is None else int(self._result.tokens[0])
        scene = (world.corners[0], world.goals[0], size, moved)
        return np.asarray(draw_scene(world.layout, world.sim.arena, *scene), np.uint8)

    def close(self) -> None:
        """Close all worlds."""
        self.world.close()


def make_eye(task: "Place") -> Eye | None:
    """The function that finds tokens in pictures; None if agents see no pictures.

    Raises:
        ConfigError: OpenCV is not installed.
    """
    if not task.sim.looks:
        return None
    try:
        # Imported here: it takes time and memory, and most workers see no pictures.
        from tangram_vision.pictures.seeing import see  # noqa: PLC0415
    except ImportError as error:  # OpenCV, or a library that it needs
        raise no_opencv(str(error)) from error
    layout, arena = task.layout, task.sim.arena

    def look(picture: Pixels) -> Look:
        return see(coverage(picture), layout, arena)

    return look
