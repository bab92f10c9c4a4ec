"""tangram-train: starts a master, its workers and an evaluator here; leaves no orphan process."""

import logging
import os
import signal
import sys
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager, suppress
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Any

from master.children import Child, describe
from master.config import MasterConfig
from master.forking import warm_up
from master.hub.gate import Room
from master.hub.security import listening_place
from master.record.resumable import check_resumable
from master.record.rundir import LAUNCHER, RunFolder
from master.signals import SAME_WISH_S, SIGNALS, show_cursor, stop_notice
from master.watch.console import logging_to, sturdy_console
from master.watch.result import show_finished
from tangram_core.errors import (
    FAILED_STATUS,
    UNAVAILABLE_STATUS,
    USAGE_STATUS,
    RunError,
    UnavailableError,
)
from tangram_core.run.code import code_of, override
from tangram_core.run.outcome import CTRL_C
from tangram_core.run.process import WATCHDOG_S, Every, handling, watch_parent
from tangram_core.wire.messages import TAKEN_OVER

# Seconds between two looks for the connection file while the master starts.
LOOK_S = 0.1
IDLE_S = 1.0
# After a signal the master has this time to write its checkpoint and its result.
STOP_S = 120.0
LEAVE_S = 8.0
TAKE_BACK_S = 30.0
PLAYER_NICE = 5
EVALUATOR_NICE = 10
GO_ON = "the same command with resume=auto goes on from what was saved"

log = logging.getLogger(__name__)


def run_training(config: MasterConfig, resolved: Mapping[str, Any]) -> int:
    """Train until the master ends, and end all child processes.

    Args:
        config: the settings of the run.
        resolved: the whole config as plain values, for config.yaml, which the children read.

    Returns:
        The master's exit status; 1 if all workers failed for good.

    Raises:
        TangramError: the run folder cannot be used.
    """
    Room.here()  # each child needs some open files here
    folder = RunFolder(config.run_dir)
    folder.prepare(config.resume)
    # Held to the end: another training must not write its settings before the master has its lock.
    with folder.lock(LAUNCHER):
        with folder.lock():
            check_resumable(folder, resolved)
            listening_place(config.service.bind, folder.path)
            finished = folder.has_finished(config)
            if not finished:
                folder.logs.mkdir(exist_ok=True)
                folder.write_config(resolved)
                # A killed master leaves its file; workers must wait for the file of the new master.
                folder.connection.unlink(missing_ok=True)
        return _launched(config, resolved, folder, finished)


def _launched(
    config: MasterConfig, resolved: Mapping[str, Any], folder: RunFolder, finished: bool
) -> int:
    console, form = sturdy_console(sys.stderr), config.service.log_format
    code = code_of(resolved)
    launcher = Launcher(config, folder, code)
    with logging_to(console, form, "launcher"), launcher.signals():
        if finished:
            show_finished(folder, form, code)
            return 0
        watch_parent(grace_s=STOP_S + 2.0 * LEAVE_S)  # if an experiment started this process
        try:
            return launcher.run()
        finally:
            launcher.end_all()


class Launcher:
    """Starts the children, restarts those that fail, and ends them in order."""

    def __init__(self, config: MasterConfig, folder: RunFolder, code: Mapping[str, str]) -> None:
        self._folder, self._in_step = folder, config.service.mode == "lockstep"
        self._events: SimpleQueue[Child | signal.Signals] = SimpleQueue()
        self._master = Child("master", master_arguments(config, folder))
        self._players = [worker_child(folder, "player", i) for i in range(config.workers)]
        self._evaluator = worker_child(folder, "evaluator", -1)
        for child in (self._master, *self._workers):
            child.arguments = [*child.arguments, *(override(*own) for own in code.items())]
            child.patience_s = WATCHDOG_S
        self._look = Every(IDLE_S)
        self._stop_s: float | None = None
        self._signalled_s: float | None = None
        self._killed_by = 0  # the signal that ended everything at once
        self._failed, self._sent_home = False, False
        self._reached = False  # since its last start, the master has been reachable at some time

    def signals(self) -> AbstractContextManager[None]:
        """A context in which signals become events of `run`."""
        return handling(self._events.put, SIGNALS)

    def run(self) -> int:
        """Run until the master has ended; returns the exit status of tangram-train."""
        number = self._warm_up()
        if number is not None:
            return 128 + number
        while True:
            self._start_due()
            self._kill_frozen()
            event = self._next_event()
            if isinstance(event, signal.Signals):
                if self._master.next_start_s is not None:  # no master is running: nothing to save
                    self._say(f"{CTRL_C.get(event.name, event.name)}: the run ends; {GO_ON}")
                    return 128 + event
                self._signalled(event)
            elif event is self._master:
                status = self._master.clear()
                if not self._master_comes_back(status):
                    return self._master_ended(status)
            elif event is not None:
                self._worker_ended(event)
                if self._failed and self._master.next_start_s is not None:
                    return FAILED_STATUS
            elif self._stop_s is not None and time.monotonic() >= self._stop_s:
                self._kill_all()
                log.info("the master did not end within %g s and was killed", STOP_S)

    def end_all(self) -> None:
        """Wait for the children to end, then send SIGTERM, then SIGKILL; a signal ends a wait."""
        steps = [signal.SIGTERM, signal.SIGKILL]
        children = [*self._workers, self._master]
        if self._sent_home:
            self._wait_for(children)
        for number in steps:
            for child in children:
                child.signal(number)
            self._wait_for(children)
        for child in children:
            child.clear()

    @property
    def _workers(self) -> list[Child]:
        return [*self._players, self._evaluator]

    def _warm_up(self) -> signal.Signals | None:
        """Wait until processes can be started; returns a signal that came during the wait."""
        starting = Thread(target=warm_up, daemon=True)
        starting.start()
        while starting.is_alive():  # this takes seconds, from a slow disk minutes
            event = self._next_event()
            if isinstance(event, signal.Signals):
                return event
        return None

    def _start_due(self) -> None:
        """Start each child whose time has come; workers only while the master is reachable."""
        if self._stop_s is not None:
            return
        reachable = os.path.exists(self._folder.connection)  # noqa: PTH110 - False if the disk fails
        self._reached = self._reached or reachable
        for child in [self._master, *(self._workers if reachable else ())]:
            if child.next_start_s is not None and time.monotonic() >= child.next_start_s:
                try:
                    child.start(self._events.put)
                except (UnavailableError, OSError) as error:
                    child.clear()
                    child.plan_restart(UNAVAILABLE_STATUS)
                    self._say(f"{child.name}: {error} (tried again {child.plan})")

    def _kill_frozen(self) -> None:
        if not self._look.due():
            return
        for child in (self._master, *self._workers):
            if child.kill_frozen(IDLE_S):
                tell = log.info if child is self._master else self._say
                tell(f"{child.name} was stopped for {child.patience_s:g} s and was killed")

    def _next_event(self) -> Child | signal.Signals | None:
        children = [self._master, *self._workers]
        planned = [c.next_start_s for c in children if c.next_start_s is not None]
        limits = [self._stop_s] if self._stop_s is not None else planned
        timeout = max(min(limits) - time.monotonic(), LOOK_S) if limits else IDLE_S
        try:
            return self._events.get(timeout=timeout)
        except Empty:
            return None

    def _signalled(self, number: signal.Signals) -> None:
        """The first signal ends the run in order; a later one kills everything."""
        now_s = time.monotonic()
        if self._signalled_s is None:
            self._signalled_s = now_s
        if self._stop_s is None:
            self._stop(stop_notice(number.name), number)
        elif now_s - self._signalled_s >= SAME_WISH_S:
            self._killed_by = number.value
            self._kill_all()

    def _kill_all(self) -> None:
        for child in [self._master, *self._workers]:
            child.signal(signal.SIGKILL)
        show_cursor()

    def _stop(self, why: str, number: signal.Signals = signal.SIGTERM) -> None:
        self._say(why)
        self._stop_s = time.monotonic() + STOP_S
        self._master.signal(number)  # the same signal, because the result names it

    def _master_comes_back(self, status: int) -> bool:
        """Plan a restart of a master that was killed or hung, with resume=auto; False if not."""
        if status == 0 or self._stop_s is not None or not self._master.plan_restart(status):
            return False
        # A worker that starts now must not connect to the address of the dead master.
        self._folder.remove_connection()
        with suppress(RunError):  # the disk failed
            self._folder.write_again()  # the settings, if somebody deleted them
        self._reached = False
        self._master.arguments = [
            "resume=auto" if text.startswith("resume=") else text for text in self._master.arguments
        ]
        log.info(
            "the master ended with %s: it is started again with resume=auto (%s)",
            describe(status),
            self._master.plan,
        )
        return True

    def _master_ended(self, status: int) -> int:
        # With status 0 the master has told its workers to end.
        self._sent_home = status == 0
        if status not in (0, USAGE_STATUS):  # with USAGE_STATUS it has shown an error message
            self._say(f"the master ended with {describe(status)}; {GO_ON}")
        if self._failed:
            return FAILED_STATUS
        if self._killed_by:
            return 128 + self._killed_by
        return 128 - status if status < 0 else status

    def _worker_ended(self, child: Child) -> None:
        status = child.clear()
        if self._reached and not os.path.exists(self._folder.connection):  # noqa: PTH110
            child.next_start_s = 0.0  # the master dismissed it: start again if the master returns
            return
        if self._stop_s is not None:
            return
        if status == 0 and TAKEN_OVER in child.tail(1):
            self._make_way(child)
        elif child.plan_restart(status):
            lacks = f"\n{child.tail(1)}" if child.wait_s else ""
            self._say(
                f"{child.name} ended with {describe(status)}: it is started again ({child.plan}); "
                f"see {child.log}{lacks}"
            )
        else:
            self._say(
                f"{child.name} ended with {describe(status)}: it is not started again\n"
                f"{child.tail()}"
            )
            if not (all if self._in_step else any)(player.kept for player in self._players):
                self._failed = True
                self._stop("too few workers are left: the run ends")

    def _make_way(self, child: Child) -> None:
        """Start a child again that lost its index to a worker which a user started by hand."""
        lost = f"{child.name} lost its index to another worker that was started with this index"
        if self._in_step:  # a round needs all of these indices
            child.next_start_s = time.monotonic() + TAKE_BACK_S
            self._say(
                f"{lost}: it takes the index back in {TAKE_BACK_S:g} s; start other workers "
                "without index="
            )
            return
        child.next_start_s = time.monotonic()
        child.arguments = [
            "index=-1" if text.startswith("index=") else text for text in child.arguments
        ]
        self._say(f"{lost}: it continues with a free index")

    def _say(self, text: str) -> None:
        """Show a line through the master, which owns the terminal while it runs."""
        for line in text.splitlines():
            if not (self._master.alive and self._master.tell(line)):
                log.info("%s", line)

    def _wait_for(self, children: list[Child]) -> None:
        began_s = time.monotonic()
        until_s = began_s + LEAVE_S
        while any(child.alive for child in children):
            try:
                event = self._events.get(timeout=max(until_s - time.monotonic(), 0.0))
            except Empty:
                return
            # The same signal may come twice, for example from SLURM when it requeues a job. The
            # second one must not shorten the children's time to leave.
            hurried = time.monotonic() - began_s >= SAME_WISH_S
            if isinstance(event, signal.Signals) and hurried:
                return


def worker_child(folder: RunFolder, role: str, index: int) -> Child:
    """A worker or evaluator that joins with the run's connection file and has its own log file."""
    name = role if role == "evaluator" else f"worker {index}"
    arguments = [
        "worker",
        override("connect", str(folder.connection)),
        f"index={index}",
        f"role={role}",
    ]
    nice = EVALUATOR_NICE if role == "evaluator" else PLAYER_NICE
    return Child(name, arguments, folder.logs / f"{name.replace(' ', '-')}.log", nice)


def master_arguments(config: MasterConfig, folder: RunFolder) -> list[str]:
    """Name and arguments of the command that starts the master."""
    in_step = config.service.mode == "lockstep"
    return [
        "master",
        override("from_config", str(folder.config)),
        override("run_dir", str(folder.path)),
        *(
            f"{name}={getattr(config, name)}"
            for name in ("seed", "max_hours", "max_episodes", "max_updates", "resume")
        ),
        *([f"workers={config.workers}"] if in_step else []),
        *([override("warm_start", config.warm_start)] if config.warm_start else []),
    ]
