"""Starting the product's commands, and waiting for files and processes without sleeping."""

import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

BIN = Path(sys.executable).parent
LIMIT_S = 60.0


def run(command: str, *arguments: str, cwd: Path, limit_s: float = LIMIT_S) -> str:
    """Run a command to its end and return what it printed; a failure shows that."""
    done = _ended(command, *arguments, cwd=cwd, limit_s=limit_s)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def refused(command: str, *arguments: str, cwd: Path) -> str:
    """Run a command that must refuse; the one line that it says."""
    done = _ended(command, *arguments, cwd=cwd, limit_s=LIMIT_S)
    assert done.returncode == 2, done.stdout + done.stderr
    (line,) = done.stderr.splitlines()
    return line


def _ended(
    command: str, *arguments: str, cwd: Path, limit_s: float
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [BIN / command, *arguments],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=limit_s,
        check=False,
    )


@contextmanager
def started(
    command: str, *arguments: str, cwd: Path, err: Path | None = None
) -> Iterator[subprocess.Popen[bytes]]:
    """A running command in a session of its own, killed at the end if it still runs."""
    with (
        (err or Path(os.devnull)).open("wb") as said,
        subprocess.Popen(
            [BIN / command, *arguments],
            cwd=cwd,
            stdout=subprocess.DEVNULL,
            stderr=said,
            start_new_session=True,
        ) as process,
    ):
        try:
            yield process
        finally:
            process.kill()


def pids_of(run_dir: Path) -> list[int]:
    """Processes whose command line names the run folder."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                line = (entry / "cmdline").read_bytes()
            except OSError:
                continue  # it ended meanwhile
            if str(run_dir).encode() in line and int(entry.name) != os.getpid():
                found.append(int(entry.name))
    return found


def wait_for_file(path: Path, process: subprocess.Popen[bytes], limit_s: float = LIMIT_S) -> None:
    """Wait until a file is there; fail when the process ends first or the time is over."""
    end = time.monotonic() + limit_s
    while not path.exists():
        try:
            process.wait(0.05)
        except subprocess.TimeoutExpired:
            assert time.monotonic() < end, f"no {path} after {limit_s} s"
            continue
        raise AssertionError(f"the process ended with {process.returncode} before {path} was there")


def all_ended(pids: list[int], limit_s: float = LIMIT_S) -> bool:
    """Wait until every one of these processes has ended."""
    end = time.monotonic() + limit_s
    for pid in pids:
        try:
            handle = os.pidfd_open(pid)
        except ProcessLookupError:
            continue
        with os.fdopen(handle) as file:
            if not select.select([file], [], [], max(0.0, end - time.monotonic()))[0]:
                return False
    return True
