"""Reports on runs that nobody planned, such as those of a sweep."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from tangram_lab.experiments.report.loose import read_runs
from tangram_lab.experiments.report.write import write_report
from tangram_sim.errors import RunError
from tests.experiments.builders import cells, learning_curve, result, write_study

pytestmark = pytest.mark.fast


def config(agent: str, seed: int, **more: Any) -> dict[str, Any]:
    return {"seed": seed, "run_dir": f"/x/{seed}", "agent": {"name": agent, "noise": 0.1}, **more}


def write_sweep(folder: Path) -> None:
    """Two agents, three seeds each, numbered as by --multirun."""
    for number in range(6):
        agent, seed = ("paper", "tangram")[number // 3], number % 3
        run, score = folder / str(number), 0.5 + number / 10
        run.mkdir()
        (run / "result.json").write_text(json.dumps(result(seed, score)))
        lines = [json.dumps(point) for point in learning_curve(seed, score)]
        (run / "curve.jsonl").write_text("\n".join(lines) + "\n")
        (run / "config.yaml").write_text(yaml.safe_dump(config(agent, seed)))


def test_runs_that_differ_in_their_seed_alone_are_one_row(tmp_path: Path) -> None:
    write_sweep(tmp_path)
    study = read_runs(tmp_path)
    assert [one.label for one in study.trainings] == ["paper", "tangram"]
    assert [len(one.finished) for one in study.trainings] == [3, 3]
    assert study.trainings[1].values("mean_reward") == pytest.approx({0: 0.8, 1: 0.9, 2: 1.0})
    assert study.trainings[0].overrides == ("agent.name=paper",)


def test_labels_name_what_differs_within_an_agent(tmp_path: Path) -> None:
    write_sweep(tmp_path)
    more = config("paper", 0, sim={"substeps": 4}) | {"agent": {"name": "paper", "noise": 0.2}}
    (tmp_path / "10").mkdir()
    (tmp_path / "10" / "config.yaml").write_text(yaml.safe_dump(more))
    labels = [one.label for one in read_runs(tmp_path).trainings]
    assert labels == ["paper, agent.noise=0.1", "tangram", "paper, agent.noise=0.2, sim.substeps=4"]


def test_a_sweep_becomes_one_table(tmp_path: Path) -> None:
    write_sweep(tmp_path)
    page, _ = write_report(tmp_path, tmp_path / "report")
    text = page.read_text()
    assert [row[0] for row in cells(text, "paper") + cells(text, "tangram")] == ["3 of 3"] * 2
    assert "tangram-experiment" not in text
    assert "Fig. 1" not in text


def test_the_same_run_twice_is_refused(tmp_path: Path) -> None:
    write_sweep(tmp_path)
    (tmp_path / "5" / "config.yaml").write_text(yaml.safe_dump(config("tangram", 1)))
    with pytest.raises(RunError, match="4 and .*5 have the same settings and seed 1"):
        read_runs(tmp_path)


def test_a_config_without_a_seed_is_refused(tmp_path: Path) -> None:
    (tmp_path / "0").mkdir()
    (tmp_path / "0" / "config.yaml").write_text("seed: x")
    with pytest.raises(RunError, match="seed must be a number, got 'x'"):
        read_runs(tmp_path)


def test_a_study_is_read_as_before(tmp_path: Path) -> None:
    write_study(tmp_path)
    assert read_runs(tmp_path).budget == "laptop"
