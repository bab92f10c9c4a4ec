"""Trainings in the background, as the trials start and watch them."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from tangram_sim.errors import TangramError

LOOK_S = 0.3


def start_training(folder: Path, *settings: str) -> "subprocess.Popen[bytes]":
    """tangram-train in the background; what it says goes to `told` in its folder."""
    folder.mkdir(parents=True)
    command = [Path(sys.executable).with_name("tangram-train"), f"run_dir={folder}", *settings]
    with (folder / "told").open("wb") as told:
        return subprocess.Popen(command, stdout=told, stderr=told, start_new_session=True)


def wait_for(path: Path, process: "subprocess.Popen[bytes]") -> None:
    """Wait for a file of a training that runs; TangramError if that ends before."""
    while not path.exists():
        if process.poll() is not None:
            raise TangramError(f"the training ended before {path} was there")
        time.sleep(LOOK_S)


def processes_of(folder: Path) -> dict[int, str]:
    """Process -> command line, of those that name a run folder."""
    found = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                line = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:
                continue  # it ended meanwhile
            if str(folder) in line:
                found[int(entry.name)] = line
    return found


def result_of(folder: Path) -> dict[str, Any]:
    """The content of a finished run's result.json."""
    content = json.loads((folder / "result.json").read_text())
    assert isinstance(content, dict)
    return content
