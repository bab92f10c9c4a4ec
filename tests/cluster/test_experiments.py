"""A study of two runs through the commands: stopped, continued, tested, drawn."""

import csv
import signal
from pathlib import Path

import pytest
from PIL import Image

from tests.cluster.processes import (
    LIMIT_S,
    all_ended,
    pids_of,
    refused,
    run,
    run_here,
    started,
    wait_for_file,
)

pytestmark = pytest.mark.cluster

STUDY = ("study=parts", "budget=smoke", "jobs=1")


def rows(file: Path) -> list[dict[str, str]]:
    """Of a CSV."""
    with file.open(newline="") as opened:
        return list(csv.DictReader(opened))


def test_a_study_is_stopped_continued_and_drawn(tmp_path: Path) -> None:
    folder = tmp_path / "study"
    arguments = (*STUDY, f"run_dir={folder}")
    with started("tangram-experiment", *arguments, cwd=tmp_path) as process:
        wait_for_file(folder / "parts.csv", process)
        wait_for_file(folder / "parts" / "parallelogram_both" / "seed_0" / "config.yaml", process)
        children = [pid for pid in pids_of(folder) if pid != process.pid]
        process.send_signal(signal.SIGINT)
        assert process.wait(LIMIT_S) == 130
        assert all_ended(children)
    told = run("tangram-experiment", *arguments, cwd=tmp_path)
    assert "1 of 3 runs are in parts.csv\n" in told
    assert "[2/2] large_triangle_both, seed 0: mean reward" in told
    found = rows(folder / "parts.csv")
    agents = {row["training"]: row for row in found if row["policy"] == "agent"}
    assert list(agents) == ["square_both", "parallelogram_both", "large_triangle_both"]
    for row in agents.values():
        assert (row["test"], row["seed"], row["tests"]) == ("as_trained", "0", "16")
        assert row["updates"] == "20"
        assert float(row["mean_reward"]) <= 1.0
    assert {row["policy"] for row in found} == {"agent", "exact", "position only", "random"}

    run_here("tangram-report", f"runs={folder}", f"out={tmp_path / 'report'}", cwd=tmp_path)
    assert (
        "| square, both parts | `square_both` | as_trained | 1 | "
        in (tmp_path / "report" / "parts.md").read_text()
    )
    with Image.open(tmp_path / "report" / "parts_parts.png") as picture:
        assert picture.width == 900

    line = refused("tangram-experiment", "study=gone", f"run_dir={folder}", cwd=tmp_path)
    assert "study must be one of paper, " in line
