"""tangram-status against a real hub."""

import json
import re
from collections import defaultdict
from dataclasses import asdict, replace
from pathlib import Path
from shlex import split

import pytest
import zmq

from master.hub.security import make_keys, make_pair
from tangram_core.errors import RunError, TangramError
from tangram_core.scores import written
from tangram_core.wire.messages import RunStatus
from tests.master.hub.dealers import Stage, staged
from tests.master.watch.test_console import BRACKETS
from tests.master.watch.test_health import STATUS
from tests.master.watch.test_result import RESULT
from tests.worker.talk.conversation import served
from tests.worker.talk.test_security import write_file
from worker.config import StatusConfig
from worker.status import _evaluator, _lines, ask_status, show_status

pytestmark = pytest.mark.cluster


def test_a_status_is_told_without_hello(tmp_path: Path) -> None:
    keys = make_keys()
    with staged(keys=keys) as stage, zmq.Context() as context:
        stage.hub.tell(STATUS)
        path = write_file(tmp_path, stage.hub, keys)
        found = served(stage, lambda: ask_status(str(path), context))
        assert isinstance(found, RunStatus)
        assert (found.numbers, found.texts) == (STATUS.numbers, STATUS.texts)
        assert stage.hub.peers == []
        assert not stage.hub.counters["strangers"]


def test_what_a_person_and_a_program_see_also_while_the_run_ends(
    stage: Stage, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stage.hub.tell(STATUS)
    path = str(write_file(tmp_path, stage.hub, None))
    assert served(stage, lambda: show_status(StatusConfig(path))) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("run r (?)\n")
    for line in (
        r"does +learning",
        r"updates +7, ",
        r"worker 3 +0\.5 s ago +8 behind +10 +320 +2 *\n",
        r"evaluator 0 +1\.5 s ago +- +0 +0 +0 *\n",
    ):
        assert re.search(line, shown)
    stage.hub.stop("the end")
    assert served(stage, lambda: show_status(StatusConfig(path, json=True))) == 0
    plain = json.loads(capsys.readouterr().out)
    assert (plain["run"], plain["updates"], len(plain["workers"])) == ("r", 7.0, 2)


def test_a_finished_run_shows_its_result(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, path = StatusConfig(str(tmp_path)), tmp_path / "result.json"
    path.write_text(json.dumps(RESULT))
    assert show_status(config) == 0
    shown = capsys.readouterr().out
    assert shown.startswith(f"run {tmp_path.name} has ended\n")
    assert re.search(r"ended by +max_updates=1234", shown)
    assert show_status(StatusConfig(str(tmp_path), json=True)) == 0
    assert json.loads(capsys.readouterr().out) == RESULT
    speed = {"scores": written([BRACKETS]), "speed": 1.5, "scored_updates": 1234}
    path.write_text(json.dumps(RESULT | speed))
    assert show_status(config) == 0
    assert re.search(r"speed \[m/s\] \[/\] +1\.500", capsys.readouterr().out)
    changes: list[dict[str, object]] = [
        {"wall_s": "x"},
        {"wall_s": float("inf")},
        {"mean_reward": 10**400},
        {"ended_by": None},
        {"ended_by": "max_updates=x"},
        {"ended_by": "\x1b[2J"},
        {"ended_by": "\ud800"},
    ]
    forged = [json.dumps(RESULT | change) for change in changes]
    for content in ("", "[]", "{}", *forged, "[" * 100_000):
        path.write_text(content)
        with pytest.raises(RunError, match=r"result\.json is no result of a run .*, or delete the"):
            show_status(config)


@pytest.mark.parametrize(("evaluators", "told"), [(0, True), (1, False)])
def test_a_run_without_an_evaluator_says_how_to_start_one(
    stage: Stage, tmp_path: Path, capsys: pytest.CaptureFixture[str], evaluators: int, told: bool
) -> None:
    numbers = {"updates": 7.0, "evaluators": evaluators, "play/reward": 0.5, "open_to_all": 1.0}
    stage.hub.tell(replace(STATUS, numbers=numbers))
    path = str(write_file(tmp_path, stage.hub, None))
    assert served(stage, lambda: show_status(StatusConfig(path))) == 0
    shown = capsys.readouterr().out
    assert re.search("players' reward +0.500, with exploration", shown)
    assert re.search("access +service.auth=off: open to whoever reaches the port", shown)
    start = f"tangram-worker connect={path} role=evaluator"
    said = f"no evaluator yet (tangram-train starts its own): {start}"
    assert shown.endswith(f"\n{said}\n") == told


def test_the_line_that_starts_an_evaluator_works_as_it_is(tmp_path: Path) -> None:
    path, content = tmp_path / "c.json", {"endpoint": "tcp://h:1", "run_id": "r"}
    mine = content | {"settings": {"reward": {"name": "/my own.py:near"}}}
    path.write_text(json.dumps(mine))
    start = f"tangram-worker connect={path} role=evaluator"
    assert split(_evaluator(str(path))) == [*split(start), "reward.name='/my own.py:near'"]
    assert _evaluator("h:1") == "tangram-worker connect=h:1 role=evaluator"
    pair, server = asdict(make_pair()), make_pair().public
    path.write_text(json.dumps(content | {"server_key": server, "keys": {"player": pair}}))
    said = f"{path} has no key for one; make it with tangram-keys (add=NAME role=evaluator)"
    assert _evaluator(str(path)) == said


@pytest.mark.parametrize(
    ("play", "learn", "told"),
    [
        (0.0, 500.0, None),
        (
            4000.0,
            500.0,
            "workers wait: 4,000 transitions/s can be played, 500 learned from; 1 worker would do",
        ),
        (
            400.0,
            500.0,
            "the learner waits: 400 transitions/s can be played, 500 learned from; "
            "5 workers would do",
        ),
    ],
)
def test_who_waits_for_whom_and_how_many_workers_would_do(
    play: float, learn: float, told: str | None
) -> None:
    numbers = defaultdict(float, could_play=play, could_learn=learn, players=4.0)
    assert dict(_lines(numbers, {})).get("balance") == told


def test_who_was_refused_is_shown_where_anybody_was() -> None:
    numbers = defaultdict(float, {"hub/refused_keys": 3.0, "hub/refused_handshakes": 1000.0})
    shown = dict(_lines(numbers, {}))
    assert shown["refused keys"] == "3 with no key for this run and role: see audit.jsonl"
    assert shown["ended handshakes"] == "1,000 connections that showed no key"
    assert not {"refused keys", "ended handshakes"} & set(dict(_lines(defaultdict(float), {})))


def test_nobody_there_is_told(tmp_path: Path) -> None:
    with zmq.Context() as context:
        with pytest.raises(TangramError, match=r"DNS knows no host 'no\.invalid' \(.+\): check"):
            ask_status("no.invalid:5555", context)
        with pytest.raises(TangramError, match="no connection file at .*: correct connect, or"):
            ask_status(str(tmp_path), context)
        (tmp_path / "config.yaml").touch()
        with pytest.raises(
            TangramError, match=r"started \d:\d\d ago and is still starting, or fail"
        ):
            ask_status(str(tmp_path / "connection.json"), context)
        with pytest.raises(TangramError, match=r"127\.0\.0\.1:9 has not answered for 0\.2 s"):
            ask_status("tcp://127.0.0.1:9", context, patience_s=0.2)


def test_keys_that_do_not_fit_are_told(tmp_path: Path) -> None:
    with staged(keys=make_keys()) as stage, zmq.Context() as context:
        path = write_file(tmp_path, stage.hub, make_keys())
        with pytest.raises(TangramError, match="wrong or stale connection file"):
            served(stage, lambda: ask_status(str(path), context))
