"""Processes that think and move for the pages: none can stop the server, however it ends.

A task is a function of what it is given, so any process can do any task, and one that is gone is
replaced.
"""

import asyncio
import multiprocessing
import os
import threading
from collections.abc import Awaitable, Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from typing import TypeVar

from tangram_sim.errors import TangramError

Given = TypeVar("Given")
Waits = Callable[[int], Awaitable[None]]  # told how many tasks come first
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
        self._waiting, self.started = 0, 0
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
        try:
            pool = self._pool
            return await asyncio.wait_for(
                asyncio.wrap_future(pool.submit(task, *given)), timeout=LIMIT_S
            )
        except BrokenProcessPool:
            self._renew(pool)
            raise TangramError("the process that worked on it ended: try it again") from None
        except TimeoutError:
            self._renew(pool)
            raise TangramError(f"it took more than {LIMIT_S:g} s: make it simpler") from None
        finally:
            self._turns.release()

    async def _turn(self, waits: Waits | None) -> None:
        """Wait for a process that is free."""
        turn = asyncio.ensure_future(self._turns.acquire())
        self._waiting += 1
        try:
            done, _ = await asyncio.wait((turn,), timeout=PATIENT_S)
            if not done and waits is not None:
                await waits(self._waiting - 1)
            await turn
        except BaseException:
            if not turn.cancel():
                self._turns.release()
            raise
        finally:
            self._waiting -= 1

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


def _end(pool: ProcessPoolExecutor) -> None:
    """End a pool's processes, whatever they do."""
    for process in list((pool._processes or {}).values()):  # public from 3.14 on
        process.kill()
    pool.shutdown(wait=False, cancel_futures=True)


def _begin(warm: Callable[[], None]) -> None:
    """In a new process: end with the server, however that ends, and load what is needed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_follow, args=(parent.sentinel,), daemon=True).start()
    warm()


def _follow(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
