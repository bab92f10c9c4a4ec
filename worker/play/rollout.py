"""Playing whole episodes, as many at a time as there are environments.

Legend: E episodes, B environments, T steps of an episode, K tokens, V corners, A entries of an
action.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tangram_agent.setup import Setup
from tangram_agent.types import Past
from tangram_core.arrays import Bools, Floats, Pixels, Singles
from tangram_core.seeding import episode_generator
from tangram_core.spec import Episodes
from tangram_sim.batch import BatchedEnv
from tangram_sim.sight.lens import View
from tangram_sim.tasks.targets import Sides

AT_ONCE = 32

Generators = Sequence[np.random.Generator]
# (corners (B, V, 2), placed (B, K), goals (B, V, 2), one generator each, what was seen and done
# before) -> actions (B, A)
Choose = Callable[[Floats, Bools, Floats, Generators, Past], Singles]


@dataclass(frozen=True, eq=False)
class Played:
    """E whole episodes: what travels of them, and what only the environments know.

    Attributes:
        episodes: corners and goals as the policy saw them, its actions and their rewards.
        corners: (E, T + 1, V, 2) as they are, before each step and after the last.
        goals: (E, V, 2) corners of the targets as they are.
        overlap: (E,) raw overlap of exact polygons after the last step.
        refused: (E, T) where the action named a placed token.
        blocked: (E, T) where a token could not be set down on others.
        seconds: (E,) wall time of choosing and moving, an equal share for each of those that were
            played together.
        slowest: (E,) processor time of their slowest choice, in seconds.
        camera: (E,) Eq. 14 of the pictures after the last step; None without a camera.
        pictures: (E, T + 1, P, P) that were shown to the agent; None where it sees no pictures.
    """

    episodes: Episodes
    corners: Floats
    goals: Floats
    overlap: Floats
    refused: Bools
    blocked: Bools
    seconds: Floats
    slowest: Floats
    camera: Floats | None
    pictures: Pixels | None

    @property
    def starts(self) -> Floats:
        """(E, V, 2) corners of the tokens before the first action."""
        return self.corners[:, 0]

    @property
    def ends(self) -> Floats:
        """(E, V, 2) corners of the tokens after the last action."""
        return self.corners[:, -1]

    @staticmethod
    def empty(env: BatchedEnv, count: int) -> "Played":
        """Room for so many episodes of an environment."""
        steps, corners = env.horizon, env.layout.corner_count
        pictures = None
        if env.sight is not None:
            side = env.sim.pixels
            pictures = np.empty((count, steps + 1, side, side), np.uint8)
        return Played(
            episodes=env.spec.empty(count),
            corners=np.empty((count, steps + 1, corners, 2)),
            goals=np.empty((count, corners, 2)),
            overlap=np.empty(count),
            refused=np.empty((count, steps), np.bool_),
            blocked=np.empty((count, steps), np.bool_),
            seconds=np.empty(count),
            slowest=np.zeros(count),
            camera=np.empty(count) if env.sim.pixels else None,
            pictures=pictures,
        )

    def first(self, count: int) -> "Played":
        """The first episodes, nothing copied."""
        cut: dict[str, Any] = {
            name: rows[:count] for name, rows in vars(self).items() if isinstance(rows, np.ndarray)
        }
        return replace(self, episodes=self.episodes.at(slice(count)), **cut)


def parts(episodes: Episodes, size: int) -> Iterator[Episodes]:
    """The same episodes, at most `size` at a time, nothing copied."""
    for first in range(0, episodes.count, size):
        yield episodes.at(slice(first, first + size))


def at_once(setup: Setup) -> int:
    """Most episodes to play at a time where they are shown or scored.

    One of an agent that looks ahead: plans of many take gigabytes, and save a tenth of the time.
    """
    return AT_ONCE if setup.agent.beam == 1 else 1


def play(
    env: BatchedEnv,
    choose: Choose,
    generator: Callable[[int], np.random.Generator],
    count: int,
    targets: Sides | None = None,
    go_on: Callable[[], bool] = lambda: True,
    views: Sequence[View] | None = None,
) -> Played:
    """So many episodes, as many at a time as there are environments.

    Args:
        env: where.
        choose: gives the actions.
        generator: of the episode with this number, from 0: it makes the target, then the start,
            then whatever `choose` draws, so an episode does not depend on those played beside it.
        count: of episodes; the environments that have none left at the end play the first again.
        targets: poses (E, K, 3) and sides (E, K) to assemble instead of targets that are drawn.
        go_on: asked before each action; if not, the episodes that are being played are left out
            of what is returned.
        views: E, how these targets were seen before; see `BatchedEnv.reset`.
    """
    whole = -(-count // env.count) * env.count
    played = Played.empty(env, whole)
    for first in range(0, whole, env.count):
        numbers = np.arange(first, first + env.count) % count
        these = None if targets is None else (targets[0][numbers], targets[1][numbers])
        seen = None if views is None else [views[i] for i in numbers.tolist()]
        generators = [generator(i) for i in numbers.tolist()]
        env.reset(generators, these, seen)
        if not _play_group(env, choose, generators, played, first, go_on):
            return played.first(first)
    return played.first(count)


def _play_group(
    env: BatchedEnv,
    choose: Choose,
    generators: Generators,
    played: Played,
    first: int,
    go_on: Callable[[], bool],
) -> bool:
    """The episode in every environment, into the rows from `first` on; False if told to end."""
    rows, seen = slice(first, first + env.count), played.episodes
    seen["goals"][rows], played.goals[rows] = env.seen_goals, env.goals
    if env.sight is not None:
        seen["goals_seen"][rows] = env.sight.goals_sure
    began = time.perf_counter()
    for t in range(env.horizon):
        if not go_on():
            return False
        _look(env, played, rows, t)
        found = None if env.sight is None else seen["seen"][rows, : t + 1]
        past = Past(seen["corners"][rows, :t], seen.actions[rows, :t], found)
        asked = time.process_time()
        actions = choose(env.seen, env.closed, env.seen_goals, generators, past)
        spent = time.process_time() - asked
        played.slowest[rows] = np.maximum(played.slowest[rows], spent)
        result = env.step(actions.astype(np.float64))
        seen.actions[rows, t], seen.rewards[rows, t] = actions, result.rewards
        played.refused[rows, t], played.blocked[rows, t] = result.refused, result.blocked
    _look(env, played, rows, env.horizon)
    played.seconds[rows] = (time.perf_counter() - began) / env.count
    played.overlap[rows] = result.overlap
    if played.camera is not None:
        played.camera[rows] = result.camera_rewards
    return True


def _look(env: BatchedEnv, played: Played, rows: slice, t: int) -> None:
    seen, sight = played.episodes, env.sight
    played.corners[rows, t], seen["corners"][rows, t] = env.corners, env.seen
    seen["placed"][rows, t] = env.placed
    if t:
        seen.terminated[rows, t - 1] = env.placed.all(axis=1)
    if sight is not None and played.pictures is not None:
        # Of several tokens one may have left the picture; alone it would be all that is to be seen.
        seen["seen"][rows, t] = ~sight.missing | (sight.away & (env.layout.tokens > 1))
        played.pictures[rows, t] = env.pictures


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

    def play(
        self, choose: Choose, groups: int = 1, go_on: Callable[[], bool] = lambda: True
    ) -> Episodes:
        """The next episodes, `groups` times one in every environment; see `play`."""
        first, count = self.episode, groups * self._env.count
        played = play(
            self._env,
            choose,
            lambda i: episode_generator(*self._identity, first + i),
            count,
            go_on=go_on,
        )
        self.episode += played.episodes.count
        return played.episodes
