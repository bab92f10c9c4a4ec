"""The tables of several tokens, from numbers of which every cell is known."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tangram_lab.experiments.report.study import Experiment, read_runs
from tangram_lab.experiments.report.tables import assembly_table, differences, order_table, paired
from tests.experiments.builders import (
    experiment,
    plan,
    result,
    scores,
    training,
    trial,
    write_plan,
    write_run,
)

pytestmark = pytest.mark.fast

SEVEN = ["square"] * 7


def several(coverage: list[float], **more: Any) -> dict[str, Any]:
    """Scores of a test with several tokens."""
    return {
        "coverage": float(np.mean(coverage)),
        "coverage_each": coverage,
        "share_solved": float(np.mean(np.array(coverage) >= 0.95)),
        "iou": 0.9,
        "wrong": 0.25,
        "doubly_used": 0.0,
        "blocked": 0.5,
        "seconds_per_puzzle": 0.125,
        "position_error_median": 0.0012,
    } | more


def study(folder: Path, listed: list[list[float] | None]) -> Experiment:
    """One training of two seeds, tested once; `listed` is each seed's coverage in that order."""
    write_plan(
        folder,
        plan(
            {"game": experiment("game", ["seven"], tests=["random"])},
            {"seven": training("seven tokens", "game")},
            {"random": trial("random targets")},
            seeds=(0, 1),
        ),
    )
    for seed, (own, other) in enumerate(zip(([1.0, 0.98], [0.96, 0.9]), listed, strict=True)):
        baselines: dict[str, Any] = {
            "exact": several([1.0, 1.0], mean_reward=1.0),
            "random": several([0.1, 0.3], mean_reward=-0.9),
        }
        if other is not None:
            baselines["order=listed"] = several(other, mean_reward=0.5)
        test = scores(0.9, baselines, **several(own))
        write_run(folder, "seven", result(seed, tokens=SEVEN), [], {"random": test})
    return read_runs(folder).experiments[0]


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_scores_are_medians_and_what_learned_nothing_stands_below(tmp_path: Path) -> None:
    head, _, own, exact, chance, _ = assembly_table(study(tmp_path, [None, None]))
    row = dict(zip(cells(head), cells(own), strict=True))
    assert row["training"] == "seven tokens"
    assert row["test"] == "random targets"
    assert row["seeds"] == "2"
    assert row["coverage"] == "0.9600 (0.9300 to 0.9900)"
    assert row["solved"] == "75.0 % (50.0 % to 100.0 %)"
    assert row["IoU"] == "0.900"
    assert row["position error"] == "0.0012"
    assert row["refused placements"] == "0.50"
    assert row["ms per target"] == "125"
    assert cells(exact)[:4] == ["exact", "random targets, 7 tokens", "", "1.0000"]
    assert cells(chance)[:4] == ["random", "random targets, 7 tokens", "", "0.2000"]


def test_orders_are_compared_episode_by_episode(tmp_path: Path) -> None:
    found = study(tmp_path, [[0.9, 0.9], [0.9, 0.9]])
    (one,), (test,) = found.trainings, found.tests
    np.testing.assert_allclose(differences(one, test, "order=listed"), [0.08, 0.04])
    lines = order_table(found)
    row = dict(zip(cells(lines[2]), cells(lines[4]), strict=True))
    assert row["learned"] == "0.9600 (0.9300 to 0.9900)"
    # A mean of 0.06 with a deviation of 0.0283 over two pairs.
    assert row["less order=listed"] == "+0.0600 (+0.0208 to +0.0992)"
    assert row["less order=size"] == "-"


def test_without_another_order_there_is_no_table(tmp_path: Path) -> None:
    assert order_table(study(tmp_path, [None, None])) == []


def test_a_seed_without_the_other_order_is_left_out(tmp_path: Path) -> None:
    found = study(tmp_path, [[0.9, 0.9], None])
    got = differences(found.trainings[0], found.tests[0], "order=listed")
    np.testing.assert_allclose(got, [0.1, 0.08])


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ([], "-"),
        ([0.1], "-"),
        ([0.0, 0.0, 0.0], "+0.0000 (+0.0000 to +0.0000)"),
        ([-0.2, -0.1, 0.0, 0.1], "-0.0500 (-0.1765 to +0.0765)"),
    ],
)
def test_the_interval_of_paired_differences(values: list[float], text: str) -> None:
    assert paired(values) == text
