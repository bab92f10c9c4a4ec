"""Checks that configuration dataclasses share."""

import math
from collections.abc import Collection

from tangram_sim.errors import ConfigError


def check_range(name: str, value: float, low: float, high: float = math.inf) -> None:
    """Raise ConfigError unless low <= value <= high."""
    if not low <= value <= high:
        bound = f"at least {low:g}" if math.isinf(high) else f"between {low:g} and {high:g}"
        raise ConfigError(f"{name} must be {bound}, got {value}")


def check_choice(name: str, value: str, choices: Collection[str]) -> None:
    """Raise ConfigError unless the value is one of the choices."""
    if value not in choices:
        raise ConfigError(f"{name} must be one of {', '.join(choices)}, got '{value}'")
