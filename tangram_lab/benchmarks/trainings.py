"""Start and watch trainings in the background, for trials and measurements."""

import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import zmq

from tangram_core.errors import TangramError
from tangram_core.run.code import override
from tangram_core.run.process import Lifeline
from worker.status import ask_status

LOOK_S = 0.3
PATIENCE_S = 60.0
MIB = 2**20


def command(name: str) -> list[str]:
    """The command line of tangram-NAME of this installation, for any current folder."""
    return [sys.executable, "-P", "-m", "tangram_cli", name]


def start_training(folder: Path, *settings: str, name: str = "train") -> "subprocess.Popen[bytes]":
    """Start tangram-NAME in the background; its output goes to the file `told` in the run folder.

    A training ends when this process ends, because the training holds a lifeline to this process.
    """
    folder.mkdir(parents=True)
    lifeline, variables = Lifeline(), dict(os.environ)
    if name == "train":  # a master with a lifeline would expect a launcher as its parent
        variables = lifeline.environment(variables)
    with (folder / "told").open("wb") as told:
        process = subprocess.Popen(
            [*command(name), override("run_dir", str(folder)), *settings],
            stdout=told,
            stderr=told,
            env=variables,
            pass_fds=[lifeline.read_end],
            start_new_session=True,
        )
    lifeline.started()
    return process


def free_port() -> int:
    """A TCP port that is free; the next port is usually free, too."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


def wait_for(path: Path, process: "subprocess.Popen[bytes]") -> None:
    """Wait until a training has written a file; TangramError if the training ends before."""
    while not path.exists():
        if process.poll() is not None:
            raise TangramError(f"the training ended before {path} was there")
        time.sleep(LOOK_S)


def processes_of(folder: Path) -> dict[psutil.Process, str]:
    """Process -> command line, for all processes whose command line contains the run folder."""
    found, quoted = {}, override("in", str(folder)).removeprefix("in='").removesuffix("'")
    for process in psutil.process_iter(["cmdline"]):
        line = " ".join(process.info["cmdline"] or ())  # None if the process has just ended
        if (str(folder) in line or quoted in line) and process.pid != os.getpid():
            found[process] = line
    return found


def numbers_of(folder: Path, patience_s: float = PATIENCE_S) -> dict[str, float]:
    """Name -> number in the status of a run; TangramError if the master does not answer in time."""
    with zmq.Context() as context:
        return dict(ask_status(str(folder), context, patience_s).numbers)


def result_of(folder: Path) -> dict[str, Any]:
    """The content of a finished run's result.json."""
    content = json.loads((folder / "result.json").read_text())
    assert isinstance(content, dict)
    return content
