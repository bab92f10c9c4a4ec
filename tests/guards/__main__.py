"""Remove guards one by one and see that a test turns red: python -m tests.guards.

Works in copies of the tree that are thrown away. First all the tests run as they are. A guard that
no test misses stays green; one whose text is no longer in the source is named before anything
runs. Each of these ends with status 1.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from queue import SimpleQueue
from tempfile import TemporaryDirectory

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from tests.guards.bench import LIMIT_S, NOT_ENDED, Bench
from tests.guards.guard import ROOT, Guard, declared, faults

PASSED, FAILED = 0, 1  # exit status of pytest; 2 and above: it could not run the tests
console = Console(highlight=False, soft_wrap=True)


def outcome(bench: Bench, guard: Guard) -> str:
    """``red``, ``green``, or why neither could be found out. The tree is as before afterwards."""
    path, rest = guard.removed_from(bench.tree)
    whole = path.read_text()
    path.write_text(rest)
    try:
        status, output = bench.run(guard.tests)
    finally:
        path.write_text(whole)
    if status == NOT_ENDED:
        return f"not ended after {LIMIT_S * len(guard.tests):.0f} s"
    told = "; ".join(output.strip().splitlines()[-3:])
    return {PASSED: "green", FAILED: "red"}.get(status, f"tests did not run: {told}")


@contextmanager
def benches(count: int) -> Iterator[SimpleQueue[Bench]]:
    """So many copies of the tree, each to be taken by one thread at a time."""
    free: SimpleQueue[Bench] = SimpleQueue()
    with TemporaryDirectory(prefix="guards-") as folder:
        made = [Bench(ROOT, Path(folder) / str(i)) for i in range(count)]
        for bench in made:
            free.put(bench)
        yield free
        for bench in made:
            bench.close()


def removed(guards: list[Guard], free: SimpleQueue[Bench], jobs: int) -> list[str]:
    """The outcome for each guard; they are told as they come."""
    columns = (
        TextColumn("guards removed"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console) as progress, ThreadPoolExecutor(jobs) as pool:
        task = progress.add_task("", total=len(guards))

        def one(guard: Guard) -> str:
            bench = free.get()
            try:
                found = outcome(bench, guard)
            finally:
                free.put(bench)
            progress.print(f"{found}  {guard.room}: {guard.name}", markup=False)
            progress.advance(task)
            return found

        return list(pool.map(one, guards))


def summary(guards: list[Guard], found: list[str]) -> int:
    """Print what came out; the exit status."""
    rooms = Counter(guard.room for guard in guards)
    console.print(", ".join(f"{room} {count}" for room, count in rooms.items()))
    held = found.count("red")
    console.print(f"{held} of {len(guards)} guards are held by a test")
    for guard, result in zip(guards, found, strict=True):
        if result != "red":
            console.print(f"not held: {guard.name} ({guard.file}): {result}", markup=False)
    return int(held < len(guards))


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.guards", description=__doc__)
    parser.add_argument("only", nargs="*", help="words that a guard's room, file or name holds")
    parser.add_argument("--jobs", type=int, default=1, help="guards removed at once, each its copy")
    parser.add_argument("--list", action="store_true", help="name the guards and remove none")
    return parser.parse_args()


def main() -> int:
    """All guards, or those that the words choose."""
    chosen = arguments()
    guards = [
        guard
        for guard in declared()
        if not chosen.only
        or any(word in f"{guard.room} {guard.file} {guard.name}" for word in chosen.only)
    ]
    for line in (wrong := faults(guards)):
        console.print(line, markup=False)
    if chosen.list:
        for guard in guards:
            console.print(f"{guard.room}: {guard.name} ({guard.file})", markup=False)
    if wrong or chosen.list or not guards:
        return int(bool(wrong) or not guards)
    with benches(max(1, chosen.jobs)) as free:
        bench = free.get()
        # In order: pytest forgets the fixtures of a folder that it comes back to.
        tests = tuple(sorted({test for guard in guards for test in guard.tests}))
        with console.status(f"{len(tests)} test files as they are, which must be green"):
            status, output = bench.run(tests)
        free.put(bench)
        if status != PASSED:
            console.print(f"{output}\nall must be green before a guard is removed", markup=False)
            return 1
        return summary(guards, removed(guards, free, max(1, chosen.jobs)))


if __name__ == "__main__":
    sys.exit(main())
