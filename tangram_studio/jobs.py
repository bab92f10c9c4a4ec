"""A pool of processes that work for the pages: no task can block or crash the server.

A task depends on its arguments alone. So any process can do any task, and a process that ended is
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
Waits = Callable[[int], Awaitable[None]]  # called with the number of tasks ahead, if it changes
LIMIT_S = 30.0  # of a task
PATIENT_S = 0.3  # a shorter wait is not reported


class Jobs:
    """A pool of processes, with a queue that reports how many tasks are ahead.

    Attributes:
        started: number of pools started so far.
    """

    def __init__(self, processes: int, warm: Callable[[], None]) -> None:
        """Start the processes.

        Args:
            processes: number of processes.
            warm: function that each process calls at its start, to load what tasks need.
        """
        self._processes, self._warm = processes, warm
        self._turns = asyncio.Semaphore(processes)
        self._queue: list[object] = []  # waiting tasks, the next one first
        self.started = 0
        self._working: set[asyncio.Task[Any]] = set()
        self._pool = self._start()

    async def ready(self) -> None:
        """Wait until the processes have started."""
        await asyncio.gather(*(self.do(os.getpid) for _ in range(self._processes)))

    async def do(
        self, task: Callable[..., Given], *given: object, waits: Waits | None = None
    ) -> Given:
        """Do a task in a process, and return its result.

        Args:
            task: a function of a module.
            given: its arguments.
            waits: called with the number of tasks ahead, while the task waits.

        Raises:
            TangramError: the process ended, or took too long; other errors are those of the task.
        """
        await self._turn(waits)
        # Shielded: if the caller is cancelled, the process is busy until its task is done.
        work = asyncio.create_task(self._work(task, given))
        self._working.add(work)
        work.add_done_callback(self._ended)
        return await asyncio.shield(work)

    async def _work(self, task: Callable[..., Given], given: tuple[object, ...]) -> Given:
        """Do a task in a process, once more if the process ends; then free the turn."""
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
                        f"no answer within {LIMIT_S:g} s: try a simpler figure"
                    ) from None
                except asyncio.CancelledError:
                    # Another task's timeout ended the pool; this task was not cancelled itself.
                    if future is None or not future.cancelled() or _is_cancelled():
                        raise
            raise TangramError("the process that worked on it ended: try a simpler figure")
        finally:
            self._turns.release()

    def _ended(self, work: "asyncio.Task[Any]") -> None:
        self._working.discard(work)
        if not work.cancelled():
            work.exception()  # counts as retrieved, also if nobody waits for it any more

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
    """Kill a pool's processes, whatever they do."""
    for process in list((pool._processes or {}).values()):  # public from 3.14 on
        process.kill()
    pool.shutdown(wait=False, cancel_futures=True)


def _begin(warm: Callable[[], None]) -> None:
    """Set up a new process: it ends whenever the server ends, and loads what tasks need."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the server handles Ctrl-C, and ends this one
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_follow, args=(parent.sentinel,), daemon=True).start()
    warm()


def _follow(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
