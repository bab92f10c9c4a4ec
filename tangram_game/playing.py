"""Tokens played by anybody, as tables and pictures of the game take it."""

from collections.abc import Callable

import numpy as np

from tangram_core.agent import Actor
from tangram_core.arrays import Ints
from tangram_core.spec import Arrays
from tangram_core.task import Chooser, Env, Generators
from tangram_sim.sight.lens import View
from tangram_sim.targets.targets import Sides
from tangram_tasks.env import PlaceEnv
from tangram_tasks.place import Place
from tangram_tasks.played import Played
from worker.play import rollout
from worker.play.rollout import greedy
from worker.score.test_set import FixedTests

Player = Callable[[Env], Chooser]  # made for the environments in which it plays


def by(actor: Actor) -> Player:
    """What an actor plays, exploration off."""
    return lambda _: greedy(actor)


def play_tests(
    tests: FixedTests, player: Player, go_on: Callable[[], bool] = lambda: True
) -> Played:
    """The episodes of a test set."""
    return Played.of(tests.play(player(tests.env), go_on))


def play_targets(
    task: Place,
    env: PlaceEnv,
    player: Player,
    generator: Callable[[int], np.random.Generator],
    targets: Sides,
    views: list[View] | None = None,
) -> Played:
    """One episode for each of E targets, poses (E, K, 3) and sides (E, K).

    Args:
        task: what is played.
        env: where.
        player: who plays.
        generator: of the episode with this number: it makes the start.
        targets: to be assembled.
        views: E, how these targets were seen before; see `BatchedEnv.reset`.
    """

    def begin(numbers: Ints, generators: Generators) -> Arrays:
        seen = None if views is None else [views[i] for i in numbers.tolist()]
        return env.reset(generators, (targets[0][numbers], targets[1][numbers]), seen)

    choose, count = player(env), len(targets[0])
    return Played.of(
        rollout.play(env, task.spec, choose, generator, count, begin=begin, facts=True)
    )
