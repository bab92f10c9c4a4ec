"""Playing whole episodes, as many at a time as there are environments.

Legend: E episodes, B environments, T steps of an episode, K tokens, V corners, A entries of an
action.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tangram_agent.types import Episodes
from tangram_sim.arrays import Bools, Floats, Singles
from tangram_sim.batch import BatchedEnv
from tangram_sim.seeding import episode_generator
from tangram_sim.targets import Sides

Generators = Sequence[np.random.Generator]
# (corners (B, V, 2), placed (B, K), goals (B, V, 2), one generator each) -> actions (B, A)
Choose = Callable[[Floats, Bools, Floats, Generators], Singles]


@dataclass(frozen=True, eq=False)
class Played:
    """B whole episodes, as the environments saw them.

    Attributes:
        corners: (B, T + 1, V, 2) before each step and after the last.
        placed: (B, T + 1, K) which tokens are placed.
        actions: (B, T, A) in [-1, 1].
        rewards: (B, T) by the reward that the run trains on.
        goals: (B, V, 2) corners of the targets.
        seen: `corners` as the policy saw them.
        seen_goals: `goals` as the policy saw them.
        overlap: (B,) raw overlap of exact polygons after the last step.
        refused: (B, T) where the action named a placed token.
        blocked: (B, T) where a token could not be set down on others.
        seconds: (B,) wall time of choosing and moving, an equal share for each of those that were
            played together.
        camera: (B,) Eq. 14 of the pictures after the last step; None without a camera.
    """

    corners: Floats
    placed: Bools
    actions: Singles
    rewards: Floats
    goals: Floats
    seen: Floats
    seen_goals: Floats
    overlap: Floats
    refused: Bools
    blocked: Bools
    seconds: Floats
    camera: Floats | None

    @property
    def starts(self) -> Floats:
        """(B, V, 2) corners of the tokens before the first action."""
        return self.corners[:, 0]

    @property
    def ends(self) -> Floats:
        """(B, V, 2) corners of the tokens after the last action."""
        return self.corners[:, -1]

    def episodes(self) -> Episodes:
        """What travels of them: what the policy saw."""
        return Episodes(
            corners=self.seen.astype(np.float32),
            placed=self.placed.astype(np.uint8),
            actions=self.actions,
            rewards=self.rewards.astype(np.float32),
            goals=self.seen_goals.astype(np.float32),
        )


def play(
    env: BatchedEnv, choose: Choose, generators: Generators, targets: Sides | None = None
) -> Played:
    """One episode in every environment.

    Args:
        env: where.
        choose: gives the actions.
        generators: one per environment: it makes the target, then the start, then whatever
            `choose` draws, so an episode does not depend on those that are played beside it.
        targets: poses (B, K, 3) and sides (B, K) to assemble instead of targets that are drawn.
    """
    env.reset(generators, targets)
    corners, seen, placed = [env.corners], [env.seen], [env.placed]
    actions, results = [], []
    began = time.perf_counter()
    for _ in range(env.horizon):
        actions.append(choose(env.seen, env.placed, env.seen_goals, generators))
        results.append(env.step(actions[-1].astype(np.float64)))
        corners.append(env.corners)
        seen.append(env.seen)
        placed.append(env.placed)
    seconds = (time.perf_counter() - began) / env.count
    return Played(
        corners=np.stack(corners, axis=1),
        placed=np.stack(placed, axis=1),
        actions=np.stack(actions, axis=1),
        rewards=np.stack([result.rewards for result in results], axis=1),
        goals=env.goals,
        seen=np.stack(seen, axis=1),
        seen_goals=env.seen_goals,
        overlap=results[-1].overlap,
        refused=np.stack([result.refused for result in results], axis=1),
        blocked=np.stack([result.blocked for result in results], axis=1),
        seconds=np.full(env.count, seconds),
        camera=results[-1].camera_rewards,
    )


def join_played(parts: Sequence[Played], count: int) -> Played:
    """The first `count` episodes of all parts, in order."""
    names = [name for name, column in vars(parts[0]).items() if column is not None]
    columns: dict[str, Any] = {name: _joined(parts, name)[:count] for name in names}
    return Played(**({"camera": None} | columns))


class Rollout:
    """Endless play for learning: every episode once, each with a generator of its own.

    Attributes:
        episode: number of the next episode in this incarnation.
    """

    def __init__(self, env: BatchedEnv, run_seed: int, role: str, index: int, incarnation: int):
        self._env = env
        self._identity = (run_seed, role, index, incarnation)
        self.episode = 0

    @property
    def envs(self) -> int:
        """Episodes that are played at a time."""
        return self._env.count

    def follow(self, updates: int) -> None:
        """Play what the curriculum has for weights of so many updates, from the next episode on."""
        sim = self._env.sim
        self._env.task = sim.stage_task(sim.stage(updates))

    def play(self, choose: Choose) -> Episodes:
        """The next `env.count` episodes."""
        numbers = range(self.episode, self.episode + self._env.count)
        generators = [episode_generator(*self._identity, number) for number in numbers]
        self.episode += self._env.count
        return play(self._env, choose, generators).episodes()


def join_episodes(parts: Sequence[Episodes]) -> Episodes:
    """All episodes of all parts, in order."""
    columns: dict[str, Any] = {name: _joined(parts, name) for name in vars(parts[0])}
    return Episodes(**columns)


def split_episodes(episodes: Episodes, size: int) -> Iterator[Episodes]:
    """The same episodes in parts of at most `size`."""
    for first in range(0, episodes.count, size):
        columns: dict[str, Any] = vars(episodes)
        yield Episodes(**{name: part[first : first + size] for name, part in columns.items()})


def _joined(parts: Sequence[Played] | Sequence[Episodes], name: str) -> npt.NDArray[Any]:
    return np.concatenate([getattr(part, name) for part in parts])
