"""A child ends with its parent, and a process that hangs ends itself; with real processes."""

import os
import select
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from tangram_core.errors import ConfigError
from tangram_core.run.process import VARIABLE, Lifeline, quiet, watch_parent

pytestmark = pytest.mark.cluster

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 30.0

# Tells when it watches, then waits for ever; `kind` decides how it takes SIGTERM.
CHILD = """
    import signal, sys, threading
    from tangram_core.run.process import watch_parent
    kind = sys.argv[1]
    if kind == "orderly":
        signal.signal(signal.SIGTERM, lambda *_: (print("orderly", flush=True), sys.exit(3)))
    if kind == "stubborn":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    watched = watch_parent(lambda line: print("heard", line, flush=True), grace_s=0.2)
    print("watches" if watched else "alone", flush=True)
    if watched:
        while True:
            signal.pause()
"""
# Starts a child as the launcher does, tells its pid, and waits for ever.
PARENT = """
    import signal, subprocess, sys
    from master.children import Child
    from pathlib import Path
    from tests.bodies import run_code
    child = Child("child", ["-c", sys.argv[1], "plain"], Path(sys.argv[2]), body=run_code)
    child.start(lambda _child: None)
    print(child._process.pid, flush=True)
    while True:
        signal.pause()
"""


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT)}


def start_child(line: Lifeline, kind: str) -> "subprocess.Popen[str]":
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(CHILD), kind],
        env=line.environment(environment()),
        pass_fds=[line.read_end],
        stdout=subprocess.PIPE,
        text=True,
    )
    line.started()
    return process


@pytest.mark.parametrize(
    ("kind", "status", "last"),
    [("plain", -signal.SIGTERM, ""), ("orderly", 3, "orderly\n"), ("stubborn", 1, "")],
)
def test_a_cut_lifeline_ends_the_child(kind: str, status: int, last: str) -> None:
    line = Lifeline()
    with start_child(line, kind) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "watches\n"
        assert line.tell("one")
        assert line.tell("two")
        assert [child.stdout.readline() for _ in range(2)] == ["heard one\n", "heard two\n"]
        assert child.poll() is None
        line.cut()
        assert child.wait(LIMIT_S) == status
        assert child.stdout.read() == last


def test_a_child_ends_when_its_parent_is_killed(tmp_path: Path) -> None:
    command = [sys.executable, "-c", textwrap.dedent(PARENT)]
    log = tmp_path / "child.log"
    with subprocess.Popen(
        [*command, textwrap.dedent(CHILD), str(log)],
        env=environment(),
        stdout=subprocess.PIPE,
        text=True,
    ) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        with os.fdopen(os.pidfd_open(child)) as handle:
            assert select.select([handle], [], [], 0.0)[0] == []
            parent.kill()
            assert select.select([handle], [], [], LIMIT_S)[0] == [handle]
        assert parent.wait(LIMIT_S) == -signal.SIGKILL


def test_without_a_parent_nothing_is_watched() -> None:
    command = [sys.executable, "-c", textwrap.dedent(CHILD), "plain"]
    alone = {name: value for name, value in environment().items() if name != VARIABLE}
    done = subprocess.run(command, env=alone, capture_output=True, text=True, check=True)
    assert done.stdout == "alone\n"


@pytest.mark.parametrize("value", ["none", "-1", "987654"])
def test_a_variable_that_names_no_file_is_refused(
    monkeypatch: pytest.MonkeyPatch, value: str
) -> None:
    monkeypatch.setenv(VARIABLE, value)
    with pytest.raises(ConfigError, match=f"{VARIABLE} must be the number of an open file"):
        watch_parent()
    assert VARIABLE not in os.environ


def test_telling_a_child_that_does_not_listen_does_not_block() -> None:
    line = Lifeline()
    taken = 0
    while line.tell("x" * 1000):
        taken += 1
    assert 10 < taken < 10_000
    line.started()
    assert not line.tell("nobody")
    line.cut()


# The watchdog

HANGS = """
import time, threading
from contextlib import suppress
from tangram_core.run.process import Watchdog
def hang_here():
    {hang}
with Watchdog(0.0) as off:
    off.progress()
with Watchdog(0.5) as dog:
    with suppress(ValueError), dog.patient():
        time.sleep(0.8)
        raise ValueError
    for _ in range({steps}):
        dog._wound_s = 0.0  # each call counts
        dog.progress()
        time.sleep(0.1)
    if {hangs}:
        hang_here()
hang_here()
print("left in order")
"""


def ended(hang: str, steps: int, hangs: bool = True) -> "subprocess.CompletedProcess[str]":
    code = HANGS.format(hang=hang, steps=steps, hangs=hangs)
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=50, check=False
    )


@pytest.mark.parametrize(
    ("hang", "steps"),
    [
        ("threading.Lock().acquire() and threading.Event().wait()", 10),
        ("threading.Event().wait()", 0),  # after what it was patient with, and which failed
        # Holds the interpreter in C, where no Python thread would ever get its turn.
        ("import re; re.match('(a+)+$', 'a' * 40 + 'b')", 1),
    ],
)
def test_a_process_that_hangs_ends_with_its_stack(hang: str, steps: int) -> None:
    """The first made progress for twice as long as the watchdog waits."""
    done = ended(hang, steps)
    assert done.returncode == 1
    assert "Timeout (0:00:00.5" in done.stderr
    assert "in hang_here" in done.stderr
    assert "left in order" not in done.stdout


def test_a_watchdog_that_is_off_or_was_left_ends_nothing() -> None:
    done = ended("time.sleep(0.8)", 1, hangs=False)  # longer than it waited
    assert (done.returncode, done.stdout, done.stderr) == (0, "left in order\n", "")


# Frees 40 MB in each of fifty rounds, and tells how many pages the system gave it meanwhile.
FREEING = """
    import resource, sys
    import numpy as np
    from tangram_core.run.process import keep_memory
    if sys.argv[1] == "kept":
        keep_memory()
    def work():
        return sum(part[0] for part in [np.ones(500_000) for _ in range(10)])
    work()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(50):
        work()
    print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def test_memory_that_was_freed_is_kept() -> None:
    """Without it the system gives the same pages again and again, large ones or small ones."""
    kept, given = (int(_output(FREEING, memory)) for memory in ("kept", "given"))
    assert 10 * kept < given


def test_what_c_code_prints_is_discarded_and_later_lines_are_not(
    capfd: pytest.CaptureFixture[str],
) -> None:
    with quiet(1, 2):
        os.write(1, b"lost")
        os.write(2, b"lost")
    os.write(1, b"kept")
    os.write(2, b"told")
    assert capfd.readouterr() == ("kept", "told")
    gone = os.dup(1)
    os.close(gone)
    with quiet(gone):  # like the stderr of a process that has none
        pass


def _output(code: str, *arguments: str) -> str:
    command = [sys.executable, "-c", textwrap.dedent(code), *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, check=True, timeout=LIMIT_S)
    return done.stdout.decode()
