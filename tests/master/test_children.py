"""Child processes: how they are started, started again, and given up."""

import json
import os
import signal
import time
from pathlib import Path
from queue import SimpleQueue

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given
from hypothesis import strategies as st

from master import children as children_module
from master.children import MAX_RESTARTS, Child, describe, environment, override

LIMIT_S = 30.0


def child(code: str, log: Path | None = None) -> Child:
    return Child("worker 0", ["-c", code], log)


def run_once(made: Child) -> int:
    ended: SimpleQueue[Child] = SimpleQueue()
    made.start(ended.put)
    assert ended.get(timeout=LIMIT_S) is made
    return made.clear()


@pytest.mark.fast
@pytest.mark.parametrize(
    ("status", "words"),
    [(0, "status 0"), (2, "status 2"), (-9, "SIGKILL"), (-15, "SIGTERM"), (-200, "signal 200")],
)
def test_statuses_in_words(status: int, words: str) -> None:
    assert describe(status) == words


@pytest.mark.fast
@given(st.text(st.characters(blacklist_categories=["Cs", "Cc"], blacklist_characters="\\$")))
def test_any_path_is_read_back_from_an_override(value: str) -> None:
    (parsed,) = OverridesParser.create().parse_overrides([override("run_dir", value)])
    assert (parsed.key_or_group, parsed.value()) == ("run_dir", value)


@pytest.mark.fast
def test_restarts_come_later_and_later_and_end(monkeypatch: pytest.MonkeyPatch) -> None:
    made, starts = child(""), []
    made._started_s = 50.0
    monkeypatch.setattr(children_module.time, "monotonic", lambda: 100.0)
    for _ in range(MAX_RESTARTS):
        assert made.plan_restart(1)
        starts.append(made.next_start_s)
    assert starts == [100.5, 101.0, 102.0, 104.0, 108.0]
    assert not made.plan_restart(1)


@pytest.mark.fast
def test_wrong_input_is_not_tried_again() -> None:
    assert not child("").plan_restart(2)


@pytest.mark.fast
def test_a_steady_life_clears_the_record(monkeypatch: pytest.MonkeyPatch) -> None:
    made = child("")
    made.restarts = MAX_RESTARTS
    monkeypatch.setattr(children_module, "STEADY_S", -1.0)
    assert made.plan_restart(1)
    assert made.restarts == 1


@pytest.mark.cluster
def test_output_and_status_of_a_child(tmp_path: Path) -> None:
    made = child("print('said'); raise SystemExit(7)", tmp_path / "log")
    assert [run_once(made), run_once(made)] == [7, 7]
    assert made.tail() == "said\nsaid"
    assert not made.alive


@pytest.mark.cluster
def test_a_child_has_its_own_session_niceness_and_one_thread(tmp_path: Path) -> None:
    code = (
        "import os, json, sys; sys.stdin.read(); "
        "print(json.dumps([os.getsid(0) == os.getpid(), os.environ['OMP_NUM_THREADS']]))"
    )
    made = child(code, tmp_path / "log")
    assert run_once(made) == 0
    assert json.loads(made.tail()) == [True, environment()["OMP_NUM_THREADS"]]

    polite = Child("polite", ["-c", "import signal; signal.pause()"], tmp_path / "log", nice=3)
    ended: SimpleQueue[Child] = SimpleQueue()
    polite.start(ended.put)
    assert polite._process is not None
    nice = os.getpriority(os.PRIO_PROCESS, polite._process.pid)
    assert nice == min(os.getpriority(os.PRIO_PROCESS, 0) + 3, 19)
    polite.signal(signal.SIGKILL)
    ended.get(timeout=LIMIT_S)
    assert polite.clear() == -signal.SIGKILL


@pytest.mark.fast
@pytest.mark.parametrize(("given", "expected"), [(None, "1"), ("4", "4")])
def test_the_users_own_number_of_threads_wins(
    monkeypatch: pytest.MonkeyPatch, given: str | None, expected: str
) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if given is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", given)
    assert environment()["OMP_NUM_THREADS"] == expected


@pytest.mark.cluster
def test_a_process_that_is_stopped_for_a_while_is_left_alone() -> None:
    made = Child("worker", ["-c", "import signal; signal.pause()"], patience_s=10.0)
    made.start(lambda _: None)
    pid = made._process.pid
    try:
        made.signal(signal.SIGSTOP)
        os.waitid(os.P_PID, pid, os.WSTOPPED)
        assert not made.kill_frozen(9.0)
        made.signal(signal.SIGCONT)
        os.waitid(os.P_PID, pid, os.WCONTINUED)
        assert not made.kill_frozen(9.0)  # it counts from the beginning the next time
        made.signal(signal.SIGSTOP)
        os.waitid(os.P_PID, pid, os.WSTOPPED)
        assert not made.kill_frozen(9.0)
        made.patience_s = 0.0  # no watchdog
        assert not made.kill_frozen(1e9)
        made.patience_s = 10.0
        assert made.kill_frozen(1.0)
    finally:
        made.signal(signal.SIGKILL)
        assert made.clear() == -signal.SIGKILL


@pytest.mark.fast
def test_a_process_that_only_hung_has_no_steady_life() -> None:
    made = Child("worker", [], patience_s=300.0)
    lives = [(300.0, 1, 1), (359.0, 1, 2), (360.0, 1, 1), (59.0, -9, 2), (60.0, -9, 1)]
    for lived_s, status, restarts in lives:
        made._started_s = time.monotonic() - lived_s
        assert made.plan_restart(status)
        assert made.restarts == restarts
    made._frozen_s = 300.0  # and was killed for that
    made._started_s = time.monotonic() - 300.0
    assert made.plan_restart(-9)
    assert made.restarts == 2
