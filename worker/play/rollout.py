"""Rollouts of whole episodes, one episode per environment at a time.

Legend: E episodes, B environments, T steps of an episode.
"""

import time
from collections.abc import Callable, Iterator

import numpy as np

from tangram_core.agent import Actor
from tangram_core.arrays import Ints
from tangram_core.seeding import episode_generator
from tangram_core.spec import Array, Arrays, Episodes, EpisodeSpec
from tangram_core.task import Chooser, Env, Generators, History, Played

# Numbers of episodes (B,), a random generator for each -> their first observations.
Begin = Callable[[Ints, Generators], Arrays]


def greedy(actor: Actor) -> Chooser:
    """The actor's policy without exploration."""
    return lambda seen, past, _: actor.act(seen, past)


def parts(episodes: Episodes, size: int) -> Iterator[Episodes]:
    """Split episodes into parts of at most `size`, as views without copies."""
    for first in range(0, episodes.count, size):
        yield episodes.at(slice(first, first + size))


def play(
    env: Env,
    spec: EpisodeSpec,
    choose: Chooser,
    generator: Callable[[int], np.random.Generator],
    count: int,
    *,
    begin: Begin | None = None,
    facts: bool = False,
    go_on: Callable[[], bool] = lambda: True,
) -> Played:
    """Play `count` episodes, one per environment at a time.

    Args:
        env: the vector of environments.
        spec: shapes of the task's episodes.
        choose: the policy.
        generator: number of an episode, from 0 -> its random generator. The generator sets up the
            episode and then serves `choose`, so episodes played together are independent.
        count: number of episodes. In the last group, spare environments repeat the first episodes.
        begin: replaces the reset of the environment.
        facts: whether to record `env.facts()` at every moment.
        go_on: called before each action; if it returns False, play ends and unfinished episodes
            are left out.
    """
    whole = -(-count // env.count) * env.count
    room = _Room(spec, whole, facts)
    for first in range(0, whole, env.count):
        numbers = np.arange(first, first + env.count) % count
        generators = [generator(i) for i in numbers.tolist()]
        seen = env.reset(generators) if begin is None else begin(numbers, generators)
        if not _play_group(env, choose, generators, seen, room.at(first, env.count), go_on):
            return room.played(first)
    return room.played(count)


class _Room:
    """Arrays of whole episodes, and the rows that are being filled."""

    def __init__(self, spec: EpisodeSpec, count: int, facts: bool) -> None:
        self.spec, self.episodes = spec, spec.empty(count)
        self.facts: dict[str, Array] | None = {} if facts else None
        self.seconds, self.chose = np.zeros((2, count))
        self.rows = slice(0, 0)

    def at(self, first: int, count: int) -> "_Room":
        """This object, with `count` rows from `first` on selected for filling."""
        self.rows = slice(first, first + count)
        return self

    def look(self, seen: Arrays, env: Env, t: int) -> None:
        """Record the observations, and the facts of the environments, at a moment."""
        for field in self.spec.fields:
            if field.per == "moment":
                self.episodes[field.name][self.rows, t] = seen[field.name]
            elif field.per == "step" and t:
                self.episodes[field.name][self.rows, t - 1] = seen[field.name]
            elif field.per == "episode" and not t:
                self.episodes[field.name][self.rows] = seen[field.name]
        if self.facts is None:
            return
        for name, value in env.facts().items():
            if name not in self.facts:
                shape = (len(self.seconds), self.spec.horizon + 1, *value.shape[1:])
                self.facts[name] = np.zeros(shape, value.dtype)
            self.facts[name][self.rows, t] = value

    def history(self, t: int) -> History:
        """Observations and actions of the selected rows up to moment t."""
        moments = [field.name for field in self.spec.fields if field.per == "moment"]
        seen = {name: self.episodes[name][self.rows, : t + 1] for name in moments}
        return History(seen, self.episodes.actions[self.rows, :t])

    def played(self, count: int) -> Played:
        """The first `count` episodes, as a result."""
        facts = {name: one[:count] for name, one in (self.facts or {}).items()}
        first = slice(count)
        return Played(self.episodes.at(first), facts, self.seconds[first], self.chose[first])


def _play_group(
    env: Env,
    choose: Chooser,
    generators: Generators,
    seen: Arrays,
    room: _Room,
    go_on: Callable[[], bool],
) -> bool:
    """Play one episode in every environment; False if `go_on` ended the play."""
    rows, episodes = room.rows, room.episodes
    began = time.perf_counter()
    for t in range(room.spec.horizon):
        if not go_on():
            return False
        room.look(seen, env, t)
        going = ~episodes.terminated[rows, :t].any(axis=1)
        asked = time.process_time()
        actions = choose(seen, room.history(t), generators)
        spent = time.process_time() - asked
        room.chose[rows] += spent * going / max(going.sum(), 1)
        step = env.step(actions)
        episodes.actions[rows, t], episodes.rewards[rows, t] = actions, step.rewards
        episodes.terminated[rows, t], seen = step.terminated, step.seen
    room.look(seen, env, room.spec.horizon)
    room.seconds[rows] = (time.perf_counter() - began) / env.count
    return True


class Rollout:
    """Play for learning; every episode has its own random generator.

    Attributes:
        episode: number of the next episode in this incarnation of the worker.
    """

    def __init__(
        self,
        env: Env,
        spec: EpisodeSpec,
        run_seed: int,
        role: str,
        index: int,
        incarnation: int,
    ) -> None:
        self._env, self._spec = env, spec
        self._identity = (run_seed, role, index, incarnation)
        self.episode = 0

    @property
    def envs(self) -> int:
        """Number of environments, that is of episodes played at a time."""
        return self._env.count

    def play(
        self, choose: Chooser, groups: int = 1, go_on: Callable[[], bool] = lambda: True
    ) -> Episodes:
        """Play the next `groups` episodes in every environment; see the function `play`."""
        first, count = self.episode, groups * self._env.count
        played = play(
            self._env,
            self._spec,
            choose,
            lambda i: episode_generator(*self._identity, first + i),
            count,
            go_on=go_on,
        )
        self.episode += played.episodes.count
        return played.episodes
