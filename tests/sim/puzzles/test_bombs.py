"""Puzzles that are made to harm: refused at once, whatever they are made of."""

import json
from collections.abc import Callable
from typing import Any

import pytest

from tangram_core.errors import TangramError
from tangram_sim.puzzles.figures import parse_puzzles, parse_svg_puzzle

pytestmark = pytest.mark.slow

MANY, TRIANGLE, MIB = 100_000, '<polygon points="0,0 1,0 0,1"/>', 2**20
DRAWINGS = [
    f"<svg>{'<g>' * MANY}{'</g>' * MANY}</svg>",
    '<!DOCTYPE svg [<!ENTITY a "b"><!ENTITY c "&a;&a;">]><svg>&c;</svg>',
    f"<svg>{'<g/>' * 9 * MANY}</svg>",
    f"<svg>{TRIANGLE * MANY}</svg>",
    f'<svg><path d="{"M 0 0 L 1 1 " * MANY}"/></svg>',
    f"<svg>{' ' * 5 * MIB}</svg>",
    f'<svg><g transform="{"scale(1e300)" * 50}">{TRIANGLE}</g></svg>',
    "<svg" * MANY,
]
TEXTS = [
    *("[" * MANY, '{"a":' * MANY, "1" * MANY, f'"{"x" * 5 * MIB}"', "[1e999]", "NaN", "[]"),
    json.dumps({"format": "x", "puzzles": [[]] * MANY}),
    f"[{'0,' * MANY}0]",
]
BOMBS: list[tuple[str, Callable[[str, str], Any]]] = [
    *((text, parse_svg_puzzle) for text in DRAWINGS),
    *((text, parse_puzzles) for text in TEXTS),
]


@pytest.mark.parametrize(("text", "parse"), BOMBS, ids=range(len(BOMBS)))
def test_a_bomb_is_refused_before_the_time_of_a_test_is_over(
    text: str, parse: Callable[[str, str], Any]
) -> None:
    with pytest.raises(TangramError):
        parse(text, "it")
