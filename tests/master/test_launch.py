"""Starting, restarting and ending children, with small real processes in place of the commands."""

import errno
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from threading import Event

import pytest

from master import children as children_module
from master import launch as launch_module
from master.children import MAX_RESTARTS, Child
from master.config import MasterConfig
from master.hub.gate import Room
from master.launch import Launcher, master_arguments, run_training
from master.record.rundir import RunFolder
from master.watch.console import logging_to, sturdy_console
from tangram_core.errors import ConfigError, UnavailableError
from tangram_core.run.service import ServiceConfig
from tangram_core.setup import from_mapping
from tests.bodies import run_code

LIMIT_S = 100.0
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)


@pytest.mark.fast
def test_the_master_gets_its_settings(tmp_path: Path) -> None:
    bounds = {"max_hours": 0.5, "max_updates": 7, "resume": "auto", "warm_start": "a b"}
    master = from_mapping(
        MasterConfig, {"run_dir": str(tmp_path), "seed": 3, "workers": 2, **bounds}
    )
    arguments = master_arguments(master, RunFolder(tmp_path))
    assert arguments == [
        "master",
        f"from_config='{tmp_path}/config.yaml'",
        f"run_dir='{tmp_path}'",
        "seed=3",
        "max_hours=0.5",
        "max_episodes=0",
        "max_updates=7",
        "resume=auto",
        "warm_start='a b'",
    ]
    in_step = replace(master, service=ServiceConfig(mode="lockstep"), warm_start=None)
    arguments = master_arguments(in_step, RunFolder(tmp_path))
    assert arguments[-1] == "workers=2"


@pytest.mark.fast
def test_a_folder_with_a_run_is_refused_before_anything_starts(tmp_path: Path) -> None:
    RunFolder(tmp_path).write_result({})
    with pytest.raises(ConfigError, match="holds a run already"):
        run_training(MasterConfig(str(tmp_path)), {})
    assert not (tmp_path / "logs").exists()


@pytest.mark.fast
def test_a_folder_in_use_is_left_alone(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    folder.connection.touch()
    with folder.lock(), pytest.raises(ConfigError, match="in use by another process"):
        run_training(MasterConfig(str(tmp_path), resume="auto"), {})
    assert folder.connection.exists()
    assert not folder.config.exists()


@pytest.mark.fast
def test_a_training_that_begins_a_moment_later_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before the master of the first has claimed the folder."""

    def second(_: Launcher) -> int:
        with pytest.raises(ConfigError, match="in use by another process"):
            run_training(MasterConfig(str(tmp_path)), {"seed": 2})
        return 7

    monkeypatch.setattr(Launcher, "run", second)
    files = list[str]()
    monkeypatch.setattr(Room, "here", lambda: files.append("raised"))
    assert run_training(MasterConfig(str(tmp_path)), {"seed": 1}) == 7
    assert files == ["raised"] * 2  # each child needs five here
    assert RunFolder(tmp_path).read_config() == {"seed": 1}
    monkeypatch.setattr(Launcher, "run", lambda _: 0)
    assert run_training(MasterConfig(str(tmp_path)), {"seed": 3}) == 0


# A master of a few lines: it says where it can be reached, and ends when it is told to.
MASTER = """
import os, signal, sys, threading
from pathlib import Path
from tangram_core.run.process import watch_parent
folder = Path({folder!r})
news = open(folder / "news", "w")
heard = threading.Event()
def hear(line):
    print(line, file=news, flush=True)
    if "the run ends" in line:
        heard.set()
watch_parent(hear)
def end():
    (folder / "connection.json").unlink()
    sys.exit(0)
def told(number, _):
    (folder / "signal").write_text(str(int(number)))
    heard.wait(30)  # the reason was sent before the signal
    end()
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1):
    signal.signal(number, told)
(folder / "connection.json").touch()
while {condition}:
    signal.sigtimedwait([], 0.05)
{ending}
"""
WORKER = """
import signal
from tangram_core.run.process import watch_parent
watch_parent()
signal.pause()
"""


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launch_module, "LEAVE_S", 0.2)
    monkeypatch.setattr(children_module, "FIRST_DELAY_S", 0.01)


def launcher(
    folder: Path,
    ending: str = "end()",
    condition: str = "True",
    players: Sequence[str] = (WORKER, WORKER),
    stubborn: bool = False,
) -> Launcher:
    """A launcher whose children run the given code."""
    run = RunFolder(folder)
    run.logs.mkdir()
    made = Launcher(MasterConfig(str(folder), workers=len(players)), run, {})
    code = MASTER.format(folder=str(folder), condition=condition, ending=ending)
    if stubborn:
        code = code.replace("number, told", "number, signal.SIG_IGN")
    made._master.arguments = ["-c", code]
    for player, own in zip(made._players, players, strict=True):
        player.arguments = ["-c", own]
    made._evaluator.arguments = ["-c", WORKER]
    for one in (made._master, *made._workers):
        one.body = run_code
    return made


def signalled(
    made: Launcher, number: signal.Signals, when: Callable[[], bool], patch: pytest.MonkeyPatch
) -> None:
    """Let the launcher get a signal whenever it looks after its children and something holds.

    It comes twice, as from a time limit that signals a process and then its whole group.
    """
    start = made._start_due

    def start_and_signal() -> None:
        start()
        if when():
            signal.raise_signal(number)
            signal.raise_signal(number)

    patch.setattr(made, "_start_due", start_and_signal)


def comes_back(folder: Path, end: str) -> str:
    """A worker that ends in this way the first time, and leaves a file the second time."""
    return f"""
import os, signal
from pathlib import Path
first = Path({str(folder / "first")!r})
if first.exists():
    Path({str(folder / "came_back")!r}).touch()
else:
    first.touch()
    os.kill(os.getpid(), signal.{end})
{WORKER}"""


def finish(made: Launcher, folder: Path) -> tuple[int, str]:
    """Run to the end; the status, and what was said through the master or beside it."""
    with (folder / "said").open("w") as said, logging_to(sturdy_console(said)), made.signals():
        try:
            status = made.run()
        finally:
            made.end_all()
    for one in [*made._workers, made._master]:
        assert not one.alive
    return status, (folder / "news").read_text() + (folder / "said").read_text()


def logs(*names: str) -> str:
    """True while these logs are empty: workers write there when they have started."""
    return " or ".join(f"not (folder / 'logs' / '{name}.log').exists()" for name in names)


@pytest.mark.cluster
@pytest.mark.parametrize(
    ("ending", "status", "said"),
    [
        ("end()", 0, ""),
        ("sys.exit(2)", 2, ""),
        ("sys.exit(5)", 5, "status 5"),
        ("os.kill(os.getpid(), 9)", 137, "SIGKILL"),
    ],
)
def test_everything_ends_with_the_master(
    tmp_path: Path, ending: str, status: int, said: str
) -> None:
    started = logs("worker-0", "worker-1", "evaluator")
    result, told = finish(launcher(tmp_path, ending, started), tmp_path)
    assert result == status
    tries = [f"({i} of {MAX_RESTARTS})" for i in range(1, MAX_RESTARTS + 1)]
    ended = f"the master ended with {said}"
    expected = [f"{ended}: it is started again with resume=auto {t}" for t in tries]
    expected.append(f"{ended}; the same command with resume=auto goes on from what was saved")
    assert told.splitlines() == (expected if said else [])


@pytest.mark.cluster
def test_a_master_that_lacks_something_is_started_again_however_often(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(children_module, "MAX_WAIT_S", 0.02)
    times = MAX_RESTARTS + 1
    ending = f"""
lives = len(list(folder.glob("life*")))
(folder / f"life {{lives}}").touch()
if lives < {times}:
    sys.exit(75)
end()"""
    made = launcher(tmp_path, ending, condition="False")
    made._evaluator.next_start_s = None
    status, told = finish(made, tmp_path)
    assert status == 0
    waits = [0.01, *[0.02] * (times - 1)]
    assert told.splitlines() == [
        f"the master ended with status 75: it is started again with resume=auto (in {wait:g} s)"
        for wait in waits
    ]


@pytest.mark.cluster
@pytest.mark.parametrize("status", [75, 1])
def test_a_signal_ends_a_master_that_waits_for_its_next_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, status: int
) -> None:
    monkeypatch.setattr(children_module, "FIRST_DELAY_S", 1000.0)
    monkeypatch.setattr(children_module, "MAX_WAIT_S", 1000.0)
    monkeypatch.setattr(children_module, "MAX_DELAY_S", 1000.0)
    made = launcher(tmp_path, f"sys.exit({status})", condition="False")

    def waits() -> bool:
        return made._master.next_start_s is not None and made._master.next_start_s > 0.0

    signalled(made, signal.SIGINT, waits, monkeypatch)
    result, told = finish(made, tmp_path)
    assert result == 128 + signal.SIGINT
    assert told.splitlines()[-1] == (
        "Ctrl-C (SIGINT): the run ends; the same command with resume=auto goes on from what was "
        "saved"
    )


@pytest.mark.cluster
def test_a_process_that_cannot_be_started_now_is_started_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start, failed = Child.start, list[str]()

    def starts(child: Child, ended: Callable[[Child], None]) -> None:
        if child.name not in failed:
            failed.append(child.name)
            child.next_start_s = None
            raise UnavailableError("no memory")
        start(child, ended)

    monkeypatch.setattr(Child, "start", starts)
    made = launcher(tmp_path, condition=logs("worker-0"), players=[WORKER])
    made._evaluator.next_start_s = None
    status, told = finish(made, tmp_path)
    assert status == 0
    assert told.splitlines() == [
        f"{name}: no memory (tried again in 0.01 s)" for name in ("worker 0", "master")
    ]


@pytest.mark.cluster
def test_a_worker_that_lacks_something_is_told_with_what(tmp_path: Path) -> None:
    player = f"""
from pathlib import Path
first = Path({str(tmp_path / "first")!r})
if not first.exists():
    first.touch()
    print("the room is full", flush=True)
    raise SystemExit(75)
Path({str(tmp_path / "came_back")!r}).touch()
{WORKER}"""
    waits = f"not Path({str(tmp_path / 'came_back')!r}).exists()"
    made = launcher(tmp_path, condition=waits, players=[player])
    status, told = finish(made, tmp_path)
    assert (status, made._players[0].restarts) == (0, 0)
    assert told.splitlines() == [
        "worker 0 ended with status 75: it is started again (in 0.01 s); "
        f"see {tmp_path}/logs/worker-0.log",
        "the room is full",
    ]


@pytest.mark.cluster
def test_when_no_worker_is_left_a_master_that_waits_is_not_waited_for(tmp_path: Path) -> None:
    made = launcher(tmp_path, players=["raise SystemExit(2)"])
    (tmp_path / "news").touch()
    (tmp_path / "connection.json").touch()
    made._master.next_start_s = time.monotonic() + 1000.0
    assert finish(made, tmp_path)[0] == 1


@pytest.mark.cluster
def test_a_master_that_is_killed_goes_on_and_its_workers_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ending = """
if "resume=auto" in sys.argv:
    end()
os.kill(os.getpid(), 9)
"""
    made = launcher(tmp_path, ending, logs("worker-0", "worker-1", "evaluator"))
    made._master.arguments = [*made._master.arguments, "resume=none"]
    made._folder.write_config({"seed": 3})
    made._folder.config.unlink()
    pids = []
    forget = Child.clear

    def noting(one: Child) -> int:
        pids.append([c._process.pid for c in made._workers if c._process is not None])
        return forget(one)

    monkeypatch.setattr(Child, "clear", noting)
    status, told = finish(made, tmp_path)
    assert status == 0
    assert told == (
        "the master ended with SIGKILL: it is started again with resume=auto "
        f"(1 of {MAX_RESTARTS})\n"
    )
    assert len(pids[0]) == 3
    assert pids[0] == pids[1]
    assert made._folder.config.read_text() == "seed: 3\n"  # the next life reads it


@pytest.mark.cluster
def test_workers_that_the_master_sent_home_may_leave_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(launch_module, "LEAVE_S", LIMIT_S)
    leaving = f"""
import signal
from pathlib import Path
print("plays", flush=True)
while Path({str(tmp_path / "connection.json")!r}).exists():
    signal.sigtimedwait([], 0.01)
signal.sigtimedwait([], 0.2)
print("left in order", flush=True)
"""
    plays = "not (folder / 'logs' / 'worker-0.log').read_text() == 'plays\\n'"
    made = launcher(tmp_path, condition=f"{logs('worker-0')} or {plays}", players=[leaving])
    made._evaluator.next_start_s = None
    assert finish(made, tmp_path) == (0, "")
    assert made._players[0].tail() == "plays\nleft in order"


@pytest.mark.cluster
def test_workers_that_a_failing_master_sent_home_come_back_with_it(tmp_path: Path) -> None:
    leaving = f"""
from pathlib import Path
import time
folder = Path({str(tmp_path)!r})
with open(folder / "joined", "a") as file:
    file.write("x")
while (folder / "connection.json").exists():
    time.sleep(0.01)
(folder / "left").touch()
"""
    ending = """
if "resume=auto" in sys.argv:
    end()
(folder / "connection.json").unlink()
while not (folder / "left").exists():
    signal.sigtimedwait([], 0.05)
signal.sigtimedwait([], 0.3)
sys.exit(5)
"""
    (tmp_path / "joined").touch()
    times = "(2 if 'resume=auto' in sys.argv else 1)"
    waits = f"len((folder / 'joined').read_text()) < {times}"
    made = launcher(tmp_path, ending, waits, players=[leaving])
    made._master.arguments = [*made._master.arguments, "resume=none"]
    made._evaluator.next_start_s = None
    assert finish(made, tmp_path)[0] == 0
    assert (tmp_path / "joined").read_text() == "xx"


@pytest.mark.fast
def test_a_worker_that_leaves_after_the_master_is_no_failure(tmp_path: Path) -> None:
    """Its end may be heard of before that of the master."""
    made = launcher(tmp_path, players=[WORKER])
    made._reached = True
    made._worker_ended(made._players[0])
    assert made._players[0].restarts == 0


@pytest.mark.cluster
def test_a_worker_whose_end_was_not_heard_of_yet_is_not_given_up(tmp_path: Path) -> None:
    """Two that end at one time are told of one after the other."""
    first, second = "raise SystemExit(1)", "raise SystemExit(2)"
    made = launcher(tmp_path, players=[first, second])
    ends: SimpleQueue[Child] = SimpleQueue()
    for player in made._players:
        player.start(ends.put)
    assert {ends.get(timeout=LIMIT_S), ends.get(timeout=LIMIT_S)} == set(made._players)
    made._worker_ended(made._players[1])
    assert not made._failed
    made._worker_ended(made._players[0])
    assert made._players[0].restarts == 1


@pytest.mark.cluster
def test_a_signal_while_everything_is_imported_ends_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, imported = launcher(tmp_path), Event()
    monkeypatch.setattr(launch_module, "warm_up", imported.wait)
    made._events.put(signal.SIGTERM)
    (tmp_path / "news").touch()
    assert finish(made, tmp_path) == (128 + signal.SIGTERM, "")
    assert not made._master.kept or made._master.next_start_s == 0.0  # it was never started
    imported.set()


@pytest.mark.cluster
def test_workers_start_only_when_the_master_can_be_reached(tmp_path: Path) -> None:
    made = launcher(tmp_path)
    made._master.arguments = ["-c", f"open({str(tmp_path / 'news')!r}, 'w'); raise SystemExit(2)"]
    assert finish(made, tmp_path)[0] == 2
    assert list((tmp_path / "logs").iterdir()) == []


@pytest.mark.cluster
@pytest.mark.parametrize(
    ("end", "told"),
    [("SIGKILL", []), ("SIGSTOP", ["worker 0 was stopped for 0.3 s and was killed"])],
)
def test_a_worker_that_dies_or_stays_stopped_is_started_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: str, told: list[str]
) -> None:
    monkeypatch.setattr(launch_module, "IDLE_S", 0.1)
    waits = f"not Path({str(tmp_path / 'came_back')!r}).exists()"
    made = launcher(tmp_path, condition=waits, players=[comes_back(tmp_path, end)])
    made._players[0].patience_s = 0.3
    status, said = finish(made, tmp_path)
    assert status == 0
    assert said.splitlines() == [
        *told,
        f"worker 0 ended with SIGKILL: it is started again (1 of {MAX_RESTARTS}); "
        f"see {tmp_path}/logs/worker-0.log",
    ]


@pytest.mark.cluster
@pytest.mark.parametrize("mode", ["async", "lockstep"])
def test_a_worker_whose_index_was_taken_is_no_failure_and_takes_part_in_no_contest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str
) -> None:
    """However often; in lockstep it must have its index, and takes it back after a while."""
    monkeypatch.setattr(launch_module, "TAKE_BACK_S", 0.01)
    times = MAX_RESTARTS + 1
    player = f"""
import sys
from pathlib import Path
folder = Path({str(tmp_path)!r})
lives = len(list(folder.glob("life*")))
(folder / f"life {{lives}} {{sys.argv[1]}}").touch()
if lives < {times}:
    print("12:00:00 player 0: ends: player 0 was taken over by a newer process")
    raise SystemExit(0)
{WORKER}"""
    made = launcher(tmp_path, condition=f"not list(folder.glob('life {times}*'))", players=[player])
    made._players[0].arguments = ["-c", player, "index=0"]
    made._in_step = mode == "lockstep"
    status, told = finish(made, tmp_path)
    assert status == 0
    remedy = {
        "async": "it continues with a free index",
        "lockstep": "it takes the index back in 0.01 s; start other workers without index=",
    }[mode]
    lost = "worker 0 lost its index to another worker that was started with this index"
    assert told.splitlines() == times * [f"{lost}: {remedy}"]
    last = "index=0" if mode == "lockstep" else "index=-1"
    assert (tmp_path / f"life {times} {last}").exists()


@pytest.mark.cluster
def test_when_no_worker_can_be_kept_the_run_ends_with_the_reason(tmp_path: Path) -> None:
    players = ["raise SystemExit('wrong tokens')", "print('bad input'); raise SystemExit(2)"]
    status, told = finish(launcher(tmp_path, players=players), tmp_path)
    assert status == 1
    assert told.count("it is started again") == MAX_RESTARTS
    assert "worker 0 ended with status 1: it is not started again\nwrong tokens\n" in told
    assert "worker 1 ended with status 2: it is not started again\nbad input\n" in told
    assert told.endswith("too few workers are left: the run ends\n")


@pytest.mark.cluster
def test_in_lockstep_a_worker_that_is_given_up_ends_the_run(tmp_path: Path) -> None:
    """A round would wait for its episodes for ever."""
    made = launcher(tmp_path, players=[WORKER, "raise SystemExit(2)"])
    made._in_step = True
    status, told = finish(made, tmp_path)
    assert status == 1
    assert told.endswith("too few workers are left: the run ends\n")


@pytest.mark.fast
def test_a_disk_that_fails_starts_no_worker_and_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, started = launcher(tmp_path), list[str]()
    monkeypatch.setattr(Child, "start", lambda child, _: started.append(child.name))

    def fails(*_: object, **__: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(Path, "stat", fails)
    made._start_due()
    assert started == ["master"]


@pytest.mark.cluster
@pytest.mark.parametrize("number", ENDING)
def test_a_signal_ends_the_master_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    before = signal.signal(number, signal.SIG_DFL)  # nohup and scripts may have it ignored
    made = launcher(tmp_path, ending="")
    signalled(made, number, lambda: made._players[0].alive and made._stop_s is None, monkeypatch)
    status, told = finish(made, tmp_path)
    signal.signal(number, before)
    assert status == 0
    assert (tmp_path / "signal").read_text() == str(int(number))
    name = "Ctrl-C (SIGINT)" if number == signal.SIGINT else number.name
    assert told == f"{name}: the run ends with a checkpoint; repeat it to end at once\n"


@pytest.mark.cluster
@pytest.mark.parametrize("signals", ["one", "many"])
def test_a_master_that_does_not_end_is_killed_by_the_second_signal_or_the_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, signals: str
) -> None:
    monkeypatch.setattr(launch_module, "STOP_S", 0.2 if signals == "one" else 1000.0)
    made = launcher(tmp_path, stubborn=True)

    def reachable() -> bool:
        there = (tmp_path / "connection.json").exists()
        return there and (signals == "many" or made._stop_s is None)

    signalled(made, signal.SIGINT, reachable, monkeypatch)
    status, told = finish(made, tmp_path)
    assert status == (137 if signals == "one" else 130)
    killed = "the master did not end within 0.2 s and was killed"
    assert (killed in told) == (signals == "one")


@pytest.mark.cluster
def test_a_signal_that_comes_again_at_once_cuts_nobody_short(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(launch_module, "LEAVE_S", LIMIT_S)
    leaving = """
import signal, sys, time
from tangram_core.run.process import watch_parent
watch_parent()
def leave(*_):
    time.sleep(0.3)
    print("left in order", flush=True)
    sys.exit(0)
signal.signal(signal.SIGTERM, leave)
print("plays", flush=True)
while True:
    signal.sigtimedwait([], 1.0)
"""
    made = launcher(tmp_path, players=[leaving])
    (player,) = made._players
    player.start(made._events.put)
    until_s = time.monotonic() + LIMIT_S
    while player.tail() != "plays":
        assert time.monotonic() < until_s
        time.sleep(0.02)
    made._events.put(signal.SIGTERM)
    made.end_all()
    assert player.tail() == "plays\nleft in order"
