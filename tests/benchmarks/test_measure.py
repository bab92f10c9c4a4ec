"""Ratios, bounds and the command line of the measurements."""

import argparse
import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

from tangram_core.errors import ConfigError
from tangram_lab.benchmarks.cli import main
from tangram_lab.benchmarks.measure import rates, row_of
from tangram_lab.benchmarks.speed import fetch
from tangram_lab.benchmarks.speed.fetch import Curve, Match, measure_fetch
from tangram_lab.benchmarks.speed.learner import measure_gpu
from tangram_lab.benchmarks.stages import STAGES, run_stages

LABELS = ("stage", "case", "unit")


@pytest.mark.fast
def test_the_ratio_is_the_median_of_the_turns() -> None:
    row = row_of(LABELS, [10.0, 30.0, 20.0], "other", [10.0, 10.0, 40.0], least=0.9)
    assert (row.ratio, row.least, row.most, row.ours, row.theirs) == (1.0, 0.5, 3.0, 20.0, 10.0)
    assert (row.target, row.held) == (">= 0.9", True)


@pytest.mark.fast
@pytest.mark.parametrize(
    ("least", "value", "held", "text"),
    [(2.0, 2.0, True, ">= 2"), (2.0, 1.9, False, ">= 2"), (None, 3.0, None, "")],
)
def test_bounds(least: float | None, value: float, held: bool | None, text: str) -> None:
    row = row_of(LABELS, [value], least=least)
    assert (row.held, row.target) == (held, text)


@pytest.mark.fast
def test_ways_are_measured_in_turns() -> None:
    order: list[str] = []
    works = {name: lambda name=name: order.append(name) or 1.0 for name in "ab"}
    found = rates(works, runs=3, span_s=0.0)
    assert {name: len(values) for name, values in found.items()} == {"a": 3, "b": 3}
    assert order[:2] == ["a", "b"]


def bench(*arguments: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "tangram_cli", "bench", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=110, check=False)


@pytest.mark.fast
def test_a_stage_prints_a_table_and_writes_where_its_numbers_come_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    row = row_of(("learner", "a perceptron", "updates/s"), [1.0], least=2.0)
    monkeypatch.setitem(STAGES, "learner", lambda _: [row])
    out = tmp_path / "new" / "learner.json"
    assert run_stages(argparse.Namespace(kind="learner", out=out)) == 0
    assert "missed the target:\n  learner: a perceptron" in capsys.readouterr().out
    assert "| learner | a perceptron | updates/s | 1 |" in out.with_suffix(".md").read_text()
    content = json.loads(out.read_text())
    assert {"command", "commit", "processor", "cores", "versions", "rows"} <= content.keys()
    assert [found["case"] for found in content["rows"]] == ["a perceptron"]


@pytest.mark.fast
@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("learner runs=0", "runs must be between 1 and 10000, got 0"),
        ("fetch minutes=0", "minutes must be between 0.01 and 100000, got 0"),
        ("chaos minutes=inf", "minutes must be a finite number, between 0.01 and 100000, got inf"),
        ("chaos minutes=0", "minutes must be between 0.01 and 100000, got 0"),
        ("chaos seed=-1", "seed must be between 0 and"),
        ("learner out=/", "out=/ cannot be written (it is a folder)"),
    ],
)
def test_a_number_out_of_its_bounds_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], line: str, reason: str
) -> None:
    monkeypatch.setattr(sys, "argv", ["tangram-bench", *line.split()])
    monkeypatch.setattr("signal.signal", lambda *_: None)
    assert main() == 2
    told = capsys.readouterr().err
    assert told.startswith(f"tangram-bench: {reason}")
    assert told.count("\n") == 1


@pytest.mark.fast
def test_what_needs_a_gpu_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(ConfigError, match="gpu needs a GPU, and none is visible"):
        measure_gpu(1)


@pytest.mark.fast
def test_a_timeline_that_cannot_be_written_is_told_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "timeline.json").mkdir()
    with pytest.raises(ConfigError, match="timeline.json cannot be written"):
        measure_gpu(1, profile=True)


@pytest.mark.fast
def test_all_is_all_that_needs_no_gpu_and_no_robots(monkeypatch: pytest.MonkeyPatch) -> None:
    measured = []
    for name in STAGES:
        row = row_of((name, "case", "unit"), [1.0])
        monkeypatch.setitem(STAGES, name, lambda _, one=row: measured.append(one.stage) or [one])
    assert run_stages(argparse.Namespace(kind="all", out=None)) == 0
    assert {*STAGES} - {*measured} == {"gpu", "fetch"}


@pytest.mark.fast
def test_a_match_that_has_its_rows_is_not_run_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    rows, played = tmp_path / "rows.csv", list[Match]()

    def play(match: Match, name: str) -> tuple[Curve, Curve]:
        played.append(match)
        return [(60.0, 10, 1, 0.0), (120.0, 20, 2, 0.9)], [(61.0, 30, 3, float(match.seed))]

    monkeypatch.setattr(fetch, "_play", play)
    monkeypatch.setattr(fetch, "label", lambda: "theirs")
    one, two, other = (
        Match("FetchPush-v4", 0, 1.0, "goal", 0),
        Match("FetchPush-v4", 1, 1.0, "goal", 0),
        Match("FetchPush-v4", 0, 1.0, "push", 0),
    )
    monkeypatch.setattr(fetch, "find_spec", lambda name: None if name == "panda_gym" else name)
    with pytest.raises(ModuleNotFoundError, match="panda_gym is missing: install"):
        measure_fetch([one, Match("PandaPush-v3", 0, 1.0, "goal", 0)], rows)
    assert len(measure_fetch([one], rows)) == 4
    table = measure_fetch([one, two, other], rows)
    assert played == [one, two, other]
    found = {name: [] for name in ("success", "seconds", "steps")}
    for row in table:
        for name, values in found.items():
            if f": {name}" in row.case:
                values.append((row.ours, row.theirs))
    assert found == {
        "success": [(0.45, 0.0), (0.45, 1.0), (0.45, 0.0)],
        "seconds": [(120.0, math.inf), (120.0, 61.0), (120.0, math.inf)],
        "steps": [(20.0, 30.0)] * 3,
    }
    rows.write_text("id\n")
    with pytest.raises(ConfigError, match=r"rows=.*rows.csv has other columns than id, seed,"):
        measure_fetch([one], rows)


@pytest.mark.cluster
def test_wrong_arguments_are_answered_in_one_line() -> None:
    done = bench("nothing")
    assert done.returncode == 2
    assert "invalid choice: 'nothing'" in done.stderr
    assert "Traceback" not in done.stderr
