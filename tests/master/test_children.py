"""Child processes: how they are started, started again, and given up."""

import json
import os
import shlex
import signal
import time
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import psutil
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from master import children as children_module
from master.children import MAX_RESTARTS, Child, describe
from master.forking import environment
from tangram_core.run.code import argument, override
from tests.bodies import run_code

LIMIT_S = 100.0


def child(name: str, code: str, log: Path | None = None, **more: Any) -> Child:
    return Child(name, ["-c", code], log, body=run_code, **more)


def wait_for_status(pid: int, status: str) -> None:
    end = time.monotonic() + LIMIT_S
    while psutil.Process(pid).status() != status:
        assert time.monotonic() < end, status


@pytest.mark.fast
@pytest.mark.parametrize(
    ("status", "words"),
    [(0, "status 0"), (2, "status 2"), (-9, "SIGKILL"), (-15, "SIGTERM"), (-200, "signal 200")],
)
def test_statuses_in_words(status: int, words: str) -> None:
    assert describe(status) == words


TEXTS = st.text(st.characters(blacklist_categories=["Cs", "Cc"]) | st.sampled_from("\\'${}"))


@pytest.mark.fast
@given(TEXTS)
def test_any_path_is_read_back_from_an_override(value: str) -> None:
    (parsed,) = OverridesParser.create().parse_overrides([override("run_dir", value)])
    assert parsed.key_or_group == "run_dir"
    assert OmegaConf.create({"it": parsed.value()}).it == value


@pytest.mark.fast
@given(TEXTS)
def test_any_path_is_read_back_from_what_is_pasted(value: str) -> None:
    (word,) = shlex.split(argument("run_dir", f"runs/{value}"))
    (parsed,) = OverridesParser.create().parse_overrides([word])
    assert OmegaConf.create({"it": parsed.value()}).it == f"runs/{value}"


# (how long it lived, how long it was stopped, its status, restarts in a row or None to give up)
LIVES = {
    "restarts end": [
        *((59.0, 0.0, 1, i) for i in range(1, MAX_RESTARTS + 1)),
        (59.0, 0.0, 1, None),
    ],
    "wrong input is not tried again": [(1.0, 0.0, 2, None)],
    "a steady life clears the record": [(59.0, 0.0, -9, 1), (59.0, 0.0, -9, 2), (60.0, 0.0, -9, 1)],
    "one that only hung had none": [
        *((300.0, 0.0, 1, 1), (359.0, 0.0, 1, 2), (360.0, 0.0, 1, 1)),
        (300.0, 300.0, -9, 2),  # stopped, and killed for that
    ],
}


@pytest.mark.fast
@pytest.mark.parametrize("lives", LIVES.values(), ids=LIVES)
def test_restarts_come_later_and_later_and_end(
    monkeypatch: pytest.MonkeyPatch, lives: list[tuple[float, float, int, int | None]]
) -> None:
    monkeypatch.setattr(children_module.time, "monotonic", lambda: 1000.0)
    made = Child("worker", [], patience_s=300.0)
    for lived_s, made._frozen_s, status, restarts in lives:
        made._started_s = 1000.0 - lived_s
        assert made.plan_restart(status) == (restarts is not None)
        if restarts is not None:
            assert made.restarts == restarts
            assert made.next_start_s == 1000.0 + 0.5 * 2 ** (restarts - 1)


@pytest.mark.fast
def test_what_the_environment_lacks_is_waited_for_longer_and_longer_without_an_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(children_module.time, "monotonic", lambda: 1000.0)
    made = Child("worker", [])
    made._started_s, waits = 999.0, list[float]()
    for _ in range(2000):
        assert made.plan_restart(75)
        waits.append(made.next_start_s - 1000.0)
    assert waits[:12] == [0.5, 1, 2, 4, 8, 16, 32, 64, 128, 256, 300, 300]
    assert (set(waits[12:]), made.plan, made.restarts) == ({300.0}, "in 300 s", 0)
    made._started_s = 940.0  # it had all it needs
    assert made.plan_restart(75)
    assert made.plan == "in 0.5 s"
    made._started_s = 999.0
    assert made.plan_restart(1)
    assert (made.plan, made.restarts) == (f"1 of {MAX_RESTARTS}", 1)


@pytest.mark.cluster
def test_a_child_has_its_own_session_niceness_thread_and_log(
    tmp_path: Path,
) -> None:
    code = (
        "import os, json, psutil, sys; assert not os.read(0, 1); "
        "print(json.dumps([os.getsid(0) == os.getpid(), os.environ['OMP_NUM_THREADS'], "
        "psutil.Process().cmdline()[0][:7], {'torch', 'master.run'} <= sys.modules.keys()])); "
        "raise SystemExit(7)"
    )
    made = child("worker 0", code, tmp_path / "log")
    ended: SimpleQueue[Child] = SimpleQueue()
    for lives in (1, 2):
        made.start(ended.put)
        assert ended.get(timeout=LIMIT_S) is made
        assert made.clear() == 7
        assert [json.loads(line) for line in made.tail().splitlines()] == [
            [True, environment()["OMP_NUM_THREADS"], "tangram", True]
        ] * lives
    assert not made.alive
    (tmp_path / "log").unlink()
    (tmp_path / "log").mkdir()  # as where the run folder is gone: no reason to be without it
    made.start(ended.put)
    assert ended.get(timeout=LIMIT_S) is made
    assert made.clear() == 7
    assert made.tail() == ""
    (tmp_path / "log").rmdir()

    polite = child(
        "polite", "import signal; print(1, flush=True); signal.pause()", tmp_path / "log", nice=3
    )
    polite.start(ended.put)
    end = time.monotonic() + LIMIT_S
    while not polite.tail():
        assert time.monotonic() < end
    assert polite._process is not None
    nice = os.getpriority(os.PRIO_PROCESS, polite._process.pid)
    assert nice == min(os.getpriority(os.PRIO_PROCESS, 0) + 3, 19)
    polite.signal(signal.SIGKILL)
    ended.get(timeout=LIMIT_S)
    assert polite.clear() == -signal.SIGKILL


@pytest.mark.fast
def test_a_child_has_one_thread_or_the_users_own_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    assert environment()["OMP_NUM_THREADS"] == "1"
    monkeypatch.setenv("OMP_NUM_THREADS", "4")
    assert environment()["OMP_NUM_THREADS"] == "4"


@pytest.mark.cluster
def test_a_child_ends_with_its_parent() -> None:
    code = "import signal, tangram_core.run.process as own; own.watch_parent(); signal.pause()"
    made = child("worker", code)
    ended: SimpleQueue[Child] = SimpleQueue()
    made.start(ended.put)
    try:
        made._lifeline.cut()  # as the system does when this process dies
        assert ended.get(timeout=LIMIT_S) is made
    finally:
        made.signal(signal.SIGKILL)


@pytest.mark.cluster
def test_a_process_that_is_stopped_for_a_while_is_left_alone() -> None:
    made = child("worker", "import signal; signal.pause()", patience_s=10.0)
    made.start(lambda _: None)
    pid = made._process.pid
    try:
        made.signal(signal.SIGSTOP)
        wait_for_status(pid, psutil.STATUS_STOPPED)
        assert not made.kill_frozen(9.0)
        made.signal(signal.SIGCONT)
        wait_for_status(pid, psutil.STATUS_SLEEPING)
        assert not made.kill_frozen(9.0)  # it counts from the beginning the next time
        made.signal(signal.SIGSTOP)
        wait_for_status(pid, psutil.STATUS_STOPPED)
        assert not made.kill_frozen(9.0)
        made.patience_s = 0.0  # no watchdog
        assert not made.kill_frozen(1e9)
        made.patience_s = 10.0
        assert made.kill_frozen(1.0)
    finally:
        made.signal(signal.SIGKILL)
        assert made.clear() == -signal.SIGKILL
