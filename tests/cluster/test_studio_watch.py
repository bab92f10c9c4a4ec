"""What the page shows of a real run: while it goes on, at its end, and after it was killed."""

import json
import os
import signal
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from tangram_sim.errors import TangramError
from tangram_studio.watching import episodes_picture, view
from tests.cluster.processes import LIMIT_S, all_ended, pids_of, started, wait_for_file

pytestmark = pytest.mark.cluster

QUICK = ("agent=quick", "sim=kinematic", "service.eval_seconds=1", "max_updates=1000000")


def seen_live(folder: Path) -> dict[str, Any]:
    """The view of a run as soon as it learns and has scores."""
    end = time.monotonic() + LIMIT_S
    while not ((shown := view(str(folder)))["state"] == "training" and len(shown["curve"]) > 1):
        assert time.monotonic() < end, shown["told"]
    return shown


def test_a_run_is_watched_while_it_goes_on_and_after_its_end(folder: Path) -> None:
    arguments = (f"run_dir={folder}", *QUICK)
    with started("tangram-train", *arguments, cwd=folder.parent) as process:
        wait_for_file(folder / "connection.json", process)
        shown = seen_live(folder)
        assert shown["name"] == folder.name
        assert shown["told"][0] == f"The master answers: {shown['activity']}."
        assert dict(shown["rows"])["does"] == shown["activity"]
        assert {row[0] for row in shown["workers"]["rows"]} <= {"worker 0", "evaluator 0"}
        assert 0 <= shown["share"] <= 1
        wait_for_file(folder / "test_episodes.png", process)  # newest ones, while it learns
        assert seen_live(folder)["episodes"]["at"] > 0
        process.send_signal(signal.SIGINT)
        process.wait(LIMIT_S)
    shown = view(str(folder))
    assert shown["state"] == "ended"
    assert shown["told"][0].startswith("The run has ended, by Ctrl-C (SIGINT), on ")
    assert dict(shown["rows"])["updates"] == f"{shown['curve'][-1]['updates']:,}"
    assert shown["workers"]["rows"] == []
    assert shown["episodes"]["at"] > 0
    assert episodes_picture(str(folder)).startswith(b"\x89PNG")
    json.dumps(shown, allow_nan=False)


def test_a_master_that_was_killed_is_told(folder: Path) -> None:
    arguments = (f"run_dir={folder}", "service.bind=127.0.0.1", "service.auth=off", *QUICK)
    with started("tangram-train", *arguments, cwd=folder.parent) as process:
        wait_for_file(folder / "connection.json", process)
        seen_live(folder)
        endpoint = json.loads((folder / "connection.json").read_text())["endpoint"]
        alone = view(endpoint)
        assert alone["folder"] is None
        assert alone["curve"][0]["updates"] >= 0
        pids = pids_of(folder)
        for pid in pids:  # the master too, which would end in good order without tangram-train
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        assert all_ended(pids)
    shown = view(str(folder))
    assert shown["state"] == "stopped"
    assert shown["told"][0].startswith("No master answers, and the run has no result (the master")
    assert len(shown["curve"]) > 1
    with pytest.raises(TangramError, match="has not answered for 2 s"):
        view(endpoint)
