"""Processes that think and move for the pages: none can stop the server, however it ends.

A task is a function of what it is given, so any process can do any task, and one that is gone is
replaced.
"""

import asyncio
import multiprocessing
import os
import signal
import threading
from collections.abc import Awaitable, Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from typing import Any, TypeVar

from tangram_core.errors import TangramError

Given = TypeVar("Given")
Waits = Callable[[int], Awaitable[None]]  # told how many tasks come first, when that changes
LIMIT_S = 30.0  # of a task
PATIENT_S = 0.3  # of a wait that is not worth a word


class Jobs:
    """A pool of processes, with a queue that tells who waits for how many.

    Attributes:
        started: pools that were started until now.
    """

    def __init__(self, processes: int, warm: Callable[[], None]) -> None:
        """Start the processes.

        Args:
            processes: how many.
            warm: what each does first, so that no task has to wait for it.
        """
        self._processes, self._warm = processes, warm
        self._turns = asyncio.Semaphore(processes)
        self._queue: list[object] = []  # who waits, the first in front
        self.started = 0
        self._working: set[asyncio.Task[Any]] = set()
        self._pool = self._start()

    async def ready(self) -> None:
        """Wait until the processes have begun."""
        await asyncio.gather(*(self.do(os.getpid) for _ in range(self._processes)))

    async def do(
        self, task: Callable[..., Given], *given: object, waits: Waits | None = None
    ) -> Given:
        """What a task makes of what it is given.

        Args:
            task: a function of a module.
            given: its arguments.
            waits: is called where others come first.

        Raises:
            TangramError: the process ended, or took too long; or whatever the task raises.
        """
        await self._turn(waits)
        # Whoever asked may go: what a process has begun it ends, and until then it is not free.
        work = asyncio.create_task(self._work(task, given))
        self._working.add(work)
        work.add_done_callback(self._ended)
        return await asyncio.shield(work)

    async def _work(self, task: Callable[..., Given], given: tuple[object, ...]) -> Given:
        """Do a task in a process, once more where that ends meanwhile; then the turn is over."""
        try:
            for _ in range(2):
                pool = self._pool
                future: asyncio.Future[Given] | None = None
                try:
                    future = asyncio.wrap_future(pool.submit(task, *given))
                    return await asyncio.wait_for(future, timeout=LIMIT_S)
                except BrokenProcessPool:
                    self._renew(pool)
                except TimeoutError:
                    self._renew(pool)
                    raise TangramError(
                        f"it took more than {LIMIT_S:g} s: make it simpler"
                    ) from None
                except asyncio.CancelledError:
                    # Of another task's pool, which was ended with that; not this task.
                    if future is None or not future.cancelled() or _is_cancelled():
                        raise
            raise TangramError("the process that worked on it ended: make it simpler")
        finally:
            self._turns.release()

    def _ended(self, work: "asyncio.Task[Any]") -> None:
        self._working.discard(work)
        if not work.cancelled():
            work.exception()  # heard, also where nobody waits for it any more

    async def _turn(self, waits: Waits | None) -> None:
        """Wait for a process that is free."""
        turn, place, told = asyncio.ensure_future(self._turns.acquire()), object(), -1
        self._queue.append(place)
        try:
            await asyncio.wait((turn,), timeout=PATIENT_S)
            while not turn.done():
                ahead = self._queue.index(place) + len(self._working)
                if waits is not None and ahead != told:
                    told = ahead
                    await waits(ahead)
                await asyncio.wait((turn,), timeout=PATIENT_S)
            await turn
        except BaseException:
            if turn.done() and not turn.cancelled():
                self._turns.release()
            else:
                turn.cancel()
            raise
        finally:
            self._queue.remove(place)

    def _start(self) -> ProcessPoolExecutor:
        self.started += 1
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(
            self._processes, context, initializer=_begin, initargs=(self._warm,)
        )

    def _renew(self, broken: ProcessPoolExecutor) -> None:
        if self._pool is broken:
            self._pool = self._start()
            _end(broken)

    def close(self) -> None:
        """End the processes."""
        _end(self._pool)


def _is_cancelled() -> bool:
    """Whether the running task itself was told to end."""
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0


def _end(pool: ProcessPoolExecutor) -> None:
    """End a pool's processes, whatever they do."""
    for process in list((pool._processes or {}).values()):  # public from 3.14 on
        process.kill()
    pool.shutdown(wait=False, cancel_futures=True)


def _begin(warm: Callable[[], None]) -> None:
    """In a new process: end with the server, however that ends, and load what is needed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the server's, which ends this one
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_follow, args=(parent.sentinel,), daemon=True).start()
    warm()


def _follow(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
