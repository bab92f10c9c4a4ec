"""The attacks that need no training; the others run by `tangram-bench attack`."""

import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from multiprocessing import active_children
from pathlib import Path
from threading import Timer
from types import SimpleNamespace
from typing import Any, cast

import pytest
import zmq

from tangram_lab.benchmarks.trials import attacks, harms
from tangram_lab.benchmarks.trials.attack import beside
from tangram_lab.benchmarks.trials.attacks import (
    BESIEGED,
    LIVE,
    degenerate_batches,
    player_as_evaluator,
    thousand_strangers,
    uninvited,
)
from tangram_lab.benchmarks.trials.chaos import Witness
from tangram_lab.benchmarks.trials.harms import LOCKSTEP, OWN, acknowledged_again
from tangram_lab.benchmarks.trials.neighbours import NEIGHBOURS, is_fair
from tangram_lab.benchmarks.trials.starts import STARTS
from tangram_lab.benchmarks.trials.target import Attack, Growth, Seen, Target, tried
from tests.agent.builders import setup

pytestmark = pytest.mark.slow


def test_an_attack_that_fails_has_not_held() -> None:
    def breaks(_: object) -> tuple[bool, str]:
        raise ConnectionError("gone")

    attacks: list[Attack] = [("1", "one", "1", breaks), ("2", "two", "1", lambda _: (True, ""))]
    rows = list(tried(attacks, None))
    assert [row["held"] for row in rows] == [False, True]
    assert rows[0]["seen"] == "ConnectionError('gone')"


def test_what_is_done_beside_ends_with_an_attack_that_is_stopped() -> None:
    with pytest.raises(KeyboardInterrupt), beside() as pool:  # noqa: PT012
        pool.submit(time.sleep, 600.0)
        raise KeyboardInterrupt
    assert not active_children()


def test_all_rows_are_tried() -> None:
    """Row 4 and others several times, in several ways."""
    every = (*BESIEGED, *NEIGHBOURS, *LIVE, *OWN, *STARTS, *LOCKSTEP)
    with_files = {"7", "11", "13", "19"}  # tests/master/record, core, cluster, studio and slurm
    assert {one[0] for one in every} == {"held", *map(str, range(1, 23))} - with_files
    assert len({one[1] for one in every}) == len(every) >= 50


@pytest.mark.parametrize(
    ("hers", "whole", "fair"),
    [(40.0, 120.0, True), (33.0, 120.0, True), (31.0, 120.0, False), (40.0, 59.0, False)],
)
def test_a_share_is_eight_tenths_of_a_third(hers: float, whole: float, fair: bool) -> None:
    assert is_fair((60.0, 150.0), (hers, whole)) is fair


class Standing(Target):
    """A training that goes on, and answers and grows as it is told to."""

    answers: Counter[str]
    growth = Growth()
    master = cast(Any, SimpleNamespace(pid=1))
    where = {"endpoint": "tcp://127.0.0.1:1", "run_id": "x"}  # noqa: RUF012
    setup = setup()

    def ask(self, *_messages: list[bytes], role: str = "player") -> Counter[str]:
        return self.answers

    def goes_on(self, more: float = 1.0, name: str = "episodes") -> bool:
        return True

    @contextmanager
    def cost(self) -> Iterator[Growth]:
        yield self.growth


@pytest.fixture
def standing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Standing:
    monkeypatch.setattr(attacks, "lasting", lambda *_: None)
    monkeypatch.setattr("time.sleep", lambda _: None)
    monkeypatch.setattr(attacks, "ENDS_S", 0.0)
    monkeypatch.setattr(attacks, "Strangers", lambda *_: nullcontext(SimpleNamespace(push=None)))
    return Standing(tmp_path, cast("subprocess.Popen[bytes]", None), zmq.Context.instance())


def forged(standing: Standing, strike: Callable[[Target], Seen]) -> bool:
    (standing.folder / "curve.jsonl").write_text('{"updates": 3, "mean_reward": 0.999}\n')
    return strike(standing)[0]


@pytest.mark.parametrize(
    ("strike", "answers", "held"),
    [
        (degenerate_batches, {"welcome": 1, "reject": 22}, True),
        (degenerate_batches, {"welcome": 1, "reject": 21, "ack": 1}, False),
        (uninvited, {}, True),
        (uninvited, {"welcome": 1}, False),
        (player_as_evaluator, {"refused": 1}, True),
        (lambda target: (forged(target, uninvited), ""), {}, False),
        (lambda target: (forged(target, player_as_evaluator), ""), {"refused": 1}, False),
    ],
)
def test_an_answer_is_not_enough(
    standing: Standing, strike: Callable[[Target], Seen], answers: dict[str, int], held: bool
) -> None:
    standing.answers = Counter(answers)
    assert strike(standing)[0] == held


@pytest.mark.parametrize(
    ("growth", "acknowledged", "held"),
    [
        (Growth(10.0, 40), 1, True),
        (Growth(80.0, 40), 1, False),
        (Growth(10.0, 1003), 1, False),
        (Growth(10.0, 40), 0, False),
    ],
)
def test_strangers_take_little_memory_few_files_and_nobodys_turn(
    standing: Standing,
    monkeypatch: pytest.MonkeyPatch,
    growth: Growth,
    acknowledged: int,
    held: bool,
) -> None:
    """1,003 files were seen with the bound on handshakes taken away."""
    worker = SimpleNamespace(acknowledged=acknowledged)
    worker.start = worker.stop = worker.join = lambda *_: None
    monkeypatch.setattr(attacks, "Witness", lambda *_: worker)
    standing.growth = growth
    assert thousand_strangers(standing)[0] == held
    assert BESIEGED[0][3] is thousand_strangers  # others would have raised what it begins at


def test_a_witness_must_be_acknowledged_again(
    standing: Standing, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(harms, "ENDS_S", 0.1)
    witness = Witness("nobody", standing.setup)
    monkeypatch.setattr(witness, "is_alive", lambda: True)
    witness.acknowledged = 5
    assert not acknowledged_again(witness)
    monkeypatch.setattr(harms, "ENDS_S", 60.0)
    more = Timer(0.1, setattr, [witness, "acknowledged", 6])
    more.start()
    assert acknowledged_again(witness)
    more.join()
