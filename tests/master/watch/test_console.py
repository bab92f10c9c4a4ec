"""What the user sees while a run goes on, also when nobody looks any more."""

import json
import logging
import os
import subprocess
import sys
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from master.record.counters import Counters
from master.watch.console import (
    LivePanel,
    StatusLines,
    logging_to,
    make_progress,
    status_line,
    status_panel,
)
from tangram_core.errors import ConfigError
from tangram_core.run.outcome import duration
from tangram_core.scores import SHOWN, Score, written
from tangram_core.wire.messages import OPEN, WORKER_COLUMNS, RunStatus
from tangram_tasks.place import ONE_TOKEN
from tests.master.builders import screen, text

log = logging.getLogger("master.test")

STATUS = RunStatus(
    {
        "episodes": 12345,
        "transitions": 12345,
        "updates": 1234,
        "elapsed_s": 83.2,
        "share": 0.27,
        "left_s": 3700.0,
        "transitions_per_s": 950.4,
        "updates_per_s": 95.12,
        "players": 2,
        "evaluators": 1,
        "test/mean_reward": 0.9312,
        "test/coverage": 0.9656,
        "test/angle_error_deg_median": 1.214,
        "test/position_error_median": 0.01034,
    },
    {"activity": "learning", "scores": json.dumps(written(ONE_TOKEN[:SHOWN]))},
    np.zeros((0, len(WORKER_COLUMNS))),
)
BRACKETS = Score("speed", "speed [m/s] [/]")  # no markup
UNSCORED = {name: value for name, value in STATUS.numbers.items() if "/" not in name}
FRESH = replace(STATUS, numbers=UNSCORED | {"share": -1.0, "left_s": -1.0, "players": 1})


@pytest.mark.fast
@pytest.mark.parametrize(
    ("seconds", "shown"),
    [(0, "0:00"), (59.6, "1:00"), (754, "12:34"), (3723, "1:02:03"), (360000, "100:00:00")],
)
def test_durations(seconds: float, shown: str) -> None:
    assert duration(seconds) == shown


@pytest.mark.fast
@pytest.mark.parametrize(
    ("value", "shown"),
    [(0.99952, "0.9995"), (0.9994, "0.999"), (0.999999999999, "1.000000000"), (1.0, "1.000")],
)
def test_a_share_below_one_is_not_shown_as_one(value: float, shown: str) -> None:
    assert Score("coverage", "coverage").shown(value) == shown


@pytest.mark.fast
@pytest.mark.parametrize(
    ("score", "got"),
    [(("x" * 41,), "41, 0 and 3"), (("x", 3, "m" * 9), "1, 9 and 3"), (("x", -1), "1, 0 and -1")],
)
def test_a_score_that_does_not_fit_is_refused(score: tuple[Any, ...], got: str) -> None:
    with pytest.raises(ConfigError, match=f"digits be 0 to 9, got {got}: correct"):
        Score("speed", *score)


@pytest.mark.fast
@pytest.mark.parametrize(
    ("status", "line", "words"),
    [
        (
            STATUS,
            "1:23 | 27%, 1:01:40 left | 12,345 episodes | 1,234 updates | 950 transitions/s | "
            "95.1 updates/s | mean reward 0.931, coverage 0.966, "
            "angle error 1.21° | 2 workers | learning",
            ["27%  1:23, 1:01:40 left", "0.931", "1.21°", "2 workers, 1 evaluator · learning"],
        ),
        (
            FRESH,
            "1:23 | 12,345 episodes | 1,234 updates | 950 transitions/s | 95.1 updates/s | "
            "1 worker | learning",
            ["no bound: Ctrl-C ends the run", "mean reward", "1 worker, 1 evaluator"],
        ),
        (
            replace(FRESH, numbers=FRESH.numbers | {"open_to_all": 1.0}),
            "1:23 | 12,345 episodes | 1,234 updates | 950 transitions/s | 95.1 updates/s | "
            f"1 worker | learning | {OPEN}",
            [OPEN],
        ),
        (
            replace(FRESH, numbers=FRESH.numbers | {"play/reward": -0.25, "evaluators": 0}),
            "1:23 | 12,345 episodes | 1,234 updates | 950 transitions/s | 95.1 updates/s | "
            "players' reward -0.250 | 1 worker | learning",
            ["players' reward", "-0.250", "no evaluator: start one with tangram-worker connect=r"],
        ),
        (
            replace(
                FRESH,
                numbers=FRESH.numbers | {"test/speed": 1.5},
                texts=FRESH.texts | {"scores": json.dumps(written([BRACKETS]))},
            ),
            "1:23 | 12,345 episodes | 1,234 updates | 950 transitions/s | 95.1 updates/s | "
            "speed [m/s] [/] 1.500 | 1 worker | learning",
            ["speed [m/s] [/]", "1.500"],
        ),
    ],
)
def test_a_line_and_the_panel_tell_everything(
    status: RunStatus, line: str, words: list[str]
) -> None:
    assert status_line(status) == line
    shown = screen()
    start = "tangram-worker connect=r role=evaluator"
    shown.print(status_panel(status, "tangram · run", start))
    assert all(word in text(shown) for word in words)
    assert {len(line) for line in text(shown).splitlines()} == {76}


@pytest.mark.fast
def test_status_lines_come_at_a_bounded_rate_and_others_at_once() -> None:
    shown = screen()
    lines = StatusLines(interval_s=1000.0)
    with logging_to(shown):
        for _ in range(5):
            lines.show(STATUS)
        log.info("a [line] %s", "x" * 200)
        log.warning("with its %s", "level")
        log.debug("not for the user")
    log.info("afterwards")
    assert text(shown).splitlines() == [
        status_line(STATUS),
        "a [line] " + "x" * 200,
        "warning: with its level",
    ]


@pytest.mark.fast
def test_the_panel_is_drawn_in_place_below_the_log() -> None:
    shown = screen(force_terminal=True)
    panel = LivePanel(shown, "tangram · run", interval_s=1000.0)
    panel.show(STATUS)
    with logging_to(shown):
        log.info("worker 1 ended")
    for updates in range(2000, 2100):
        panel.show(replace(STATUS, numbers={**STATUS.numbers, "updates": updates}))
    panel.close()
    assert "worker 1 ended" in text(shown)
    # Once when it came, below the line, and the last one at the end.
    assert text(shown).count("tangram · run") <= 4
    assert "2,098" not in text(shown)
    assert "2,099" in text(shown)
    assert text(shown).endswith("\x1b[?25h")  # the cursor is shown again


@pytest.mark.fast
@pytest.mark.parametrize(
    ("terminal", "log_format", "kind"),
    [(True, "text", LivePanel), (False, "text", StatusLines), (True, "json", StatusLines)],
)
def test_terminals_get_a_panel_and_pipes_and_programs_get_lines(
    terminal: bool, log_format: str, kind: type
) -> None:
    made = make_progress(screen(force_terminal=terminal), "run", log_format)
    made.close()
    assert isinstance(made, kind)


@pytest.mark.fast
def test_programs_read_json() -> None:
    shown = screen()
    with logging_to(shown, "json"):
        StatusLines().show(STATUS)
        log.info("goes [on] %s", "x" * 200)
        Counters().note("malformed", "no header")
    with logging_to(shown, "json", "launcher"):
        log.info("the master ended")
    lines = [json.loads(line) for line in text(shown).splitlines()]
    assert all(datetime.fromisoformat(line.pop("time")).tzinfo is not None for line in lines)
    common = {"level": "INFO", "process": "master", "event": "note"}
    told = {"message": "malformed (number 1): no header", "count": 1}
    assert lines == [
        common
        | {"event": "status", "message": status_line(STATUS), **STATUS.texts, **STATUS.numbers},
        common | {"message": "goes [on] " + "x" * 200},
        common | {"level": "WARNING", "event": "malformed"} | told,
        common | {"process": "launcher", "message": "the master ended"},
    ]


# With real pipes and terminals

LIMIT_S = 100.0
# Prints until it is told that its output is gone, then more, and ends in order.
CODE = """
import logging, sys
from master.watch.console import logging_to, make_progress, sturdy_console
console, log = sturdy_console(sys.stdout), logging.getLogger("master.run")
print(console.is_terminal, file=sys.stderr)
progress = make_progress(console, "run")
with logging_to(console):
    log.info("0.04° · before")
    sys.stdin.readline()
    for _ in range(3):
        log.info("x" * 100_000)
progress.close()
"""


@pytest.mark.cluster
@pytest.mark.parametrize(
    ("terminal", "encoding", "before"),
    [(False, "ascii", "0.04? ? before"), (True, "utf-8", "0.04° · before")],
)
def test_what_cannot_be_shown_and_a_reader_that_goes_away_end_nothing(
    terminal: bool, encoding: str, before: str
) -> None:
    ours, theirs = os.openpty() if terminal else os.pipe()
    more = {"TERM": "xterm", "PYTHONIOENCODING": encoding}
    with subprocess.Popen(
        [sys.executable, "-c", CODE],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[3])} | more,
        stdin=subprocess.PIPE,
        stdout=theirs,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        os.close(theirs)
        seen = b""
        while before.encode() not in seen:
            seen += os.read(ours, 1000)
        os.close(ours)
        _, errors = process.communicate("go on\n", timeout=LIMIT_S)
    assert (process.returncode, errors) == (0, f"{terminal}\n")


FULL = """
import resource, sys
from master.watch.console import sturdy_console
console, (_, most) = sturdy_console(sys.stdout), resource.getrlimit(resource.RLIMIT_FSIZE)
console.print("before")
resource.setrlimit(resource.RLIMIT_FSIZE, (7, most))
for _ in range(3):
    console.print("x" * 20_000, highlight=False)
resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
console.print("after")
resource.setrlimit(resource.RLIMIT_FSIZE, (7, most))
console.print("at the end")
"""


@pytest.mark.cluster
def test_what_a_full_disk_does_not_take_is_lost_and_the_rest_goes_on(tmp_path: Path) -> None:
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    with (tmp_path / "log").open("wb") as log:
        told = subprocess.run(
            [sys.executable, "-c", FULL],
            env=buffered,
            stdout=log,
            stderr=subprocess.PIPE,
            timeout=LIMIT_S,
            check=False,
        )
    assert (told.returncode, told.stderr) == (0, b"")
    assert (tmp_path / "log").read_text() == "before\nafter\n"
