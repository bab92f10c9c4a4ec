"""A task, messages of it, and the ways to break them."""

import zlib
from collections.abc import Mapping
from typing import Any

import msgpack
import numpy as np

from tangram_core.agent import Weights
from tangram_core.spec import Episodes
from tangram_core.wire.arrays import join_frames
from tangram_core.wire.messages import PICTURE_WIDTH, EpisodeBatch, Hello, Scores, WeightsMessage
from tests.agent.builders import PAIR, random_episodes, setup, with_bound

BOUND = 4.0
TASK = setup(PAIR, actions_per_token=2)  # K 2, V 7, T 4, A 4
SPEC = with_bound(TASK.spec, BOUND)
SHAPES = {"actor.weight": (3, 2), "actor.bias": (3,), "scale": ()}
FINGERPRINTS = {"tokens": "aaaa", "sim": "bbbb"}


def episodes(count: int = 3, seed: int = 0) -> Episodes:
    return random_episodes(TASK, count, seed)


def batch(sequence: int = 1, count: int = 3) -> EpisodeBatch:
    return EpisodeBatch(sequence, weights_version=7, episodes=episodes(count, sequence))


def weights(version: int = 5, value: float = 0.5) -> Weights:
    return Weights(version, {n: np.full(s, value, np.float32) for n, s in SHAPES.items()})


def broadcast(sent: Weights, epoch: str = "e") -> bytes:
    """Weights as one frame, because a CONFLATE socket keeps only the last frame of a message."""
    return join_frames(WeightsMessage(epoch, sent).encode())


def scores(count: int = 2) -> Scores:
    picture = np.arange(count * PICTURE_WIDTH * 3).astype(np.uint8).reshape(count, -1, 3)
    return Scores(7, {"mean_reward": 0.25, "coverage": 0.5}, picture)


def hello(
    index: int = -1,
    incarnation: int = 0,
    process: str = "p1",
    first: int = 1,
    role: str = "player",
    fingerprints: Mapping[str, str] = FINGERPRINTS,
    run_id: str = "",
) -> Hello:
    return Hello(role, index, incarnation, process, first, fingerprints, run_id)


def with_header(frames: list[bytes], **changes: Any) -> list[bytes]:
    """The same message with other header fields, and the checksum of all; None takes one away."""
    values = msgpack.unpackb(frames[0]) | changes
    kept = {n: value for n, value in values.items() if value is not None and n != "crc"}
    return with_checksum([msgpack.packb(kept | {"crc": 2**32 - 1}), *frames[1:]])


def with_checksum(frames: list[bytes]) -> list[bytes]:
    """The same message, intact as far as its checksum tells: as a broken sender would seal it."""
    body, checksum = frames[0][:-4], 0
    for part in (body, *frames[1:]):
        checksum = zlib.crc32(part, checksum)
    return [body + checksum.to_bytes(4, "big"), *frames[1:]]
