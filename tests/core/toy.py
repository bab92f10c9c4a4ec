"""A goal environment of numpy alone, registered as gymnasium's: a point on a square."""

from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

Array = npt.NDArray[Any]
HORIZON = 10


class Toy(gymnasium.Env[dict[str, Array], Array]):
    """It moves at most 0.2 at a time and ends, as Panda's do, within 0.3 of its goal."""

    def __init__(self, **changes: Any) -> None:
        goal = spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.observation_space = spaces.Dict(
            {"observation": goal, "achieved_goal": goal, "desired_goal": goal}
        )
        self.action_space = spaces.Box(-0.2, np.full(2, 0.1, np.float32), dtype=np.float32)
        for name, value in changes.items():
            setattr(self, name, value)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.place, self.goal = self.np_random.uniform(-0.5, 0.5, (2, 2))
        return self._seen(), {}

    def step(self, action: Array) -> Any:
        assert self.action_space.contains(action)
        self.place = np.clip(self.place + action, -1, 1)
        reward = float(self.compute_reward(self.place, self.goal, {}))
        return self._seen(), reward, reward == 0.0, False, {"is_success": reward == 0.0}

    def compute_reward(self, achieved: Array, desired: Array, info: Any) -> Array:
        return -(np.linalg.norm(achieved - desired, axis=-1) > 0.3).astype(np.float32)

    def _seen(self) -> dict[str, Array]:
        return {
            "observation": self.place.copy(),
            "achieved_goal": self.place.copy(),
            "desired_goal": self.goal.copy(),
        }


class OneByOne(Toy):
    """Its reward takes one goal at a time."""

    def compute_reward(self, achieved: Array, desired: Array, info: Any) -> Array:
        return -np.float32(np.linalg.norm(achieved - desired) > 0.3)


class Pays(Toy):
    """It pays something for the action as well."""

    def step(self, action: Array) -> Any:
        seen, reward, *more = super().step(action)
        return seen, reward - float(np.square(action).sum()), *more


class Ends(Toy):
    """It ends by chance, which no goal tells."""

    def step(self, action: Array) -> Any:
        seen, reward, _, *more = super().step(action)
        return seen, reward, bool(self.np_random.random() < 0.5), *more


class Untold(Toy):
    """It does not say what is a success."""

    def step(self, action: Array) -> Any:
        return *super().step(action)[:4], {}


class Wanders(Toy):
    """Its goal moves within an episode."""

    def step(self, action: Array) -> Any:
        self.goal = self.goal + 0.01
        return super().step(action)


class Wears(Toy):
    """Every episode begins a little further away."""

    worn = 0.0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.worn += 0.001
        self.place = self.place + self.worn
        return self._seen(), {}


PICTURE = spaces.Dict(
    {
        "observation": spaces.Box(0, 255, (8, 8, 3), np.uint8),
        "achieved_goal": spaces.Box(-1, 1, (2,)),
        "desired_goal": spaces.Box(-1, 1, (2,)),
    }
)
for name, kind, more in (
    ("Toy-v0", Toy, {}),
    ("OneByOne-v0", OneByOne, {}),
    ("Pays-v0", Pays, {}),
    ("Ends-v0", Ends, {}),
    ("Untold-v0", Untold, {}),
    ("Wanders-v0", Wanders, {}),
    ("Wears-v0", Wears, {}),
    ("Pictures-v0", Toy, {"observation_space": PICTURE}),
    ("Discrete-v0", Toy, {"action_space": spaces.Discrete(3)}),
    ("Unbounded-v0", Toy, {"action_space": spaces.Box(-np.inf, np.inf, (2,))}),
    # What lies outside ends, told of rows, of one row, and of whether any of them does.
    ("Rows-v0", Toy, {"compute_terminated": lambda a, *_: (np.abs(a) > 1).any(-1)}),
    ("Row-v0", Toy, {"compute_terminated": lambda a, *_: abs(a[0]) > 1 or abs(a[1]) > 1}),
    ("Any-v0", Toy, {"compute_terminated": lambda a, *_: bool((np.abs(a) > 1).any())}),
    ("Dear-v0", Toy, {"compute_reward": lambda a, *_: -5.0 * (np.abs(a) > 2).any(-1)}),
    ("Never-v0", Toy, {"compute_terminated": lambda *_: False}),
):
    gymnasium.register(name, kind, max_episode_steps=HORIZON, kwargs=more)
gymnasium.register("Endless-v0", Toy)
