"""Playing whole episodes, as many at a time as there are environments.

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

# Numbers of episodes (B,), a generator for each -> what is observed as they begin.
Begin = Callable[[Ints, Generators], Arrays]


def greedy(actor: Actor) -> Chooser:
    """The actor as well as it can."""
    return lambda seen, past, _: actor.act(seen, past)


def exploring(actor: Actor) -> Chooser:
    """The actor as it explores."""
    return actor.act


def parts(episodes: Episodes, size: int) -> Iterator[Episodes]:
    """The same episodes, at most `size` at a time, nothing copied."""
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
    """So many episodes, as many at a time as there are environments.

    Args:
        env: where.
        spec: of the task.
        choose: gives the actions.
        generator: of the episode with this number, from 0: it makes the episode, then whatever
            `choose` draws, so an episode does not depend on those played beside it.
        count: of episodes; the environments that have none left at the end play the first again.
        begin: in place of the environment's own reset.
        facts: whether what only the environments know is kept, too.
        go_on: asked before each action; if not, the episodes that are being played are left out
            of what is returned.
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
    """Room for whole episodes, and the rows of it that are being filled."""

    def __init__(self, spec: EpisodeSpec, count: int, facts: bool) -> None:
        self.spec, self.episodes = spec, spec.empty(count)
        self.facts: dict[str, Array] | None = {} if facts else None
        self.seconds, self.chose = np.zeros((2, count))
        self.rows = slice(0, 0)

    def at(self, first: int, count: int) -> "_Room":
        """The same, to be filled from there on."""
        self.rows = slice(first, first + count)
        return self

    def look(self, seen: Arrays, env: Env, t: int) -> None:
        """Keep what is observed at a moment, and what the environments know."""
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
        """What was until this moment."""
        moments = [field.name for field in self.spec.fields if field.per == "moment"]
        seen = {name: self.episodes[name][self.rows, : t + 1] for name in moments}
        return History(seen, self.episodes.actions[self.rows, :t])

    def played(self, count: int) -> Played:
        """The first episodes."""
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
    """The episode in every environment; False if told to end."""
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
    """Endless play for learning: every episode once, each with a generator of its own.

    Attributes:
        episode: number of the next episode in this incarnation.
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
        """Episodes that are played at a time."""
        return self._env.count

    def play(
        self, choose: Chooser, groups: int = 1, go_on: Callable[[], bool] = lambda: True
    ) -> Episodes:
        """The next episodes, `groups` times one in every environment; see `play`."""
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
