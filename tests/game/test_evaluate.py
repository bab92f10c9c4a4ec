"""tangram-eval on run folders with random weights: what is scored, written, printed and drawn."""

import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from tangram_core.errors import ConfigError
from tangram_game.config import EvalConfig
from tangram_game.evaluate import evaluate_run, score_policies, scores_table
from tangram_game.scores import RUN
from tangram_sim.geometry.layout import TokensConfig
from tangram_tasks.place import ONE_TOKEN, Place
from tangram_tasks.push.task import Push, PushConfig
from tests.agent.builders import PAIR, SQUARE
from tests.game.figures.puzzle_files import GAME, SIM, drawn, write_puzzles
from tests.worker.builders import write_run
from worker.score.test_set import FixedTests

pytestmark = pytest.mark.fast

SCORES = {
    *("mean_reward", "mean_reward_camera", "coverage", "coverage_p10", "episodes"),
    *("angle_error_deg_median", "angle_error_deg_p90"),
    *("position_error_median", "position_error_p90"),
}
MEANS = {
    *("coverage", "iou", "solved", "wrong", "doubly_used", "refused", "blocked"),
    *("actions_used", "seconds_per_puzzle", "coverage_each"),
    *("position_error_median", "angle_error_deg_median"),
}


def evaluated(folder: Path, tokens: dict[str, Any] = GAME, **settings: Any) -> dict[str, Any]:
    """The report of a run of random weights."""
    if not (folder / "run").exists():
        write_run(folder / "run", tokens, **({"sim": SIM} if tokens is GAME else {}))
    out = folder / "scores.json"
    assert evaluate_run(EvalConfig(str(folder / "run"), out=str(out), **settings)) == 0
    report: dict[str, Any] = json.loads(out.read_text())
    return report


def test_the_time_of_an_action_is_that_of_those_who_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    task = Push(TokensConfig(("square",), 0.8), PushConfig())
    random = task.rivals()["random"]
    with closing(FixedTests(task, 2, 2)) as tests:
        played = tests.play(random(tests.env))
    played.episodes.terminated[:] = 0
    played.episodes.terminated[0, 2:] = 1  # its last action is the third
    timed = replace(played, chose=np.array([1.0, 2.0]))
    monkeypatch.setattr(FixedTests, "play", lambda *_: timed)
    scores = score_policies(task, {"random": random}, EvalConfig("run", episodes=2))
    assert scores["random"]["ms_per_choice"] == pytest.approx(3000.0 / (3 + 8))


# One token


def test_evaluation_writes_scores_and_prints_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = evaluated(tmp_path, SQUARE, episodes=10)
    assert set(report) >= SCORES | {"seconds", "baselines"}
    facts = {"episodes": 10, "updates": 7, "tokens": ["square"]}
    assert {name: report[name] for name in facts} == facts
    assert (report["sim"]["actions_per_token"], report["agent"]["name"]) == (1, "tangram")
    baselines = report["baselines"]
    assert set(baselines) == {"exact", "position only", "random"}
    assert baselines["position only"]["position_error_median"] < 1e-6
    assert baselines["random"]["mean_reward"] < baselines["position only"]["mean_reward"]
    printed = capsys.readouterr().out
    for told in (f"{report['mean_reward']:.3f}", "run after 7 updates", "position only"):
        assert told in printed
    assert "10 fixed tests, 1 action a token" in printed


def test_only_the_rivals_that_are_asked_for_are_scored(tmp_path: Path) -> None:
    few = evaluated(tmp_path, SQUARE, episodes=2, rivals=("exact",))
    assert {*few["baselines"]} == {"exact"}
    assert evaluated(tmp_path, SQUARE, episodes=2, rivals=())["baselines"] == {}
    with pytest.raises(ConfigError, match="no 'exakt' here, choose from exact, position only"):
        evaluated(tmp_path, SQUARE, episodes=2, rivals=("exakt",))


def test_no_rival_takes_the_place_of_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Place, "rivals", lambda task: {RUN: lambda env: None})
    with pytest.raises(ConfigError, match="calls a rival 'this run'.*rename it"):
        evaluated(tmp_path, SQUARE, episodes=2)


def test_evaluation_repeats_itself_and_other_tests_differ(tmp_path: Path) -> None:
    def scores(**more: Any) -> dict:
        report = evaluated(tmp_path, SQUARE, episodes=5, **more)
        return {name: report[name] for name in SCORES}

    assert scores() == scores()
    assert scores() != scores(seed=1)
    assert scores() != scores(changes={"sim": {"actions_per_token": 3}})


def test_settings_of_the_world_are_played_and_written_down(tmp_path: Path) -> None:
    changes = {"sim": {"actions_per_token": 4, "backend": "kinematic", "targets": "connected"}}
    report = evaluated(tmp_path, PAIR, episodes=2, changes=changes)
    assert report["sim"].items() >= changes["sim"].items()
    assert report["actions_used"] == 8


def test_all_policies_of_one_token_fit_into_80_columns(capsys: pytest.CaptureFixture[str]) -> None:
    scores = {"mean_reward": -0.987, "position_error_p90": 1.2345, "angle_error_deg_p90": 180.0}
    names = RUN, "exact", "position only", "random"
    Console(width=80).print(scores_table("run", "", ONE_TOKEN, dict.fromkeys(names, scores)))
    printed = capsys.readouterr().out
    assert "…" not in printed
    assert printed.count("1.2345") == len(names)


# Several tokens


@pytest.fixture
def two(tmp_path: Path) -> str:
    """A file of two puzzles."""
    return str(write_puzzles(tmp_path / "mine.json", drawn("cat"), drawn("fish")))


def test_puzzles_of_a_file_are_scored_together_and_one_by_one(
    tmp_path: Path, two: str, capsys: pytest.CaptureFixture[str]
) -> None:
    report = evaluated(tmp_path, puzzle=(two,), turns=2)
    assert set(report) >= MEANS | {"sim", "agent"}
    assert set(report["baselines"]) == {"exact", "random"}
    assert [(one["name"], one["degrees"]) for one in report["puzzles"]] == [
        (name, degrees) for name in ("my_cat", "my_fish") for degrees in (0.0, 180.0)
    ]
    for name in ("coverage", "iou", "wrong", "blocked", "actions_used"):
        values = [one[name] for one in report["puzzles"]]
        assert report[name] == pytest.approx(sum(values) / 4)
    assert all(len(one["position_errors"]) == 7 for one in report["puzzles"])
    exact, chance = report["baselines"]["exact"], report["baselines"]["random"]
    assert (exact["solved"], exact["coverage"]) == (1.0, pytest.approx(1.0))
    assert chance["coverage"] < 0.5
    printed = capsys.readouterr().out
    assert "4 puzzles of mine.json, 1 action a token" in printed
    assert "my_fish 180°" in printed


def test_settings_of_the_agents_play_are_played_and_written_down(tmp_path: Path, two: str) -> None:
    write_run(tmp_path / "run", GAME, sim=SIM, agent={"reapply": 0})
    trained = evaluated(tmp_path, puzzle=(two,))
    again = evaluated(tmp_path, puzzle=(two,), changes={"agent": {"reapply": 1}})
    assert (trained["agent"]["reapply"], again["agent"]["reapply"]) == (0, 1)
    assert evaluated(tmp_path, puzzle=(two,), seed=1)["coverage"] != trained["coverage"]
    assert [one["coverage"] for one in trained["puzzles"]] != [
        one["coverage"] for one in again["puzzles"]
    ]


def test_random_targets_of_several_tokens_get_the_same_scores(tmp_path: Path) -> None:
    report = evaluated(tmp_path, episodes=3)
    assert set(report) >= MEANS | {"mean_reward", "mean_reward_camera", "episodes"}
    assert set(report["baselines"]) == {"exact", "random"}
    assert "puzzles" not in report
    for scores in (report, *report["baselines"].values()):
        assert len(scores["coverage_each"]) == 3
        assert np.mean(scores["coverage_each"]) == pytest.approx(scores["coverage"], abs=1e-6)


def test_a_long_list_is_cut_on_the_screen_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("tangram_game.evaluate.MAX_LINES", 12)
    report = evaluated(tmp_path, puzzle=("test",))
    assert len(report["puzzles"]) == 14
    printed = capsys.readouterr().out
    assert printed.count("│ camel") == 1
    assert "and 2 more: all are in" in " ".join(printed.split())
