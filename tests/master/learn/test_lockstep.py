"""The rounds of lockstep, without sockets."""

from dataclasses import replace

import pytest

from master.learn.lockstep import Lockstep
from master.record.delivery import EpisodesArrived
from tangram_core.errors import ConfigError
from tangram_core.run.service import ServiceConfig
from tangram_core.spec import Field
from tangram_core.wire.messages import EpisodeBatch, Go
from tests.agent.builders import random_episodes
from tests.master.builders import small_setup

pytestmark = pytest.mark.fast

MADE = small_setup()
SIZE = 4


def batch(index: int, sequence: int = 1) -> EpisodesArrived:
    batch = EpisodeBatch(sequence, 0, random_episodes(MADE, SIZE, index))
    return EpisodesArrived("player", index, 1, batch, ())


def test_a_round_is_inserted_by_index_when_it_is_whole() -> None:
    lockstep, episodes = Lockstep(3, SIZE), 0
    inserted = []
    for came in (2, 0, 1):
        assert lockstep.next(episodes) is None
        lockstep.take(batch(came))
    lockstep.ordered = True
    while (found := lockstep.next(episodes)) is not None:
        lockstep.inserted(found)
        inserted.append(found.index)
        episodes += SIZE
    assert (inserted, episodes, lockstep.ordered) == ([0, 1, 2], 12, False)
    assert lockstep.begins_round(episodes)


def test_orders_follow_from_what_was_inserted() -> None:
    lockstep = Lockstep(3, SIZE)
    assert lockstep.orders(0, 0) == {i: Go(0, 0, 0, SIZE) for i in range(3)}
    assert lockstep.orders(9, 24) == {i: Go(2, 9, 8, SIZE) for i in range(3)}


def test_a_round_that_was_cut_goes_on_with_those_who_are_missing() -> None:
    """A kill between two inserts of a round: the journal has the first of three."""
    lockstep = Lockstep(3, SIZE)
    assert not lockstep.begins_round(28)
    assert lockstep.orders(9, 28) == {i: Go(2, 9, 8, SIZE) for i in (1, 2)}
    lockstep.take(batch(2))
    assert lockstep.next(28) is None
    lockstep.take(batch(1))
    first = lockstep.next(28)
    assert first is not None
    assert first.index == 1


def test_after_rounds_of_another_size_new_ones_begin() -> None:
    """Resumed with another service.envs: the number of episodes never was a multiple again."""
    lockstep = Lockstep(2, SIZE)
    assert lockstep.begins_round(18)
    assert lockstep.orders(9, 18) == {i: Go(2, 9, 8, SIZE) for i in range(2)}
    for index in range(2):
        lockstep.take(batch(index))
    for episodes in (18, 22):
        found = lockstep.next(episodes)
        assert found is not None
        lockstep.inserted(found)
    assert lockstep.begins_round(26)
    assert lockstep.orders(9, 26) == {i: Go(3, 9, 12, SIZE) for i in range(2)}


def test_the_settings_must_fit() -> None:
    spec = MADE.spec
    assert Lockstep.of(ServiceConfig(), 2, spec) is None
    step = {"mode": "lockstep", "envs": 4}
    assert Lockstep.of(ServiceConfig(**step), 2, spec) is not None
    with pytest.raises(ConfigError, match="too many for one message, at most 1: lower service.e"):
        Lockstep.of(
            ServiceConfig(**step),
            2,
            replace(spec, fields=(*spec.fields, Field("more", (200_000,), 0, 1))),
        )
