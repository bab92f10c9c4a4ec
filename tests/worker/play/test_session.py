"""The lines that a player logs about itself."""

import json
import logging
from datetime import datetime

import pytest

from worker.play.session import Report, log_as

pytestmark = pytest.mark.fast


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def test_a_line_every_half_minute_with_rate_and_waiting(
    clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "worker.play.session")
    report = Report(clock)
    report.played(100, 1)
    with report.waiting("the master is behind"):
        clock.now += 10.0
    clock.now += 19.9
    report.played(100, 2)
    assert caplog.messages == ["waits: the master is behind"]
    clock.now += 10.1
    report.played(200, 3)
    assert caplog.messages[1:] == [
        "400 episodes in 40 s (10.0/s), 25 % of the time waiting, weights 3"
    ]
    clock.now += 30.0
    report.played(30, 4)
    assert caplog.messages[2:] == [
        "30 episodes in 30 s (1.0/s), 0 % of the time waiting, weights 4"
    ]


def test_the_master_is_told_what_episodes_took_of_a_processor(clock: Clock) -> None:
    processor = Clock()
    report = Report(clock, processor)
    told = []
    for _ in range(2):
        clock.now += 40.0  # a line each time
        processor.now += 3.0
        told.append(report.played(10, 1))
    assert told == [{"episodes": 10.0, "busy_s": 3.0}, {"episodes": 20.0, "busy_s": 6.0}]


def test_as_json_every_number_has_a_name(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    log_as("player 3", "json")
    report = Report(clock)
    with report.waiting("the master is behind"):
        clock.now += 30.0
    report.played(60, 3)
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert all(datetime.fromisoformat(line.pop("time")).tzinfo is not None for line in lines)
    common = {"level": "INFO", "process": "player 3"}
    assert lines == [
        common | {"event": "waits", "message": "waits: the master is behind"},
        common
        | {
            "event": "played",
            "message": "60 episodes in 30 s (2.0/s), 100 % of the time waiting, weights 3",
            "episodes": 60,
            "seconds": 30.0,
            "episodes_per_s": 2.0,
            "percent_waiting": 100.0,
            "weights_version": 3,
        },
    ]


def test_each_reason_to_wait_is_said_once_between_reports(
    clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "worker.play.session")
    report = Report(clock)
    for why in ("one", "two", "one"):
        with report.waiting(why):
            pass
    assert caplog.messages == ["waits: one", "waits: two"]
    clock.now += 30.0
    report.played(1, 1)
    with report.waiting("one"):
        pass
    assert caplog.messages[3:] == ["waits: one"]
