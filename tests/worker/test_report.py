"""The lines that a player logs about itself."""

import logging

import pytest

from worker.report import Report

pytestmark = pytest.mark.fast


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_a_line_every_half_minute_with_rate_and_waiting(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "worker.report")
    clock = Clock()
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


def test_each_reason_to_wait_is_said_once_between_reports(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "worker.report")
    clock = Clock()
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
