"""The messages about a run's standing: there and back, and nothing else."""

from typing import Any

import numpy as np
import pytest

from tangram_agent.decoding import decode_from_master, decode_from_worker
from tangram_agent.frames import MAX_ENTRIES
from tangram_agent.standing import MAX_ROWS, WORKER_COLUMNS, AskStatus, RunStatus
from tangram_sim.errors import WireError
from tests.agent.messages import SPEC, with_header

pytestmark = pytest.mark.fast

COLUMNS = len(WORKER_COLUMNS)


def status(rows: int = 3, **more: Any) -> RunStatus:
    table = np.arange(rows * COLUMNS, dtype=np.float64).reshape(rows, COLUMNS)
    fields = {"numbers": {"updates": 7.0, "hub/batches": 2.0}, "texts": {"run": "é"}, **more}
    return RunStatus(workers=table, **fields)


def test_a_question_comes_back() -> None:
    assert decode_from_worker(AskStatus().encode(), SPEC) == AskStatus()


@pytest.mark.parametrize("rows", [0, 1, 3])
def test_a_status_comes_back(rows: int) -> None:
    sent = status(rows)
    found = decode_from_master(sent.encode(), None)
    assert isinstance(found, RunStatus)
    assert (found.numbers, found.texts) == (sent.numbers, sent.texts)
    np.testing.assert_array_equal(found.workers, sent.workers)


def test_more_than_a_receiver_takes_is_cut() -> None:
    long = {"run": "é" * 5000}
    found = decode_from_master(status(MAX_ROWS + 5, texts=long).encode(), None)
    assert isinstance(found, RunStatus)
    assert len(found.workers) == MAX_ROWS
    assert 0 < len(found.texts["run"]) < 5000


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({f"n{i}": 0.0 for i in range(MAX_ENTRIES + 1)}, "at most 64 numbers"),
        ({"x": float("nan")}, "must be a finite number"),
        ({"Bad name": 1.0}, "a name is"),
    ],
)
def test_what_a_receiver_refuses_is_not_sent(numbers: dict[str, float], message: str) -> None:
    with pytest.raises(WireError, match=message):
        status(numbers=numbers).encode()


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (with_header(status().encode(), count=4), "workers must have 288 bytes"),
        (with_header(status().encode(), count=MAX_ROWS + 1), "count must be an integer between"),
        (with_header(status().encode(), numbers={"x": "y"}), "must be a finite number"),
        (with_header(status().encode(), texts={"x": 1}), "must be a text"),
        (with_header(status().encode(), more=1), "unknown field 'more'"),
        (status().encode()[:1], "there must be 1 array frames, got 0"),
        ([*status().encode(), b""], "there must be 1 array frames, got 2"),
        ([status().encode()[0], b"\xff" * 8 * 3 * COLUMNS], "must be finite"),
    ],
)
def test_a_wrong_status_is_refused(frames: list[bytes], message: str) -> None:
    with pytest.raises(WireError, match=message):
        decode_from_master(frames, None)
