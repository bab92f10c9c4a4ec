"""tangram-train: a master, its workers and an evaluator on this machine, and no orphan of them."""

import signal
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from queue import Empty, SimpleQueue
from typing import Any

from rich.console import Console

from master.checkpoint import check_resumable
from master.children import MAX_RESTARTS, Child, describe, module, override
from master.config import LaunchConfig
from master.console import sturdy_console
from master.rundir import RunFolder
from master.signals import SAME_WISH_S, heeded, show_cursor
from tangram_agent import lifeline

# While the master starts, its connection file is looked for this often.
LOOK_S = 0.1
# The master writes its checkpoint and its result meanwhile.
STOP_S = 120.0
LEAVE_S = 8.0
PLAYER_NICE = 5
EVALUATOR_NICE = 10
FAILED_STATUS = 1


def run_training(config: LaunchConfig, resolved: Mapping[str, Any]) -> int:
    """Train until the master is done, and leave no process behind.

    Args:
        config: the settings of launcher and master.
        resolved: the whole config as plain values, for config.yaml, which the children read.

    Returns:
        The master's exit status; 1 when no worker can be kept alive.

    Raises:
        TangramError: the run folder cannot be used.
    """
    folder = RunFolder(config.master.run_dir)
    folder.prepare(config.master.resume)
    with folder.lock():
        check_resumable(folder.checkpoints, resolved)
        folder.logs.mkdir(exist_ok=True)
        folder.write_config(resolved)
        # Left by a master that was killed; workers must wait for the new one.
        folder.connection.unlink(missing_ok=True)
    launcher = Launcher(config, folder, sturdy_console(sys.stderr))
    with launcher.signals():
        lifeline.watch(grace_s=STOP_S + 2.0 * LEAVE_S)  # of an experiment that started it
        try:
            return launcher.run()
        finally:
            launcher.end_all()


class Launcher:
    """Starts the children, restarts those that fail, and ends them in order."""

    def __init__(self, config: LaunchConfig, folder: RunFolder, console: Console) -> None:
        self._folder, self._console = folder, console
        self._events: SimpleQueue[Child | signal.Signals] = SimpleQueue()
        self._master = Child("master", master_arguments(config, folder))
        self._players = [_worker(folder, "player", i) for i in range(config.workers)]
        self._evaluator = _worker(folder, "evaluator", -1)
        self._stop_s: float | None = None
        self._signalled_s: float | None = None
        self._failed, self._sent_home = False, False

    @contextmanager
    def signals(self) -> Iterator[None]:
        """Turn signals into events."""
        handler = self._events.put
        before = {
            number: signal.signal(number, lambda n, _frame: handler(signal.Signals(n)))
            for number in heeded()
        }
        try:
            yield
        finally:
            for number, old in before.items():
                signal.signal(number, old)

    def run(self) -> int:
        """Until the master has ended; returns the exit status for the user."""
        self._master.start(self._events.put)
        while True:
            self._start_due()
            event = self._next_event()
            if isinstance(event, signal.Signals):
                self._signalled(event)
            elif event is self._master:
                return self._master_ended()
            elif event is not None:
                self._worker_ended(event)
            elif self._stop_s is not None and time.monotonic() >= self._stop_s:
                self._kill_all()
                self._print(f"the master does not end within {STOP_S:g} s: it is killed")

    def end_all(self) -> None:
        """Wait for the children to leave, then ask them to, then make them; a signal hurries it."""
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

    def _start_due(self) -> None:
        """Start the workers once the master can be reached, and again those whose delay is over."""
        if self._stop_s is not None or not self._folder.connection.exists():
            return
        for child in self._workers:
            if child.next_start_s is not None and time.monotonic() >= child.next_start_s:
                child.start(self._events.put)

    def _next_event(self) -> Child | signal.Signals | None:
        planned = [c.next_start_s for c in self._workers if c.next_start_s is not None]
        limits = [self._stop_s] if self._stop_s is not None else planned
        timeout = max(min(limits) - time.monotonic(), LOOK_S) if limits else None
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
            self._stop(f"{number.name}: the run ends with a checkpoint, again to end at once")
        elif now_s - self._signalled_s >= SAME_WISH_S:
            self._kill_all()

    def _kill_all(self) -> None:
        for child in [self._master, *self._workers]:
            child.signal(signal.SIGKILL)
        show_cursor()

    def _stop(self, why: str) -> None:
        self._say(why)
        self._stop_s = time.monotonic() + STOP_S
        self._master.signal(signal.SIGTERM)

    def _master_ended(self) -> int:
        status = self._master.clear()
        # A master that ends in order has told its workers.
        self._sent_home = status == 0
        if status not in (0, 2):  # 2: it has told what is wrong
            self._say(
                f"the master ended with {describe(status)}; resume=auto goes on from its "
                "last checkpoint"
            )
        if self._failed:
            return FAILED_STATUS
        return 128 - status if status < 0 else status

    def _worker_ended(self, child: Child) -> None:
        status = child.clear()
        if self._stop_s is not None or not self._folder.connection.exists():
            return  # the run ends, and so do its workers
        if child.plan_restart(status):
            self._say(
                f"{child.name} ended with {describe(status)}: it is started again "
                f"({child.restarts} of {MAX_RESTARTS}); see {child.log}"
            )
            return
        self._say(f"{child.name} ended with {describe(status)}: given up\n{child.tail()}")
        if not any(c.alive or c.next_start_s is not None for c in self._players):
            self._failed = True
            self._stop("no worker is left: the run ends")

    def _say(self, text: str) -> None:
        """Through the master, which owns the terminal while it runs."""
        for line in text.splitlines():
            if not (self._master.alive and self._master.tell(line)):
                self._print(line)

    def _print(self, line: str) -> None:
        self._console.print(line, soft_wrap=True, markup=False, highlight=False)

    def _wait_for(self, children: list[Child]) -> None:
        until_s = time.monotonic() + LEAVE_S
        while any(child.alive for child in children):
            try:
                event = self._events.get(timeout=max(until_s - time.monotonic(), 0.0))
            except Empty:
                return
            if isinstance(event, signal.Signals):
                return


def _worker(folder: RunFolder, role: str, index: int) -> Child:
    name = role if role == "evaluator" else f"worker {index}"
    arguments = [
        *module("worker"),
        override("connect", str(folder.connection)),
        f"index={index}",
        f"role={role}",
        override("from_config", str(folder.config)),
    ]
    nice = EVALUATOR_NICE if role == "evaluator" else PLAYER_NICE
    return Child(name, arguments, folder.logs / f"{name.replace(' ', '-')}.log", nice)


def master_arguments(config: LaunchConfig, folder: RunFolder) -> list[str]:
    """How the master is started, as arguments of this Python."""
    master = config.master
    return [
        *module("master"),
        override("from_config", str(folder.config)),
        override("run_dir", str(folder.path)),
        *(
            f"{name}={getattr(master, name)}"
            for name in ("seed", "max_hours", "max_episodes", "max_updates", "resume")
        ),
        *([override("warm_start", master.warm_start)] if master.warm_start else []),
    ]
