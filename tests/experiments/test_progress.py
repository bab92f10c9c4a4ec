"""What a study tells while it runs."""

import io
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from tangram_lab.experiments.jobs import Job
from tangram_lab.experiments.runner import StudyProgress, bound

pytestmark = pytest.mark.fast


def job(folder: Path, **settings: object) -> Job:
    return Job("square, seed 0", "square", ("x",), folder, folder / "result.json", None, settings)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"max_episodes": 0, "max_updates": 20}, ("updates", 20)),
        ({"max_episodes": 500, "max_updates": 0}, ("episodes", 500)),
        ({"max_updates": 0}, ("updates", None)),
        ({}, ("updates", None)),
    ],
)
def test_what_ends_a_training(tmp_path: Path, settings: dict[str, int], expected: object) -> None:
    assert bound(job(tmp_path, **settings)) == expected


def test_a_test_has_no_bound(tmp_path: Path) -> None:
    assert bound(replace(job(tmp_path, max_updates=20), trains=False)) == ("updates", None)


@pytest.mark.parametrize(
    ("result", "told"),
    [
        ({"mean_reward": 0.5, "angle_error_deg_median": 2.0}, "mean reward 0.500, angle error 2"),
        ({"mean_reward": 0.5, "train_s": 60.0}, "mean reward 0.500, 1:00 of training"),
        ({"coverage": 0.998, "angle_error_deg_median": None}, "coverage 0.998"),
        ({}, "done, without scores"),
    ],
)
def test_a_job_that_is_done_tells_the_scores_that_it_has(
    tmp_path: Path, result: dict[str, float | None], told: str
) -> None:
    console = Console(file=io.StringIO(), width=120)
    with StudyProgress(console, total=1, done=0) as progress:
        progress.started(job(tmp_path))
        progress.finished(job(tmp_path), result)
    assert f"[1/1] square, seed 0: {told}" in console.file.getvalue()  # type: ignore[attr-defined]


def shown(folder: Path, curve: str | None, terminal: bool) -> str:
    """What stands on the screen after one look at a running training."""
    if curve is not None:
        (folder / "curve.jsonl").write_text(curve)
    console = Console(file=io.StringIO(), force_terminal=terminal, width=120)
    with StudyProgress(console, total=12, done=2) as progress:
        running = job(folder, max_updates=2000)
        progress.started(running)
        progress.look([running])
        progress.finished(running, {"mean_reward": 0.5, "angle_error_deg_median": 2.0})
        progress.ended(running)
    return console.file.getvalue()  # type: ignore[attr-defined]


LINE = '{"updates": 1200, "episodes": 9, "mean_reward": 0.75}\n'


def test_a_terminal_shows_how_far_a_training_is(tmp_path: Path) -> None:
    text = shown(tmp_path, LINE + LINE, terminal=True)
    assert "3/12" in text
    assert "[3/12] square, seed 0: mean reward 0.500, angle error 2.00 deg" in text


@pytest.mark.parametrize("curve", [None, "", '{"upd', "[]", '{"updates": 3}'])
def test_a_curve_that_cannot_be_read_does_no_harm(tmp_path: Path, curve: str | None) -> None:
    assert "[3/12]" in shown(tmp_path, curve, terminal=True)


def test_elsewhere_each_job_is_a_line(tmp_path: Path) -> None:
    assert shown(tmp_path, LINE, terminal=False) == (
        "2 of 12 jobs were done before\n"
        "[3/12] square, seed 0: mean reward 0.500, angle error 2.00 deg\n"
    )
