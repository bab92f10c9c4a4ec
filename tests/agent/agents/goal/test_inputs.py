"""Rows of numbers: which fields they have, and their statistics."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tangram_agent.flat.inputs import FURTHEST, LEAST, Inputs, Normaliser, normalised
from tangram_core.errors import ConfigError, RunError
from tangram_core.spec import EpisodeSpec, Field

pytestmark = pytest.mark.fast

SPEC = EpisodeSpec(
    2,
    1,
    (
        Field("goal", (2,), -9, 9, "episode"),
        Field("place", (2,), -9, 9),
        Field("force", (1,), -9, 9, "step"),
        Field("speed", (1,), -9, 9),
    ),
    achieved="place",
    desired="goal",
)


def test_a_row_has_moments_then_the_goal_and_no_steps() -> None:
    seen = {
        "goal": np.array([[1, 2]], "f4"),
        "place": np.array([[3, 4]], "f4"),
        "speed": np.array([[5]], "f4"),
    }
    assert Inputs(SPEC).rows(seen).tolist() == [[3, 4, 5, 1, 2]]


def test_statistics_count_achieved_goals_beside_the_desired_one() -> None:
    episodes = SPEC.empty(1)
    episodes["place"][0] = [[1, 1], [2, 2], [3, 3]]
    episodes["goal"][0] = [9, 9]
    rows = Inputs(SPEC).of_episodes(episodes)
    assert rows[:, 3].tolist() == [9, 9, 9, 1, 2, 3]
    assert rows[:, 0].tolist() == [1, 2, 3, 1, 2, 3]


def test_pictures_are_refused_by_name() -> None:
    pixels = Field("pixels", (4, 4, 3), 0, 255, dtype="u1")
    spec = EpisodeSpec(2, 1, (*SPEC.fields, pixels), "place", "goal")
    with pytest.raises(ConfigError, match="pixels of this task is u1"):
        Inputs.check(spec)


@given(st.lists(st.integers(1, 20), min_size=1, max_size=5), st.integers(0, 99))
def test_statistics_of_parts_are_those_of_the_whole(sizes: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    parts = [rng.normal(1000.0, [1.0, 50.0], (size, 2)) for size in sizes]
    normaliser = Normaliser(2)
    for part in parts:
        normaliser.add(part)
    whole = np.concatenate(parts)
    assert normaliser.mean == pytest.approx(whole.mean(0), rel=1e-6)
    assert normaliser.scale == pytest.approx(np.maximum(whole.std(0), LEAST), rel=1e-5)


def test_what_is_far_or_constant_stays_within_bounds() -> None:
    normaliser = Normaliser(2)

    def seen(*rows: tuple[float, float]) -> Any:
        arrays = np.array(rows, "f4"), normaliser.mean, normaliser.scale
        found = normalised(*arrays)
        assert normalised(*map(torch.from_numpy, arrays)).numpy() == pytest.approx(found)
        return found.tolist()

    assert seen((0.5, 9)) == [[0.5, FURTHEST]]
    normaliser.add(np.array([[1, 7], [3, 7]], "f4"))
    assert seen((3, 7), (1e6, 8)) == [[1, 0], [FURTHEST, FURTHEST]]


@pytest.mark.parametrize(
    "changes",
    [
        {"mean": np.zeros(3)},
        {"mean": np.full(2, np.nan)},
        {"count": np.zeros(2)},
        {"squares": None},
    ],
)
def test_a_state_of_another_task_is_refused(changes: dict[str, np.ndarray]) -> None:  # type: ignore[type-arg]
    state = Normaliser(2).state() | changes
    with pytest.raises(RunError, match=f"'{next(iter(changes))}' must be"):
        Normaliser(2).load_state({name: v for name, v in state.items() if v is not None})
