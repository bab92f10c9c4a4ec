"""Trainings in the background, as the trials start and watch them."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from threading import Event, Thread
from typing import Any

import psutil
import yaml
import zmq

from master.children import command, override
from tangram_core.errors import TangramError
from tangram_core.run.process import Lifeline
from tangram_core.setup import Setup, make_setup
from worker.status import ask_status

LOOK_S = 0.3
PATIENCE_S = 60.0
MIB = 2**20


def start_training(folder: Path, *settings: str, name: str = "train") -> "subprocess.Popen[bytes]":
    """A training in the background, or a `master`; what it says goes to `told` in its folder.

    A training ends when this process is gone: its lifeline is never cut here.
    """
    folder.mkdir(parents=True)
    lifeline, variables = Lifeline(), dict(os.environ)
    if name == "train":  # a master with a lifeline takes its parent for a launcher
        variables = lifeline.environment(variables)
    with (folder / "told").open("wb") as told:
        process = subprocess.Popen(
            [sys.executable, *command(name), override("run_dir", str(folder)), *settings],
            stdout=told,
            stderr=told,
            env=variables,
            pass_fds=[lifeline.read_end],
            start_new_session=True,
        )
    lifeline.started()
    return process


def wait_for(path: Path, process: "subprocess.Popen[bytes]") -> None:
    """Wait for a file of a training that runs; TangramError if that ends before."""
    while not path.exists():
        if process.poll() is not None:
            raise TangramError(f"the training ended before {path} was there")
        time.sleep(LOOK_S)


@contextmanager
def running(*settings: str) -> Iterator[Path]:
    """Our service at work; the folder of its run, which is gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="tangram-") as name:
        folder = Path(name) / "run"
        launcher = start_training(folder, *settings)
        try:
            wait_for(folder / "connection.json", launcher)
            yield folder
        finally:
            launcher.terminate()
            launcher.wait(PATIENCE_S)


def processes_of(folder: Path) -> dict[psutil.Process, str]:
    """Process -> command line, of those that name a run folder."""
    found = {}
    for process in psutil.process_iter(["cmdline"]):
        line = " ".join(process.info["cmdline"] or ())  # none of a process that ended meanwhile
        if str(folder) in line and process.pid != os.getpid():
            found[process] = line
    return found


def numbers_of(folder: Path, patience_s: float = PATIENCE_S) -> dict[str, float]:
    """Those of a run's status; TangramError where its master does not answer in time."""
    with zmq.Context() as context:
        return dict(ask_status(str(folder), context, patience_s).numbers)


def result_of(folder: Path) -> dict[str, Any]:
    """The content of a finished run's result.json."""
    content = json.loads((folder / "result.json").read_text())
    assert isinstance(content, dict)
    return content


@dataclass
class Growth:
    """The most that a process has grown by.

    Attributes:
        mib: of memory.
        files: that it has open.
    """

    mib: float = 0.0
    files: int = 0


@dataclass
class Watched:
    """A training that is looked at from outside.

    Attributes:
        folder: of the run.
        launcher: tangram-train, or a master alone.
        context: of the sockets that ask it.
    """

    folder: Path
    launcher: "subprocess.Popen[bytes]"
    context: "zmq.Context[zmq.Socket[bytes]]"

    @property
    def where(self) -> dict[str, Any]:
        """What its connection file says."""
        content: dict[str, Any] = json.loads((self.folder / "connection.json").read_text())
        return content

    @cached_property
    def setup(self) -> Setup:
        """Its task."""
        return make_setup(yaml.safe_load((self.folder / "config.yaml").read_text()))

    @property
    def master(self) -> psutil.Process:
        """The process that learns."""
        found = [p for p, line in processes_of(self.folder).items() if "tangram_cli master" in line]
        if not found:
            raise TangramError("no master runs")
        return found[0]

    def numbers(self) -> Mapping[str, float]:
        """Those of its status; TangramError where it does not answer."""
        return ask_status(str(self.folder), self.context, 5.0).numbers

    def goes_on(self, more: float = 1.0, name: str = "episodes") -> bool:
        """Whether so many more of something come in time."""
        until_s, goal = time.monotonic() + PATIENCE_S, float("inf")
        while time.monotonic() < until_s:
            with suppress(TangramError):
                value = self.numbers()[name]
                goal = min(goal, value + more)
                if value >= goal:
                    return True
            time.sleep(LOOK_S)
        return False

    def told(self) -> str:
        """All lines of launcher and master."""
        return (self.folder / "told").read_text(errors="replace")

    @contextmanager
    def cost(self) -> Iterator[Growth]:
        """What the master grows by."""
        process, most, ends = self.master, Growth(), Event()
        mib, files = process.memory_info().rss / MIB, process.num_fds()

        def look() -> None:
            with suppress(psutil.Error):
                while not ends.wait(0.02):
                    most.mib = max(most.mib, process.memory_info().rss / MIB - mib)
                    most.files = max(most.files, process.num_fds() - files)

        watch = Thread(target=look, daemon=True)
        watch.start()
        try:
            yield most
        finally:
            ends.set()
            watch.join()
