"""Scores of a task: names, labels, formats, and their JSON form."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass
from typing import Any

from tangram_core.errors import ConfigError

NAME = re.compile(r"[a-z][a-z0-9_]{0,40}")
MAX_LABEL, MAX_UNIT, MAX_DIGITS = 40, 8, 9
SHOWN = 4  # scores in a short line
COUNTS = ("episodes", "seconds")  # numbers that every evaluation reports beside its scores


@dataclass(frozen=True)
class Score:
    """Name and format of a number that measures how well a task was played.

    Attributes:
        name: key in result.json, TensorBoard and files of scores.
        label: a few words for people.
        digits: digits after the decimal point.
        unit: text behind the number.
    """

    name: str
    label: str
    digits: int = 3
    unit: str = ""

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name) or self.name in COUNTS:
            raise ConfigError(
                "a score's name begins with a small letter, has small letters, digits and _, at "
                f"most 41, and is not {' or '.join(COUNTS)}, got {self.name!r}: choose another name"
            )
        fits = len(self.label) <= MAX_LABEL and len(self.unit) <= MAX_UNIT
        if not (fits and 0 <= self.digits <= MAX_DIGITS):
            raise ConfigError(
                f"score {self.name}: label may have {MAX_LABEL} characters, unit {MAX_UNIT}, and "
                f"digits be 0 to {MAX_DIGITS}, got {len(self.label)}, {len(self.unit)} and "
                f"{self.digits}: correct them"
            )

    def shown(self, value: float | None) -> str:
        """The value as text with its unit; - for None."""
        return "-" if value is None else f"{decimal(value, self.digits)}{self.unit}"

    def told(self, value: float) -> str:
        """The label and the value as text."""
        return f"{self.label} {self.shown(value)}"


def decimal(value: float, digits: int = 3) -> str:
    """A number with `digits` decimals, or with more where it would look like a full 1: 0.9995."""
    text = f"{value:.{digits}f}"
    seems_full = value < 1 and float(text) == 1 and digits < MAX_DIGITS
    return decimal(value, digits + 1) if seems_full else text


def written(scores: Iterable[Score]) -> list[list[Any]]:
    """Scores as a JSON list."""
    return [list(astuple(score)) for score in scores]


def read(content: Any) -> tuple[Score, ...]:
    """Scores from a JSON list or its text; empty if the content is anything else."""
    try:
        rows = json.loads(content) if isinstance(content, str) else content
        return tuple(Score(*row) for row in rows)
    except (ValueError, TypeError, RecursionError, ConfigError):
        return ()


def told(scores: Sequence[Score], values: Mapping[str, float], before: str = "") -> str:
    """The scores that have a value in one line; the keys of values are `before` + name."""
    known = [score for score in scores if before + score.name in values]
    return ", ".join(score.told(values[before + score.name]) for score in known)
