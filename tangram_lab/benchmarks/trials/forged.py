"""Mutated messages, as a hostile worker may send them."""

import random
from collections.abc import Sequence

import numpy as np

from tangram_core.setup import Setup
from tangram_core.wire.messages import (
    PICTURE_WIDTH,
    AskStatus,
    Bye,
    EpisodeBatch,
    Heartbeat,
    Hello,
    Scores,
    WantWeights,
)
from tangram_core.wire.schema import CHECKSUM, checksum


def valid_messages(setup: Setup) -> list[list[bytes]]:
    """The frames of one message of each kind that a worker sends."""
    spec = setup.spec
    picture = np.zeros((4, PICTURE_WIDTH, 3), np.uint8)
    return [
        Hello("player", 7, 0, "fuzz", 1, setup.fingerprints(), "").encode(),
        EpisodeBatch(1, 0, spec.empty(4)).encode(spec),
        Scores(3, {"mean_reward": 0.5}, picture).encode(spec),
        WantWeights("epoch", 3).encode(),
        Heartbeat({"episodes": 5.0}).encode(),
        AskStatus().encode(),
        Bye("done").encode(),
    ]


def mutated(frames: Sequence[bytes], dice: random.Random) -> list[bytes]:
    """A message with one to three random changes, inside a frame or to the list of frames."""
    changed = list(frames)
    for _ in range(dice.randrange(1, 4)):
        place = dice.randrange(len(changed)) if changed else 0
        frame = bytearray(changed[place]) if changed else bytearray()
        match dice.randrange(8):
            case 0 if frame:
                frame[dice.randrange(len(frame))] ^= 1 << dice.randrange(8)
            case 1 if frame:
                frame[dice.randrange(len(frame))] = dice.randrange(256)
            case 2:
                del frame[dice.randrange(len(frame) + 1) :]
            case 3:
                frame += dice.randbytes(dice.randrange(64))
            case 4 if frame:
                start = dice.randrange(len(frame))
                frame[start : start + dice.randrange(8)] = dice.randbytes(dice.randrange(8))
            case 5:
                changed.insert(place, dice.randbytes(dice.randrange(32)))
                continue
            case 6 if changed:
                del changed[place]
                continue
            case _:
                dice.shuffle(changed)
                continue
        if changed:
            changed[place] = bytes(frame)
    return changed


def resealed(frames: Sequence[bytes]) -> list[bytes]:
    """A message with a correct checksum, as a hostile sender would make it."""
    if not frames:
        return []
    body = frames[0][:-CHECKSUM]
    return [body + checksum(body, frames[1:]).to_bytes(CHECKSUM, "big"), *frames[1:]]


def fuzzed(valid: Sequence[Sequence[bytes]], dice: random.Random) -> list[bytes]:
    """A mutated message; half of these messages get a correct checksum, to pass this check."""
    frames = mutated(dice.choice(valid), dice)
    return resealed(frames) if dice.random() < 0.5 else frames
