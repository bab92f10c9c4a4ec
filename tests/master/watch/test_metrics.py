"""What stands in TensorBoard and in curve.jsonl after a run."""

import errno
import json
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData
from torch.utils.tensorboard import SummaryWriter

from master.watch import metrics as metrics_module
from master.watch.metrics import HPARAMS, Means, Metrics, Thinning
from tests.master.builders import FakeHub, arrival, loop, scores, small_setup

pytestmark = pytest.mark.fast


def read(folder: Path) -> Any:
    events = EventAccumulator(str(folder))
    events.Reload()
    return events


def points(events: Any, tag: str) -> list[tuple[int, float]]:
    return [(event.step, pytest.approx(event.value)) for event in events.Scalars(tag)]


def test_points_stand_under_their_names_and_steps(tmp_path: Path) -> None:
    metrics = Metrics(tmp_path, tmp_path / "curve.jsonl")
    metrics.scalars({"train/q": 0.5}, 10)
    metrics.scalars({"train/q": 0.75, "replay/fill": 1.0}, 20)
    metrics.scores({"mean_reward": 0.9}, updates=20, episodes=300, seconds=12.7)
    metrics.picture(np.full((4, 6, 3), 255, np.uint8), 20)
    metrics.settings({"agent": {"noise": 0.1}})
    told = {"tokens": ["square", "square"]}
    scores = {"scores": [["mean_reward", "mean reward", 3, ""]]}
    metrics.hyperparameters(dict.fromkeys(HPARAMS, 1) | told | scores, told)
    metrics.close()
    events = read(tmp_path)
    assert points(events, "train/q") == [(10, 0.5), (20, 0.75)]
    assert points(events, "replay/fill") == [(20, 1.0)]
    assert points(events, "test/mean_reward") == [(20, 0.9)]
    (picture,) = events.Images("test/pictures")
    assert (picture.step, picture.width, picture.height) == (20, 6, 4)
    assert "noise: 0.1" in str(events.Tensors("config/text_summary")[0].tensor_proto)
    content = events.summary_metadata["_hparams_/session_start_info"].plugin_data.content
    told = HParamsPluginData.FromString(content).session_start_info.hparams
    assert set(told) == {*HPARAMS, "tokens"}
    assert told["tokens"].string_value == "square+square"
    assert [path.is_file() for path in tmp_path.iterdir()] == [True, True]  # one run in the list


def test_points_after_a_checkpoint_are_hidden_when_the_run_goes_on_from_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = time.time()
    for updates, value in ((0, 1.0), (20, 2.0)):
        # Files are read in the order of the seconds in their names: two lives are never so close.
        monkeypatch.setattr(time, "time", lambda later=updates: begun + later)
        metrics = Metrics(tmp_path, tmp_path / "curve.jsonl", updates)
        for step in (10, 20, 30):
            if step > updates:
                metrics.scalars({"train/q": value}, step)
                metrics.scores({"mean_reward": value}, step, 10 * step, step / 10)
        metrics.close()
    assert points(read(tmp_path), "train/q") == [(10, 1.0), (20, 1.0), (30, 2.0)]
    assert points(read(tmp_path), "test/mean_reward") == [(10, 1.0), (20, 1.0), (30, 2.0)]


@pytest.mark.parametrize("place", ["tensorboard", "curve.jsonl"])
def test_what_lies_in_the_place_of_curves_is_set_aside(
    place: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """What is not needed to go on never stops going on."""
    folder, curve = tmp_path / "tensorboard", tmp_path / "curve.jsonl"
    folder.touch() if place == "tensorboard" else curve.mkdir()
    with closing(Metrics(folder, curve, 5)) as metrics:
        metrics.scores({"mean_reward": 0.5}, 10, 320, 1.0)
    assert points(read(folder), "test/mean_reward") == [(10, 0.5)]
    assert len(lines(curve)) == 1
    (aside,) = tmp_path.glob("*.aside")
    assert caplog.messages == [
        f"{tmp_path / place} was not a readable curve: it was renamed to {aside.name}"
    ]


def test_curves_of_a_year_have_some_thousand_points(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    thinning, points, year_s = Thinning(0.0), list[float](), 365 * 86400.0
    while now_s[0] < year_s:
        if thinning.due():
            points.append(now_s[0])
        now_s[0] += max(2.0, now_s[0] / 20_000.0)
    assert points[:3] == [0.0, 2.0, 4.0]  # at first all
    assert len(points) < 20_000
    later = Thinning(year_s)  # in another life
    assert later.due()
    now_s[0] += year_s / 4000
    assert not later.due()


def test_what_is_thinned_out_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Thinning, "due", lambda _: False)
    with closing(Metrics(tmp_path, tmp_path / "curve.jsonl")) as metrics:
        metrics.scores({"mean_reward": 0.5}, 10, 320, 1.0)
    assert not (tmp_path / "curve.jsonl").exists()
    assert read(tmp_path).Tags()["scalars"] == []


def test_means_are_weighted_and_begin_anew() -> None:
    means = Means()
    assert means.take() == {}
    means.add({"reward": 1.0}, count=3)
    means.add({"reward": 0.0, "age": 2.0}, count=1)
    assert means.take() == {"reward": 0.75, "age": 2.0}
    assert means.take() == {}


def test_a_disk_that_takes_no_curves_leaves_a_gap_and_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(metrics_module, "RETRY_S", 0.0)
    metrics = Metrics(tmp_path, tmp_path / "curve.jsonl")
    metrics.scalars({"a": 1.0}, 1)

    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(SummaryWriter, "add_scalar", fail)
        for step in (2, 3):
            metrics.scalars({"a": 1.0}, step)
        metrics.scores({"b": 1.0}, 3, 30, 3.0)
    metrics.scalars({"a": 1.0}, 4)
    metrics.close()
    told = "curves cannot be written (No space left on device): points are missing"
    assert told in {record.message for record in caplog.records}
    files = [read(path) for path in tmp_path.glob("events.*")]
    steps = [p[0] for file in files if "a" in file.Tags()["scalars"] for p in points(file, "a")]
    assert sorted(steps) == [1, 4]


# curve.jsonl


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_lines_are_appended(tmp_path: Path) -> None:
    path = tmp_path / "curve.jsonl"
    with closing(Metrics(tmp_path, path)) as metrics:
        assert not path.exists()
        metrics.scores({"mean_reward": 0.5}, 10, 320, 1.23456)
        metrics.scores({"mean_reward": 0.75}, 20, 640, 2.0)
    assert lines(path) == [
        {"updates": 10, "episodes": 320, "train_s": 1.235, "mean_reward": 0.5},
        {"updates": 20, "episodes": 640, "train_s": 2.0, "mean_reward": 0.75},
    ]


@pytest.mark.parametrize(("updates", "kept"), [(0, []), (15, [10]), (20, [10, 20])])
def test_what_happens_again_is_dropped(tmp_path: Path, updates: int, kept: list[int]) -> None:
    path = tmp_path / "curve.jsonl"
    for number in (10, 20):
        with closing(Metrics(tmp_path, path, number)) as metrics:
            metrics.scores({}, number, 0, 0.0)
    Metrics(tmp_path, path, updates).close()
    assert [line["updates"] for line in lines(path)] == kept


def test_a_line_cut_short_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "curve.jsonl"
    whole = '{"updates": 10, "episodes": 9, "train_s": 1.5}'
    damaged = b'\n{"updates": 12, "episodes": 9, "train_s\xff": 1.5}'
    cut = '\n[3]\n{"updates": "x"}\n' + "[" * 100_000 + '\n{"upda'
    path.write_bytes(whole.encode() + damaged + cut.encode())
    with closing(Metrics(tmp_path, path, 100)) as metrics:
        metrics.scores({}, 20, 0, 0.0)
    assert [line["updates"] for line in lines(path)] == [10, 20]


def test_a_point_stands_where_its_weights_were_sent(tmp_path: Path) -> None:
    """Not where their scores arrive: episodes and time have gone on since."""
    made = small_setup()
    script = [[arrival(made, 1)], [arrival(made, 2), scores(made, version=0, reward=0.25)]]
    moved = loop(tmp_path, made, FakeHub(made, script))
    moved.publish()
    for _ in script:
        moved.receive(0.0)
        moved.insert()
    assert moved.guard.trainer.episodes > 0
    (line,) = lines(tmp_path / "curve.jsonl")
    assert (line["updates"], line["episodes"], line["train_s"]) == (0, 0, 0.0)
    assert line["mean_reward"] == 0.25


@pytest.mark.parametrize("due", [True, False])
def test_points_of_an_old_run_are_written_when_they_are_due(
    due: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = small_setup()
    moved = loop(tmp_path, made, FakeHub(made, [[scores(made, version=0)]]))
    moved.publish()
    monkeypatch.setattr(Thinning, "due", lambda _: due)
    moved.receive(0.0)
    moved.reporter.flush(0)
    moved.reporter.metrics.close()
    tags = read(next(tmp_path.glob("**/events.*")).parent).Tags()
    assert ("run/updates" in tags["scalars"], "test/pictures" in tags["images"]) == (due, due)
