"""What a task declares about its episodes and scores is checked at birth."""

from collections.abc import Callable
from typing import Any

import pytest

from tangram_core.errors import ConfigError
from tangram_core.scores import Score
from tangram_core.spec import EpisodeSpec, Field

pytestmark = pytest.mark.fast

PLACE, GOAL = Field("place", (2,), -1, 1), Field("goal", (2,), -1, 1, "episode")


def spec(**changes: Any) -> EpisodeSpec:
    given = {"horizon": 3, "action_size": 1, "fields": (PLACE, GOAL)}
    return EpisodeSpec(**given | {"achieved": "place", "desired": "goal"} | changes)


@pytest.mark.parametrize(
    ("made", "told"),
    [
        (lambda: Field("x", (), 1, 1), "field x: its bounds must be finite, .* got 1 and 1: give"),
        (lambda: Field("x", (), 0, float("inf")), "field x: its bounds .* got 0 and inf"),
        (lambda: Field("x", (), float("nan"), 1), "field x: its bounds .* got nan and 1"),
        (lambda: Field("x", (), -float("inf"), 1), "field x: its bounds .* got -inf and 1"),
        (lambda: Field("x", (), 0, 1, dtype="f8"), "dtype must be one of f4, u1, got f8"),
        (lambda: Field("x", (2, 0), 0, 1), r"field x: its shape has an empty side, \(2, 0\)"),
        (lambda: spec(horizon=0), "an episode's horizon must be at least 1, got 0"),
        (lambda: spec(action_size=0), "an episode's action_size must be at least 1, got 0"),
        (lambda: spec(fields=(PLACE, GOAL, PLACE)), "two fields of an episode have one name: act"),
        (lambda: spec(achieved="goal"), "no field goal with one row for each moment"),
        (lambda: spec(desired="place"), "no field place with one row for each episode"),
        (lambda: spec(desired="far"), "no field far with one row for each episode"),
        *(
            (lambda name=name: Score(name, "speed"), f"score's name begins .* got '{name}': choose")
            for name in ("Speed", "top speed", "x" * 42, "episodes")
        ),
    ],
)
def test_what_cannot_be_is_refused(made: Callable[[], object], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        made()
    assert spec().field("goal") == GOAL
