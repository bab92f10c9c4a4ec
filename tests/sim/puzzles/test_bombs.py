"""Puzzles that are made to harm: refused at once, whatever they are made of."""

import json

import pytest

from tangram_core.errors import TangramError
from tangram_sim.puzzles.figures import parse_puzzles

pytestmark = pytest.mark.slow

MANY, MIB = 100_000, 2**20
TEXTS = [
    *("[" * MANY, '{"a":' * MANY, "1" * MANY, f'"{"x" * 5 * MIB}"', "[1e999]", "NaN", "[]"),
    json.dumps({"format": "x", "puzzles": [[]] * MANY}),
    f"[{'0,' * MANY}0]",
]


@pytest.mark.parametrize("text", TEXTS, ids=range(len(TEXTS)))
def test_a_bomb_is_refused_before_the_time_of_a_test_is_over(text: str) -> None:
    with pytest.raises(TangramError):
        parse_puzzles(text, "it")
