"""Mutated messages: against the decoder, and against a master that is training meanwhile."""

import random
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
import zmq

from tangram_core.errors import WireError
from tangram_core.setup import Setup, make_setup
from tangram_core.wire.messages import (
    PICTURE_WIDTH,
    AskStatus,
    Bye,
    EpisodeBatch,
    Heartbeat,
    Hello,
    Scores,
    WantWeights,
    decode_from_worker,
)
from tangram_core.wire.schema import CHECKSUM, DamagedError, checksum
from tangram_lab.benchmarks.measure import show, write
from tangram_lab.benchmarks.trainings import start_training, wait_for
from worker.status import ask_status

SETTINGS = ("workers=1", "sim=kinematic", "net=mlp", "service.eval_seconds=5", "max_updates=0")
KEPT = 20  # examples of what should not have happened
PAUSE_EVERY = 100
UPDATES = 100  # that the master must make before and after
LOOK_S = 0.5


def valid_messages(setup: Setup) -> list[list[bytes]]:
    """One of each kind that a worker sends, as frames."""
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
    """The message with one to three changes: in a frame, or in the row of frames."""
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
    """The message with the checksum that it should have: what a hostile sender would send."""
    if not frames:
        return []
    body = frames[0][:-CHECKSUM]
    return [body + checksum(body, frames[1:]).to_bytes(CHECKSUM, "big"), *frames[1:]]


def fuzzed(valid: Sequence[Sequence[bytes]], dice: random.Random) -> list[bytes]:
    """A mutated message; the checksum stops every second one, and the others go on behind it."""
    frames = mutated(dice.choice(valid), dice)
    return resealed(frames) if dice.random() < 0.5 else frames


def fuzz_decoder(setup: Setup, count: int, seed: int) -> tuple[Counter[str], list[str]]:
    """How many messages were taken and refused, and what the decoder should never have raised."""
    dice, spec = random.Random(seed), setup.spec
    valid, ends, wrong = valid_messages(setup), Counter[str](), list[str]()
    for _ in range(count):
        frames = fuzzed(valid, dice)
        try:
            decode_from_worker(frames, spec)
            ends["taken: still a valid message"] += 1
        except DamagedError:
            ends["refused by its checksum"] += 1
        except WireError:
            ends["refused with a reason"] += 1
        except Exception as error:  # noqa: BLE001  # this is what is looked for
            ends[f"RAISED {type(error).__name__}"] += 1
            wrong += [f"{error!r}: {[f.hex()[:200] for f in frames]}"][: KEPT - len(wrong)]
    return ends, wrong


def fuzz_master(folder: Path, count: int, seed: int) -> dict[str, Any]:
    """What a master that is training says after so many mutated messages."""
    launcher = start_training(folder, f"seed={seed}", *SETTINGS)
    wait_for(folder / "connection.json", launcher)
    setup = make_setup(yaml.safe_load((folder / "config.yaml").read_text()))
    endpoint = yaml.safe_load((folder / "connection.json").read_text())["endpoint"]
    dice, valid = random.Random(seed), valid_messages(setup)
    with zmq.Context() as context:

        def numbers() -> Mapping[str, float]:
            return ask_status(str(folder), context).numbers

        def learn_on() -> Mapping[str, float]:
            goal = numbers()["updates"] + UPDATES
            while (now := numbers())["updates"] < goal:
                time.sleep(LOOK_S)
            return now

        before, begun = learn_on(), time.monotonic()
        with context.socket(zmq.DEALER) as stranger:
            stranger.setsockopt(zmq.LINGER, 5000)
            stranger.connect(endpoint)
            for number in range(count):
                stranger.send_multipart(fuzzed(valid, dice) or [b""])
                while stranger.poll(0):
                    stranger.recv_multipart()
                if number % PAUSE_EVERY == 0:
                    numbers()  # not faster than the master hears it
        took, during = time.monotonic() - begun, numbers()
        after = learn_on()
    launcher.terminate()
    return {
        "sent": count,
        "seconds": round(took, 1),
        "updates before": before["updates"],
        "updates when all was sent": during["updates"],
        "updates after": after["updates"],
        **{n: v for n, v in after.items() if n.startswith("hub/")},
        "launcher's status": launcher.wait(120),
    }


def run_fuzz(messages: int, live: int, seed: int, out: Path | None, folder: Path) -> int:
    """Both; returns 1 if something was raised or the master did not live through it."""
    setup = make_setup(
        {
            "task": {"kind": "place"},
            "tokens": {"shapes": ["square"], "scale": 1.0},
            "sim": {},
            "reward": {},
            "agent": {"kind": "pair"},
            "net": {},
        }
    )
    begun = time.monotonic()
    ends, wrong = fuzz_decoder(setup, messages, seed)
    rate = messages / (time.monotonic() - begun)
    rows = [{"what": name, "messages": number} for name, number in ends.most_common()]
    show(f"the decoder, {rate:,.0f} messages/s", rows)
    for line in wrong:
        print(line)
    master = fuzz_master(folder, live, seed)
    show("a master that is training", [{"what": k, "value": v} for k, v in master.items()])
    write(out, {"decoder": rows, "raised": wrong, "master": master, "seed": seed})
    trained = master["updates after"] > master["updates before"]
    return int(bool(wrong) or not trained or master["launcher's status"] != 0)
