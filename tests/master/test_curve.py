"""curve.jsonl: what is kept, appended and dropped."""

import json
from pathlib import Path
from typing import Any

import pytest

from master.metrics import Curve
from tests.master.builders import FakeHub, arrival, loop, scores, small_setup

pytestmark = pytest.mark.fast


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_lines_are_appended(tmp_path: Path) -> None:
    path = tmp_path / "curve.jsonl"
    curve = Curve(path, 0)
    assert not path.exists()
    curve.add({"mean_reward": 0.5}, 10, 320, 1.23456)
    curve.add({"mean_reward": 0.75}, 20, 640, 2.0)
    assert lines(path) == [
        {"updates": 10, "episodes": 320, "train_s": 1.235, "mean_reward": 0.5},
        {"updates": 20, "episodes": 640, "train_s": 2.0, "mean_reward": 0.75},
    ]


@pytest.mark.parametrize(("updates", "kept"), [(0, []), (15, [10]), (20, [10, 20])])
def test_what_happens_again_is_dropped(tmp_path: Path, updates: int, kept: list[int]) -> None:
    path = tmp_path / "curve.jsonl"
    for number in (10, 20):
        Curve(path, number).add({}, number, 0, 0.0)
    Curve(path, updates)
    assert [line["updates"] for line in lines(path)] == kept


def test_a_line_cut_short_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "curve.jsonl"
    path.write_text('{"updates": 10}\n[3]\n{"updates": "x"}\n{"upda')
    Curve(path, 100).add({}, 20, 0, 0.0)
    assert [line["updates"] for line in lines(path)] == [10, 20]


def test_the_loop_writes_every_evaluation(tmp_path: Path) -> None:
    made = small_setup()
    moved = loop(tmp_path, made, FakeHub(made, [[scores(made, version=0, reward=0.25)]]))
    moved.receive(0.0)
    (line,) = lines(tmp_path / "curve.jsonl")
    assert (line["updates"], line["mean_reward"]) == (0, 0.25)


def test_a_point_stands_where_its_weights_were_sent(tmp_path: Path) -> None:
    """Not where their scores arrive: episodes and time have gone on since."""
    made = small_setup()
    script = [[arrival(made, 1)], [arrival(made, 2), scores(made, version=0, reward=0.25)]]
    moved = loop(tmp_path, made, FakeHub(made, script))
    moved.publish()
    for _ in script:
        moved.receive(0.0)
        moved.insert()
    assert moved.parts.trainer.episodes > 0
    (line,) = lines(tmp_path / "curve.jsonl")
    assert (line["updates"], line["episodes"], line["train_s"]) == (0, 0, 0.0)
