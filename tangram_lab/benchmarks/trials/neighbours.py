"""Attacks by users who have a valid key, and their effect on other users of the same master."""

import json
import multiprocessing
import os
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from threading import Thread

import zmq

from master.config import KeysConfig
from master.hub.giving import change_keys
from tangram_core.errors import TangramError
from tangram_core.wire.messages import Alive, EpisodeBatch, Heartbeat
from tangram_core.wire.schema import MAX_COUNT, opened, seal
from tangram_lab.benchmarks.trials.attacks import forged_scores, unforged
from tangram_lab.benchmarks.trials.target import (
    ENDS_S,
    KEYS_S,
    LOOK_S,
    Attack,
    Seen,
    Target,
    episodes_of,
    until,
)
from worker.talk.client import Client

BATCH = 2  # episodes: even a slow learner accepts many such batches per second
FAIR = 0.8  # of an equal share: less is unfair
FLOOD_S, SETTLE_S = 5.0, 2.0
ESCAPE = "\x1b]0;owned\x07\x1b[2J"


class Steady(Thread):
    """A worker with its own key that obeys the protocol and sends ready-made episodes.

    Attributes:
        acknowledged: number of acknowledged batches.
    """

    def __init__(self, target: Target, name: str = "alice") -> None:
        super().__init__(name=name, daemon=True)
        self.acknowledged, self._ends = 0, False
        self._target, self._connect = target, str(target.given(name))

    def __enter__(self) -> "Steady":
        self.start()
        self.more(1)
        return self

    def __exit__(self, *_: object) -> None:
        self._ends = True
        self.join(ENDS_S)

    def run(self) -> None:
        """Send batches as fast as the master acknowledges them."""
        setup = self._target.setup
        episodes = episodes_of(setup, BATCH)
        with Client(self._connect, "player", -1, setup.fingerprints(), setup.spec) as client:
            client.on_progress = lambda: self._look(client)
            client.join()
            while client.wait_for_window():
                client.send(episodes, 0)

    def more(self, count: int) -> bool:
        """Whether `count` more batches are acknowledged in time."""
        goal = self.acknowledged + count
        until(lambda: self.acknowledged >= goal or not self.is_alive())
        return self.acknowledged >= goal

    def _look(self, client: Client) -> None:
        self.acknowledged = client.acknowledged
        if self._ends:
            client.stop("the trial is over")


def stolen(target: Target, kill: bool = False) -> Seen:
    """Mallory sends HELLO and BYE with all that the audit log tells about alice."""
    with Steady(target) as alice:
        lines = (target.folder / "audit.jsonl").read_text().splitlines()
        hers = [one for one in map(json.loads, lines) if one.get("key") == "alice"][-1]
        fields = {name: hers[name] for name in ("index", "incarnation", "process")}
        bye, mallory = seal("bye", {"reason": "x"}, []), target.given("mallory")
        if kill:
            target.master.kill()
            time.sleep(LOOK_S)
        answers = 0
        for first in (1, MAX_COUNT):
            with suppress(TangramError, OSError, zmq.ZMQError):
                said = target.hello(**fields, first=first), bye
                answers += target.ask(*said, unanswered=1, file=mallory)["welcome"]
        held = alice.more(8) and not answers
    losses = target.told().count("acknowledged batches that are not in")
    return held and not losses, f"{answers} let in, alice goes on: {held}, {losses} losses told"


def flood(target: Target, kind: str, connections: int) -> None:
    """Send batches, heartbeats or damaged batches with mallory's key from many connections.

    Never returns; kill the process.
    """
    os.nice(19)  # the trial is about shares of the master, not about CPU time of the machine
    spec, episodes = target.setup.spec, episodes_of(target.setup, BATCH)
    damaged = [frame[:-1] + b"\0" for frame in EpisodeBatch(1, 0, episodes).encode(spec)]
    words = {"heartbeats": Heartbeat({}).encode(), "damaged": damaged}
    target.context, numbers = zmq.Context(), [0] * connections
    target.context.set(zmq.MAX_SOCKETS, 4096)
    with ExitStack() as opened:
        keys = target.given("mallory")
        ends = [opened.enter_context(target.peer(file=keys, SNDHWM=64)) for _ in numbers]
        for number, one in enumerate(ends):
            one.send_multipart(target.hello(index=5000 + number, process=f"hog {number}"))
        while True:
            for place, one in enumerate(ends):
                while one.poll(0):
                    one.recv_multipart()
                batch = EpisodeBatch(numbers[place] + 1, 0, episodes)
                with suppress(zmq.Again):
                    one.send_multipart(words.get(kind) or batch.encode(spec), zmq.NOBLOCK)
                    numbers[place] += 1


@contextmanager
def flooding(target: Target, kind: str, connections: int) -> Iterator[None]:
    """Run `flood` inside this context, in another process so that it does not slow alice's."""
    target.given("mallory")
    hog = multiprocessing.get_context("fork").Process(
        target=flood, args=(target, kind, connections), daemon=True
    )
    hog.start()
    try:
        yield
    finally:
        hog.kill()
        hog.join()


def shared(target: Target, kind: str, connections: int) -> Seen:
    """Whether alice and the run's own workers keep a third each while mallory floods.

    Other trainings begin and end beside: the lesser of the rates before and after it counts.
    """
    with Steady(target) as alice:

        def rates() -> tuple[float, float]:
            """Transitions per second of alice, and of all."""
            before, begun = alice.acknowledged, time.monotonic()
            whole = target.numbers()["transitions"]
            time.sleep(FLOOD_S)
            whole, took = target.numbers()["transitions"] - whole, time.monotonic() - begun
            per_batch = episodes_of(target.setup, BATCH).transitions
            return (alice.acknowledged - before) * per_batch / took, whole / took

        before = rates()
        with flooding(target, kind, connections):
            time.sleep(SETTLE_S)
            hers, whole = rates()
        time.sleep(SETTLE_S)
        after = rates()
    alone = min(before[0], after[0]), min(before[1], after[1])
    seen = f"alice {hers:.1f} of {whole:.1f}, alone {alone[0]:.1f} of {alone[1]:.1f} a second"
    return is_fair(alone, (hers, whole)), seen


def is_fair(alone: tuple[float, float], flooded: tuple[float, float]) -> bool:
    """Whether one of three keys keeps its share, and the flood costs at most half of all play.

    Args:
        alone: transitions per second of one key, and of all keys, before the flood.
        flooded: the same two rates during the flood.
    """
    fair = min(alone[0], flooded[1] / 3.0)
    return flooded[0] >= FAIR * fair and flooded[1] >= FAIR * alone[1] / 2.0


def revoked(target: Target) -> Seen:
    """Whether a revoked key gets no answers."""
    file = target.given("eve")
    change_keys(KeysConfig(str(target.folder), revoke="eve"))
    time.sleep(KEYS_S)
    hello = target.hello(index=3050, process="eve")
    answers = target.ask(hello, unanswered=0, file=file)
    held = not answers and target.goes_on()
    file.unlink()
    return held, f"{answers.total()} answers"


def second_evaluator(target: Target) -> Seen:
    """Score each new version of the weights with the key of another user."""
    file, answers = target.given("judge", role="evaluator"), Counter[str]()
    with target.peer(role="evaluator", file=file) as one:
        one.send_multipart(target.hello(role="evaluator", index=-1, process="judge"))
        for _ in range(10):
            one.send_multipart(Heartbeat({}).encode())
            while one.poll(500):
                said = opened(one.recv_multipart())
                answers[said["kind"]] += 1
                if said["kind"] == Alive.kind:
                    one.send_multipart(forged_scores(target, said["version"]))
    held, seen = unforged(target)
    return held and answers["reject"] > 0, f"answered {dict(answers)}, {seen}"


def escapes(target: Target) -> Seen:
    """Send terminal escape sequences in all texts of a worker; none may be written raw."""
    hello = target.hello(index=3060, process=ESCAPE)
    answers = target.ask(hello, seal("bye", {"reason": ESCAPE}, []), unanswered=1)
    log = (target.folder / "audit.jsonl").read_text()
    raw = sum(sign in text for sign in "\x1b\x07" for text in (target.told(), log))
    return not raw and target.goes_on(), f"{raw} raw, answered {dict(answers)}"


def said(target: Target, fields: dict[str, object], answer: str) -> Seen:
    """Whether a HELLO with these fields gets this answer, and the training goes on."""
    own: dict[str, object] = {"index": 3070, "process": "said"}
    answers = target.ask(target.hello(**own | fields))
    return answers == {answer: 1} and target.goes_on(), f"answered: {dict(answers)}"


WRONG: dict[str, tuple[dict[str, object], str]] = {
    "another run": ({"run_id": "other"}, "refused"),
    "other settings": ({"fingerprints": {}}, "refused"),
    "an unknown role": ({"role": "root"}, "reject"),
    "a role of another key": ({"role": "evaluator"}, "refused"),
    "an index below all": ({"index": -2}, "reject"),
    "an index beyond all": ({"index": 10**9}, "reject"),
    "a name of 10,000 letters": ({"process": "x" * 10**4}, "reject"),
    "another protocol": ({"v": 1}, "refused"),
}
FLOODS = (("batches", 64), ("heartbeats", 1), ("damaged", 8))
NEIGHBOURS: list[Attack] = [
    ("14", "another's index, incarnation and process", "2 HELLO, BYE", stolen),
    ("14", "the same once the master was killed", "1 kill", partial(stolen, kill=True)),
    *(
        (
            "15",
            f"a key that floods with {kind}",
            f"{count}, {FLOOD_S:g} s",
            partial(shared, kind=kind, connections=count),
        )
        for kind, count in FLOODS
    ),
    ("20", "escapes in texts", "2", escapes),
    ("22", "scores with the key of a second evaluator", "10 times", second_evaluator),
    ("held", "a key that was taken back", "1", revoked),
    *(
        ("held", f"HELLO with {what}", "1", partial(said, fields=fields, answer=answer))
        for what, (fields, answer) in WRONG.items()
    ),
]
