"""No two places share a stream; the test set is fixed."""

import itertools

import pytest

from tangram_sim.seeding import episode_generator, evaluation_generators

pytestmark = pytest.mark.fast


def test_every_argument_gives_another_stream() -> None:
    """Also where a plain list of integers would be padded or joined to the same entropy."""
    values = (0, 1, 2**32, 2**64)
    keys = itertools.product(values, ("player", "evaluator"), values, values, values)
    draws = [episode_generator(*key).integers(2**63) for key in keys]
    assert len(set(draws)) == len(draws) == 2 * 4**4


def test_same_arguments_give_the_same_stream() -> None:
    first, again = (episode_generator(7, "player", 1, 2, 3).random(5) for _ in range(2))
    assert first.tolist() == again.tolist()


def test_streams_do_not_change_between_versions() -> None:
    """A run that is resumed, and the test set, rely on it."""
    assert episode_generator(1, "player", 2, 3, 4).random() == 0.7262557940995327
    assert evaluation_generators(1)[0].random() == 0.3233672278778038


def test_a_small_test_set_is_the_beginning_of_a_large_one() -> None:
    small = [g.random() for g in evaluation_generators(3)]
    large = [g.random() for g in evaluation_generators(100)]
    assert small == large[:3]
    assert len(set(large)) == 100
