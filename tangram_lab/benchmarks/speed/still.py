"""A goal environment with the shapes of Fetch and almost no cost, to measure learning alone."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from tangram_core.spec import Array, Arrays

ID, STEPS, NEAR = "TangramStill-v0", 50, 0.05


class Still(gymnasium.Env[Any, Any]):
    """Every step leads to a random state: 25 numbers observed, 3 in a goal, 4 in an action."""

    def __init__(self, **_: Any) -> None:
        def box(size: int, most: float) -> spaces.Box:
            return spaces.Box(-most, most, (size,), np.float32)

        goal = box(3, 10.0)
        self.action_space = box(4, 1.0)
        self.observation_space = spaces.Dict(
            {"observation": box(25, 10.0), "achieved_goal": goal, "desired_goal": goal}
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Arrays, dict[str, Any]]:
        """Draw a random desired goal and a random state."""
        super().reset(seed=seed, options=options)
        self._goal = self._drawn(3)
        return self._seen(), {}

    def step(self, action: Array) -> tuple[Arrays, float, bool, bool, dict[str, Any]]:  # noqa: ARG002
        """Go to a random state, whatever the action is."""
        seen = self._seen()
        reward = float(self.compute_reward(seen["achieved_goal"], self._goal, {}))
        return seen, reward, False, False, {"is_success": reward == 0.0}

    def compute_reward(self, achieved: Array, desired: Array, info: Any) -> Any:  # noqa: ARG002
        """Reward as in Fetch: 0 within NEAR of the desired goal, else -1."""
        return -(np.linalg.norm(achieved - desired, axis=-1) > NEAR).astype(np.float32)

    def compute_terminated(self, achieved: Array, desired: Array, info: Any) -> bool:  # noqa: ARG002
        """False: an episode never terminates early."""
        return False

    def _seen(self) -> Arrays:
        parts = {"observation": self._drawn(25), "achieved_goal": self._drawn(3)}
        return {**parts, "desired_goal": self._goal.copy()}

    def _drawn(self, size: int) -> Array:
        return self.np_random.uniform(-1.0, 1.0, size).astype(np.float32)


gymnasium.register(ID, Still, max_episode_steps=STEPS)
