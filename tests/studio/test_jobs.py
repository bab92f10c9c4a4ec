"""Processes that do the work of the pages: turns, waits, and what ends them."""

import asyncio
import os
import subprocess
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from tangram_core.errors import TangramError
from tangram_studio.jobs import Jobs

pytestmark = pytest.mark.cluster


def with_one(work: Callable[[Jobs], Awaitable[None]]) -> None:
    """Do something with one process, which loads nothing first."""

    async def run() -> None:
        jobs = Jobs(1, int)  # type: ignore[arg-type]
        try:
            await jobs.ready()
            await work(jobs)
        finally:
            jobs.close()

    asyncio.run(run())


def test_a_task_that_takes_too_long_is_ended_and_the_next_is_done(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def work(jobs: Jobs) -> None:
        with monkeypatch.context() as hasty:
            hasty.setattr("tangram_studio.jobs.LIMIT_S", 0.5)
            with pytest.raises(TangramError, match="no answer within 0.5 s: try a simpler figure"):
                await jobs.do(time.sleep, 60)
        assert await jobs.do(os.getpid) != os.getpid()
        with pytest.raises(TangramError, match="the process that worked on it ended: try"):
            await jobs.do(os._exit, 3)
        assert await jobs.do(abs, -2) == 2
        assert jobs.started == 4  # the second time, too

    with_one(work)


def test_who_waits_is_told_and_who_leaves_takes_no_turn_along_and_leaves_none_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tangram_studio.jobs.PATIENT_S", 0.1)
    heard = dict[int, list[int]]()

    def waits(number: int) -> Any:
        async def wait(ahead: int) -> None:
            heard.setdefault(number, []).append(ahead)

        return wait

    async def work(jobs: Jobs) -> None:
        ends = [tmp_path / str(number) for number in range(4)]
        asked = list[asyncio.Task[Any]]()
        for number, end in enumerate(ends):
            task = subprocess.call, ("sh", "-c", f"until [ -e {end} ]; do sleep 0.02; done")
            asked.append(asyncio.create_task(jobs.do(*task, waits=waits(number))))
            await asyncio.sleep(0.01)
        # Those who come earlier and what is being done, and again when it is less.
        whole = {1: [1], 2: [2, 1], 3: [3, 2, 1]}
        for done, end in enumerate(ends):
            while heard != {number: told[: done + 1] for number, told in whole.items()}:
                await asyncio.sleep(0.01)
            end.touch()
        await asyncio.gather(*asked)
        assert heard == whole
        begun, go = tmp_path / "begun", tmp_path / "go"
        ends = [tmp_path / f"end {number}" for number in range(4)]
        first = f"touch {begun}; until [ -e {go} ]; do sleep 0.02; done; touch '{ends[0]}'"
        lines = [first, *(f"touch '{end}'" for end in ends[1:])]
        asked = [asyncio.create_task(jobs.do(subprocess.call, ("sh", "-c", one))) for one in lines]
        while not begun.exists():
            await asyncio.sleep(0.01)
        for one in asked:  # what has begun goes on, the rest never begins
            one.cancel()
        await asyncio.gather(*asked, return_exceptions=True)
        go.touch()
        pids = await asyncio.gather(*(jobs.do(os.getpid) for _ in range(3)))
        assert len(set(pids)) == 1
        assert [end.exists() for end in ends] == [True, False, False, False]
        assert jobs._turns._value == 1

    with_one(work)
