"""What the page shows of a run folder, whoever wrote it."""

import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tangram_agent.messages import RunStatus
from tangram_sim.errors import RunError, TangramError
from tangram_studio import watching
from tangram_studio.watching import episodes_picture, recent_runs, view
from worker.discovery import MasterAddress

pytestmark = pytest.mark.fast

RESULT = {
    "mean_reward": 0.9312,
    "mean_reward_camera": None,
    "raw_overlap": 0.9656,
    "angle_error_deg_median": 1.214,
    "position_error_median": 0.01034,
    "scored_updates": 1234,
    "updates": 1234,
    "episodes": 5678,
    "train_s": 61.0,
    "wall_s": 75.0,
    "ended_by": "max_updates=1234",
}
STAGES = [{"updates": 100, "tokens": 2}, {"updates": 500, "targets": "connected"}]
STATUS = RunStatus(
    {"updates": 150.0, "share": 0.25, "evaluators": 0.0, "scored_updates": 120.0, "train_s": 9.0}
    | {"test/mean_reward": 0.5},
    {"run": "mine", "run_id": "r", "activity": "learning, workers wait"},
    np.array([[0, 3, 1, 0.5, 8, 10, 320, 320, 2]], np.float64),
)
PNG = b"\x89PNG\r\n\x1a\nwhatever"


def point(updates: float, **more: object) -> dict[str, object]:
    return {"updates": updates, "train_s": updates / 10, "mean_reward": 0.5} | more


def lines(*points: object) -> str:
    return "".join(json.dumps(one) + "\n" for one in points)


def made(folder: Path, curve: str | None = None, **files: object) -> Path:
    """A run folder with settings, and what is named."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.yaml").write_text(yaml.safe_dump({"sim": files.pop("sim", {})}))
    if curve is not None:
        (folder / "curve.jsonl").write_text(curve)
    for name, content in files.items():
        (folder / f"{name}.json").write_text(json.dumps(content))
    return folder


def refused(source: object) -> str:
    with pytest.raises(RunError) as caught:
        view(str(source))
    (line,) = str(caught.value).splitlines()
    return line


@pytest.fixture
def answering(monkeypatch: pytest.MonkeyPatch) -> None:
    """A master of run r that answers whoever asks anything."""
    monkeypatch.setattr(watching, "ask_alone", lambda _connect, _patience_s: STATUS)


# A run


def test_a_finished_run_is_shown_with_its_result(tmp_path: Path) -> None:
    curve = lines(point(0), point(1234, coverage=0.75, share_solved=0.2))
    folder = made(tmp_path / "mine", curve, result=RESULT)
    at = time.mktime((2025, 11, 25, 6, 23, 0, 0, 0, -1))
    os.utime(folder / "result.json", (at, at))
    assert view(str(folder)) == {
        "source": str(folder),
        "name": "mine",
        "folder": str(folder),
        "state": "ended",
        "activity": "",
        "told": ["The run has ended, by max_updates=1234, on 2025-11-25 at 06:23."],
        "share": None,
        "rows": [
            ("mean reward", "0.931 on exact polygons"),
            ("", "- in the camera's pictures"),
            ("raw overlap", "0.966"),
            ("angle error", "1.21° (median)"),
            ("position error", "0.0103 (median)"),
            ("episodes", "5,678"),
            ("updates", "1,234"),
            ("time", "1:01 of training, 1:15 in all"),
            ("ended by", "max_updates=1234"),
            ("covered", "75.0% of the target, last test"),
            ("solved", "20% of test episodes"),
        ],
        "workers": {"columns": watching.TABLE_COLUMNS, "rows": [], "more": 0},
        "curve": [point(0), point(1234, coverage=0.75, share_solved=0.2)],
        "stage": None,
        "episodes": None,
    }


def test_a_run_without_master_and_result_has_stopped(tmp_path: Path) -> None:
    shown = view(str(made(tmp_path, lines(point(0), point(40)))))
    assert (shown["state"], shown["name"]) == ("stopped", tmp_path.name)
    assert shown["told"][0].startswith("No master answers, and the run has no result (no connec")
    assert "its last score came 0:0" in shown["told"][1]
    assert shown["rows"] == [("last test", "mean reward 0.500 after 40 updates"), ("time", "0:04")]


def test_a_live_master_is_shown_with_its_folder(tmp_path: Path, answering: None) -> None:
    connection = {"endpoint": "tcp://h:1", "run_id": "r"}
    folder = made(tmp_path, lines(point(100)), connection=connection, result=RESULT)
    shown = view(str(folder))
    assert (shown["state"], shown["name"], shown["share"]) == ("training", "mine", 0.25)
    assert shown["told"] == [
        "The master answers: learning, workers wait.",
        "No evaluator takes part: there are no new scores.",
    ]
    assert ("updates", "150, -1.0/s, -1 due") in shown["rows"]
    assert shown["workers"]["rows"] == [
        ("worker 3", "0.5 s ago", "8 behind", "10", "320", "2"),
    ]
    assert shown["curve"] == [point(100)]
    assert view(str(folder / "connection.json")) == shown | {
        "source": str(folder / "connection.json")
    }


def test_of_a_master_alone_the_newest_score_is_the_curve(answering: None) -> None:
    shown = view("127.0.0.1:1234")
    assert shown["curve"] == [{"updates": 120.0, "train_s": 9.0, "mean_reward": 0.5}]
    assert (shown["folder"], shown["episodes"], shown["stage"]) == (None, None, None)
    assert "begins where you began to watch" in shown["told"][2]


def test_another_runs_master_at_its_address_is_not_taken_for_its_own(
    tmp_path: Path, answering: None
) -> None:
    folder = made(tmp_path, "", connection={"endpoint": "tcp://h:1", "run_id": "other"})
    shown = view(str(folder))
    assert shown["state"] == "stopped"
    assert "another run's master" in shown["told"][0]


@pytest.mark.parametrize(
    ("activity", "state"),
    [("learning", "training"), ("waiting for workers to join", "waiting"), ("", "waiting")],
)
def test_whether_a_master_learns_is_its_state(
    monkeypatch: pytest.MonkeyPatch, activity: str, state: str
) -> None:
    status = RunStatus({}, {"activity": activity}, STATUS.workers)
    monkeypatch.setattr(watching, "ask_alone", lambda *_: status)
    assert view("127.0.0.1:1234")["state"] == state


@pytest.mark.parametrize(
    ("updates", "number", "told", "then"),
    [
        (99, 0, "stage 0 of 2: all tokens to move, targets uniform", "stage 1 of 2: 2 tokens"),
        (100, 1, "stage 1 of 2: 2 tokens to move, targets uniform", "from update 500 on"),
        (900, 2, "stage 2 of 2: all tokens to move, targets connected", ""),
    ],
)
def test_the_stage_of_a_curriculum_is_that_of_its_updates(
    tmp_path: Path, updates: int, number: int, told: str, then: str
) -> None:
    stage = view(str(made(tmp_path, lines(point(updates)), sim={"stages": STAGES})))["stage"]
    assert (stage["number"], stage["of"], stage["told"]) == (number, 2, told)
    assert then in stage["then"]
    assert bool(then) == bool(stage["then"])


@pytest.mark.parametrize("content", ["[]", "sim: 3", "sim: {stages: 3}", "sim: [", "\0", "a: " * 9])
def test_settings_that_cannot_be_read_are_told_beside_the_rest(
    tmp_path: Path, content: str
) -> None:
    folder = made(tmp_path, lines(point(1)))
    (folder / "config.yaml").write_text(content)
    shown = view(str(folder))
    assert (shown["stage"], len(shown["curve"])) == (None, 1)
    assert shown["told"][-1].startswith("Its settings cannot be read: ")


# The curve


def test_a_growing_curve_is_read_anew(tmp_path: Path) -> None:
    folder = made(tmp_path, lines(point(0)))
    assert view(str(folder))["curve"] == [point(0)]
    with (folder / "curve.jsonl").open("a") as file:
        file.write(json.dumps(point(10)) + '\n{"updates": 20, "tr')
    shown = view(str(folder))
    assert shown["curve"] == [point(0), point(10)]
    assert len(shown["told"]) == 2  # what is just being written is no fault
    with (folder / "curve.jsonl").open("a") as file:
        file.write('ain_s": 2, "mean_reward": 0.5}')
    assert view(str(folder))["curve"] == [point(0), point(10), point(20)]


@pytest.mark.parametrize(
    "line",
    [
        '{"updates": 5, "train_s": 1}',
        '{"updates": 5, "train_s": 1, "mean_reward": NaN}',
        '{"updates": 5, "train_s": 1, "mean_reward": Infinity}',
        '{"updates": 5, "train_s": 1, "mean_reward": 1e999}',
        '{"updates": 5, "train_s": 1, "mean_reward": 1e300}',
        f'{{"updates": 1{"0" * 400}, "train_s": 1, "mean_reward": 0}}',
        f'{{"updates": 1{"0" * 9000}, "train_s": 1, "mean_reward": 0}}',
        '{"updates": -5, "train_s": 1, "mean_reward": 0}',
        '{"updates": true, "train_s": 1, "mean_reward": 0}',
        '{"updates": "5", "train_s": 1, "mean_reward": 0}',
        '{"updates": 5, "train_s": 1, "mean_reward": 0, "coverage": NaN}',
        "[1, 2, 3]",
        "7",
        "null",
        "no JSON",
        '"\ud800"',
        "[" * 50_000,
        '{"updates": 5, "train_s": 1, "mean_reward": 0}' + " " * 10**5,
    ],
    ids=range(18),
)
def test_a_line_that_is_no_score_is_left_out_and_counted(tmp_path: Path, line: str) -> None:
    folder = made(tmp_path, "")
    text = lines(point(0)) + line + "\n\n" + lines(point(10, angle_error_deg_median=float("nan")))
    (folder / "curve.jsonl").write_bytes(text.encode(errors="surrogatepass"))
    shown = view(str(folder))
    assert shown["curve"] == [point(0), point(10)]
    assert shown["told"][-1] == "1 line of curve.jsonl could not be read and left out."
    json.dumps(shown, allow_nan=False)


def test_a_long_curve_is_thinned_evenly_and_keeps_its_ends(tmp_path: Path) -> None:
    shown = view(str(made(tmp_path, lines(*map(point, range(1001))))))
    updates = [one["updates"] for one in shown["curve"]]
    assert (len(updates), updates[0], updates[-1]) == (watching.MAX_POINTS, 0, 1000)
    assert set(np.diff(updates)) <= {2, 3}


@pytest.mark.parametrize(("name", "most"), [("MAX_CURVE", 5000), ("MAX_LINES", 50)])
def test_of_a_huge_file_the_end_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, most: int
) -> None:
    monkeypatch.setattr(watching, name, most)
    shown = view(str(made(tmp_path, lines(*map(point, range(1000))))))
    assert shown["curve"][-1] == point(999)
    assert 40 < len(shown["curve"]) < 100
    assert shown["told"][-1].endswith("its newest part is shown.")
    assert not any("could not be read" in one for one in shown["told"])  # a line cut is no fault


# What is no run


def test_a_wrong_name_is_told_in_one_line(tmp_path: Path) -> None:
    file, loop, empty = tmp_path / "f.txt", tmp_path / "loop", tmp_path / "empty"
    file.write_text("text")
    loop.symlink_to(loop)
    empty.mkdir()
    remedy = "name a run folder, its connection.json, or host:port of a master"
    for source, words in {
        "": f"no run is named: {remedy}",
        "   ": "no run is named",
        str(tmp_path / "nothing"): f"there is no {tmp_path}/nothing: {remedy}",
        str(file / "below"): "there is no ",
        str(file): f"{file} is no connection file (it is not JSON): name host:port, a run folder",
        str(empty): f"{empty} is no run folder, it has none of config.yaml, curve.jsonl, result.",
        "a\0b": f"'a?b' cannot be the name of a file: {remedy}",
        "a\nb": "there is no a?b: ",
        "\ud800": "cannot be the name of a file",
        "x" * 300: "(File name too long): name a run folder",
        "x/" * 3000: "cannot be the name of a file",
        str(loop): "cannot read ",
        "~nobody_of_this_name/run": "is in the home of nobody who is known here",
        "/dev/null": "/dev/null is no file",
        "127.0.0.1:99999": "the port from 1 to 65535",
        "http://a:1/b": "is no address: it must be tcp://host:port",
    }.items():
        line = refused(source)
        assert words in line, source
        assert len(line) <= watching.MAX_TOLD
        with pytest.raises(TangramError):
            episodes_picture(source)


def test_what_the_system_refuses_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = made(tmp_path, lines(point(0)))

    def denied(self: Path) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "is_file", denied)
    assert f"cannot read {folder} (Permission denied): name a run folder" in refused(folder)


@pytest.mark.parametrize(
    "content",
    ["", "[]", "{}", json.dumps(RESULT | {"ended_by": None}), "[" * 100_000],
    ids=["empty", "list", "map", "null", "deep"],
)
def test_a_damaged_result_is_refused(tmp_path: Path, content: str) -> None:
    folder = made(tmp_path, lines(point(0)))
    (folder / "result.json").write_text(content)
    assert "result.json is no result of a run" in refused(folder)


@pytest.mark.parametrize("name", ["result.json", "connection.json", "config.yaml", "curve.jsonl"])
def test_a_pipe_in_place_of_a_file_holds_nobody(tmp_path: Path, name: str) -> None:
    folder = made(tmp_path, lines(point(0)))
    (folder / name).unlink(missing_ok=True)
    os.mkfifo(folder / name)
    try:
        told = view(str(folder))["told"]
    except RunError as error:
        told = [str(error)]
    assert any(f"{name} is no file" in one for one in told)


def test_a_file_larger_than_any_master_writes_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watching, "MAX_SETTINGS", 100)
    assert "result.json has more than" in refused(made(tmp_path, "", result=RESULT))


# Its picture


def test_the_picture_is_given_as_it_is(tmp_path: Path) -> None:
    folder = made(tmp_path, "")
    (folder / "test_episodes.png").write_bytes(PNG)
    os.utime(folder / "test_episodes.png", (5.25, 5.25))
    assert view(str(folder))["episodes"] == {"at": 5.25}
    assert episodes_picture(str(folder)) == PNG


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (None, "has no test_episodes.png yet: a master draws it twice a minute"),
        (b"<svg onload=alert(1)>", "test_episodes.png is no PNG"),
        (b"", "test_episodes.png is no PNG"),
        (PNG * 100, "test_episodes.png has more than"),
    ],
)
def test_what_is_no_picture_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes | None, told: str
) -> None:
    monkeypatch.setattr(watching, "MAX_PICTURE", 1000)
    folder = made(tmp_path, "")
    if content is not None:
        (folder / "test_episodes.png").write_bytes(content)
    with pytest.raises(RunError, match=told):
        episodes_picture(str(folder))


def test_a_master_alone_has_no_picture() -> None:
    with pytest.raises(RunError, match="name its run folder"):
        episodes_picture("127.0.0.1:1234")


# The runs that there are


def test_recent_runs_are_the_newest_first_and_at_most_two_levels_deep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ages: dict[str, Any] = {
        "runs/old": 1,
        "runs/sweep/new": 4,
        "runs/sweep/older": 2,
        "runs/live": 3,
        "runs/a/b/too_deep": 5,
        "runs/live/within_a_run": 6,
        "runs/line\nbreak": 7,
    }
    for name, at in ages.items():
        folder = made(Path(name), None if name == "runs/live" else "")
        if name == "runs/live":
            (folder / "connection.json").write_text("{}")
        for path in folder.iterdir():
            os.utime(path, (at, at))
    made(Path("runs/settings_alone"))
    Path("runs/file").write_text("")
    Path("runs/loop").symlink_to("loop")
    found = recent_runs(Path("runs"))
    assert found == ["runs/sweep/new", "runs/live", "runs/sweep/older", "runs/old"]
    assert recent_runs(Path("runs"), 2) == found[:2]
    assert recent_runs(Path("nothing")) == []


def test_settings_that_came_with_an_address_have_its_stage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answering: None
) -> None:
    path = tmp_path / "learner.json"
    content = {"endpoint": "tcp://h:1", "run_id": "r", "settings": {"sim": {"stages": STAGES}}}
    path.write_text(json.dumps(content))
    shown = view(str(path))
    assert (shown["folder"], shown["stage"]["number"]) == (None, 1)
    assert isinstance(watching.find_master(str(path)), MasterAddress)
