"""The replay buffer against numpy alone, and its size."""

import numpy as np

from tangram_agent.replay import ReplayBuffer
from tangram_agent.setup import Setup
from tangram_agent.types import Transitions
from tangram_lab.benchmarks.measure import Bound, Row, Work, compare, single
from tangram_lab.benchmarks.setups import preset, several

CAPACITY = 1_000_000
BATCHES = (64, 256, 2048)
CHUNK = 256
MEGABYTE = 1e6


def measure_replay(runs: int) -> list[Row]:
    """Transitions sampled and added per second, and the memory of a million of them."""
    rows = []
    for case, setup, most in (("1 token", preset(), 160.0), ("7 tokens", several(7), 800.0)):
        replay = filled(setup, CAPACITY)
        labels = ("replay", f"{case}, a million transitions", "MB")
        rows.append(single(labels, [_bytes(replay) / MEGABYTE], Bound(most=most)))
        for size in BATCHES:
            labels = ("replay", f"{case}, samples of {size}", "transitions/s")
            indexing = ("numpy fancy indexing", _indexing(replay, size))
            ours = _sampling(replay, size)
            rows.append(compare(labels, ours, indexing, runs, Bound(least=0.8)))
        labels = ("replay", f"{case}, adding {CHUNK}", "transitions/s")
        copying = ("numpy slices", _copying(replay))
        rows.append(compare(labels, _adding(replay), copying, runs))
    return rows


def filled(setup: Setup, capacity: int) -> ReplayBuffer:
    """A full buffer of random numbers."""
    layout = setup.layout
    replay = ReplayBuffer(capacity, layout.corner_count, layout.tokens, setup.action_size)
    chunk = random_transitions(setup, CHUNK).arrays
    replay.added = capacity
    for name, column in columns(replay).items():
        column[:] = np.resize(chunk[name], column.shape)
    return replay


def random_transitions(setup: Setup, count: int) -> Transitions:
    """Transitions of the right shapes; nothing moves as it would."""
    rng, layout = np.random.default_rng(0), setup.layout
    corners, tokens = layout.corner_count, layout.tokens
    state, after, goal = rng.uniform(-1, 1, (3, count, corners, 2)).astype(np.float32)
    return Transitions(
        state=state,
        placed=np.zeros((count, tokens), np.uint8),
        action=rng.uniform(-1, 1, (count, setup.action_size)).astype(np.float32),
        reward=rng.uniform(-1, 1, count).astype(np.float32),
        next_state=after,
        next_placed=np.ones((count, tokens), np.uint8),
        done=np.ones(count, np.uint8),
        goal=goal,
    )


def columns(replay: ReplayBuffer) -> dict[str, np.ndarray]:
    """The arrays of a full buffer, as they lie in memory."""
    return {name: column for name, column in replay.state().items() if name != "counters"}


def _bytes(replay: ReplayBuffer) -> int:
    return sum(column.nbytes for column in columns(replay).values())


def _sampling(replay: ReplayBuffer, size: int) -> Work:
    rng = np.random.default_rng(0)
    return lambda: replay.sample(size, rng).count


def _indexing(replay: ReplayBuffer, size: int) -> Work:
    rng, arrays = np.random.default_rng(0), list(columns(replay).values())

    def work() -> int:
        rows = rng.integers(CAPACITY, size=size)
        return len([array[rows] for array in arrays]) and size

    return work


def _adding(replay: ReplayBuffer) -> Work:
    batch = _head(replay)

    def work() -> int:
        replay.add(batch)
        return CHUNK

    return work


def _head(replay: ReplayBuffer) -> Transitions:
    return Transitions(**{name: column[:CHUNK].copy() for name, column in columns(replay).items()})


def _copying(replay: ReplayBuffer) -> Work:
    pairs = [(column, column[:CHUNK].copy()) for column in columns(replay).values()]
    place = 0

    def work() -> int:
        nonlocal place
        place = (place + CHUNK) % (CAPACITY - CHUNK)
        for column, part in pairs:
            column[place : place + CHUNK] = part
        return CHUNK

    return work
