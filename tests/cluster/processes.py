"""Starting the product's commands, and waiting for files and processes without sleeping."""

import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from unittest import mock

from hydra.core.global_hydra import GlobalHydra

from tangram_cli.commands import COMMANDS
from tangram_core import registry
from tangram_core.run import code

BIN = Path(sys.executable).parent
LIMIT_S = 600.0  # waits end by what they wait for; a busy machine takes minutes to start a master


def ended(
    *command: str | Path, cwd: Path, env: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """A command that has run to its end."""
    return subprocess.run(
        command, cwd=cwd, env=env, capture_output=True, text=True, timeout=LIMIT_S, check=False
    )


def run(command: str, *arguments: str, cwd: Path) -> str:
    """Run a command to its end and return what it printed; a failure shows that."""
    done = ended(BIN / command, *arguments, cwd=cwd)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def here(command: str, *arguments: str, cwd: Path) -> tuple[int, str, str]:
    """Run a command in this process, for what starts no other; its status, output and errors.

    A process of its own takes seconds, most of them for imports.
    """
    out, err = StringIO(), StringIO()
    with (
        chdir(cwd),
        redirect_stdout(out),
        redirect_stderr(err),
        mock.patch.object(sys, "argv", [command, *arguments]),
        mock.patch.object(sys, "meta_path", [*sys.meta_path]),
        mock.patch.dict(os.environ),
        mock.patch.object(registry, "_own", {}),  # what this command names is not the next one's
        mock.patch.object(code, "_named", set()),
    ):
        try:
            status = COMMANDS[command.removeprefix("tangram-")]()
        finally:
            GlobalHydra.instance().clear()
    return status, out.getvalue(), err.getvalue()


def run_here(command: str, *arguments: str, cwd: Path) -> str:
    """As `run`, in this process: for what starts no other."""
    status, out, err = here(command, *arguments, cwd=cwd)
    assert status == 0, out + err
    return out


def refused(command: str, *arguments: str, cwd: Path, wanted: int = 2) -> str:
    """Run a command that must refuse before it starts anything; the one line that it says."""
    status, out, err = here(command, *arguments, cwd=cwd)
    assert (status, out) == (wanted, ""), out + err
    (line,) = err.splitlines()
    return line


@contextmanager
def started(command: str, *arguments: str, cwd: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A running command in a session of its own, killed at the end if it still runs."""
    with subprocess.Popen(
        [BIN / command, *arguments],
        cwd=cwd,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ) as process:
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
