"""The server that forks children: what may happen to it."""

import errno
import os
import signal
import time
from collections.abc import Iterator
from multiprocessing import forkserver
from queue import SimpleQueue
from unittest import mock

import psutil
import pytest

from master.children import Child
from master.forking import warm_up
from master.signals import SIGNALS
from tangram_core.errors import TangramError, UnavailableError
from tests.bodies import run_code

pytestmark = pytest.mark.cluster

LIMIT_S = 100.0
WAITS = "import signal; signal.pause()"


def waiting(ended: "SimpleQueue[Child]") -> Child:
    made = Child("worker", ["-c", WAITS], body=run_code)
    made.start(ended.put)
    return made


def server() -> psutil.Process:
    pid = forkserver._forkserver._forkserver_pid
    assert pid is not None  # psutil would take none for this process
    return psutil.Process(pid)


@pytest.fixture(autouse=True)
def nobody_is_left() -> Iterator[None]:
    yield
    if forkserver._forkserver._forkserver_pid is not None:
        for one in server().children():
            one.kill()


def test_signals_to_a_whole_job_end_its_children_and_leave_the_server() -> None:
    ended: SimpleQueue[Child] = SimpleQueue()
    first = waiting(ended)
    before = server()
    for number in SIGNALS:
        before.send_signal(number)
    for number in SIGNALS:
        if signal.getsignal(number) == signal.SIG_IGN:  # as nohup does, and children inherit it
            continue
        one = waiting(ended)
        one.signal(number)  # it may be forked and no more
        assert ended.get(timeout=LIMIT_S) is one
        assert one.clear() in (-number, 1)  # 1: KeyboardInterrupt
    assert first.alive
    assert server() == before
    first.signal(signal.SIGKILL)
    assert first.clear() == -signal.SIGKILL


def test_a_server_that_cannot_start_is_told_with_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails() -> None:
        raise OSError("AF_UNIX path too long")

    monkeypatch.setattr(forkserver, "ensure_running", fails)
    warm_up()  # leaves it to the first start
    told = r"no process can be started \(AF_UNIX path too long\): is TMPDIR, or /tmp, a short path"
    with pytest.raises(TangramError, match=told):
        waiting(SimpleQueue())


@pytest.mark.parametrize(
    ("error", "later"),
    [
        (EOFError(), True),
        (ConnectionResetError(), True),
        (OSError(errno.EAGAIN, "no process"), True),
        (OSError(errno.ENOMEM, "no memory"), True),
        (OSError(errno.EACCES, "not yours"), False),
    ],
)
def test_a_start_that_may_work_later_is_told_apart(
    monkeypatch: pytest.MonkeyPatch, error: Exception, later: bool
) -> None:
    monkeypatch.setattr(forkserver, "ensure_running", mock.Mock(side_effect=error))
    with pytest.raises(TangramError, match="no process can be started") as caught:
        waiting(SimpleQueue())
    assert isinstance(caught.value, UnavailableError) == later


def test_children_outlive_a_killed_server_and_others_can_be_started() -> None:
    ended: SimpleQueue[Child] = SimpleQueue()
    first = waiting(ended)
    before = server()
    before.kill()
    end = time.monotonic() + LIMIT_S
    while before.status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < end
        os.sched_yield()
    second = waiting(ended)
    assert first.alive
    assert second.alive
    assert server() != before
    for one in (first, second):
        one.signal(signal.SIGKILL)
        assert ended.get(timeout=LIMIT_S) is one
    assert first.clear() == 255  # nobody saw how it ended
    assert second.clear() == -signal.SIGKILL
