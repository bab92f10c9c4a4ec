"""The runner of a study, with small real processes in the place of trainings."""

import json
import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from threading import Thread

import pytest
from rich.console import Console

from tangram_lab.experiments import runner
from tangram_lab.experiments.jobs import Job
from tangram_lab.experiments.runner import FAILED_STATUS, INTERRUPT_STATUS, Runner, StudyProgress

pytestmark = pytest.mark.cluster

LIMIT_S = 30.0
DONE = {"ended_by": "max_updates=1", "updates": 1, "scored_updates": 1}
# Arguments: the file to leave ("" for none), one to wait for ("" for none), a diary, a name.
SCRIPT = f"""
import json, signal, sys, time
from pathlib import Path
leaves, awaited, diary, name = sys.argv[1:]
def write(word):
    with open(diary, "a") as file:
        file.write(f"{{word}} {{name}}\\n")
def on_signal(number, frame):
    write(signal.Signals(number).name)
    if name != "stubborn":
        sys.exit(1)
signal.signal(signal.SIGTERM, on_signal)
write("start")
end = time.monotonic() + {LIMIT_S}
while awaited and not Path(awaited).exists() and time.monotonic() < end:
    time.sleep(0.01)
if awaited and not Path(awaited).exists():
    write("gave up")
    sys.exit(1)
write("end")
if leaves:
    Path(leaves).write_text('{json.dumps(DONE)}')
"""


@dataclass(frozen=True)
class Small(Job):
    """A job that runs SCRIPT."""

    awaits: str = ""
    leaves_file: bool = True

    @property
    def arguments(self) -> list[str]:
        leaves = str(self.leaves) if self.leaves_file else ""
        return ["-c", SCRIPT, leaves, self.awaits, str(self.run_dir.parent / "diary"), self.name]


def job(
    folder: Path, name: str, awaits: str = "", needs: Job | None = None, leaves: bool = True
) -> Small:
    run_dir = folder / name
    return Small(name, name, (), run_dir, run_dir / "result.json", needs, {}, True, awaits, leaves)


def start_of(folder: Path, jobs: list[Small], at_once: int) -> int:
    with (
        (folder / "told").open("w") as file,
        StudyProgress(Console(file=file, width=200), len(jobs), 0) as progress,
    ):
        return Runner(jobs, at_once, progress).run()


def diary(folder: Path) -> list[str]:
    path = folder / "diary"
    return path.read_text().splitlines() if path.exists() else []


def told(folder: Path) -> str:
    return (folder / "told").read_text()


def when(folder: Path, *lines: str) -> Thread:
    """Sends this process SIGINT once for each line, as soon as the diary has that line."""

    def send() -> None:
        end = time.monotonic() + LIMIT_S
        for line in lines:
            while line not in diary(folder) and time.monotonic() < end:
                time.sleep(0.01)
            os.kill(os.getpid(), signal.SIGINT)

    thread = Thread(target=send)
    thread.start()
    return thread


def test_so_many_run_at_once_and_no_more(tmp_path: Path) -> None:
    """The first waits for the second one's file; the third starts when there is room."""
    first = job(tmp_path, "first", awaits=str(tmp_path / "second" / "result.json"))
    jobs = [first, job(tmp_path, "second"), job(tmp_path, "third")]
    assert start_of(tmp_path, jobs, at_once=2) == 0
    lines = diary(tmp_path)
    assert lines.index("start third") > lines.index("end second")
    assert lines.index("end first") > lines.index("end second")
    assert all(one.done for one in jobs)


def test_one_at_a_time_keeps_the_order(tmp_path: Path) -> None:
    names = ["one", "two", "three"]
    assert start_of(tmp_path, [job(tmp_path, name) for name in names], at_once=1) == 0
    assert diary(tmp_path) == [f"{word} {name}" for name in names for word in ("start", "end")]


def test_a_job_waits_for_what_it_needs_while_others_go_on(tmp_path: Path) -> None:
    source = job(tmp_path, "source", awaits=str(tmp_path / "free" / "result.json"))
    jobs = [source, job(tmp_path, "needy", needs=source), job(tmp_path, "free")]
    assert start_of(tmp_path, jobs, at_once=3) == 0
    lines = diary(tmp_path)
    assert lines.index("start needy") > lines.index("end source") > lines.index("end free")


def test_what_needs_a_failed_job_is_not_started(tmp_path: Path) -> None:
    source = job(tmp_path, "source", leaves=False)
    jobs = [source, job(tmp_path, "needy", needs=source), job(tmp_path, "other")]
    assert start_of(tmp_path, jobs, at_once=1) == FAILED_STATUS
    assert "start needy" not in diary(tmp_path)
    assert "start other" in diary(tmp_path)
    assert "needy: not done, what it needs is missing" in told(tmp_path)
    assert f"source: failed, see {source.log}" in told(tmp_path)
    assert "[1/3] other: done" in told(tmp_path)


def test_a_signal_is_passed_on_and_nothing_more_starts(tmp_path: Path) -> None:
    thread = when(tmp_path, "start polite")
    jobs = [job(tmp_path, "polite", awaits=str(tmp_path / "never")), job(tmp_path, "next")]
    assert start_of(tmp_path, jobs, at_once=1) == INTERRUPT_STATUS
    thread.join()
    assert diary(tmp_path) == ["start polite", "SIGTERM polite"]
    assert "give the same command again to go on" in told(tmp_path)


def test_a_second_signal_ends_a_job_that_does_not_heed_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "STOP_S", 3600.0)
    thread = when(tmp_path, "start stubborn", "SIGTERM stubborn")
    jobs = [job(tmp_path, "stubborn", awaits=str(tmp_path / "never"))]
    assert start_of(tmp_path, jobs, at_once=1) == INTERRUPT_STATUS
    thread.join()
    assert diary(tmp_path) == ["start stubborn", "SIGTERM stubborn"]


def test_a_job_that_does_not_heed_a_signal_is_killed_after_a_while(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "STOP_S", 0.2)
    thread = when(tmp_path, "start stubborn")
    jobs = [job(tmp_path, "stubborn", awaits=str(tmp_path / "never"))]
    assert start_of(tmp_path, jobs, at_once=1) == INTERRUPT_STATUS
    thread.join()
    assert diary(tmp_path) == ["start stubborn", "SIGTERM stubborn"]
