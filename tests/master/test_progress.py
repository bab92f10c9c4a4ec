"""What the user sees: lines, the panel, and the final table."""

import io
import json
import logging
import shlex
from dataclasses import asdict, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from rich.console import Console

from master.console import (
    LivePanel,
    PlainLines,
    make_lines,
    make_progress,
    notices_from,
    status_panel,
)
from master.result import SCORES, show_result
from master.rundir import RunFolder
from master.status import Status, duration, status_line
from master.tally import Tally
from tests.master.builders import ShownProgress

pytestmark = pytest.mark.fast

SCORED = {
    "mean_reward": 0.9312,
    "raw_overlap": 0.9656,
    "angle_error_deg_median": 1.214,
    "position_error_median": 0.01034,
}
STATUS = Status(
    episodes=12345,
    transitions=12345,
    updates=1234,
    elapsed_s=83.2,
    share=0.27,
    left_s=3700.0,
    transitions_per_s=950.4,
    updates_per_s=95.12,
    players=2,
    evaluators=1,
    activity="learning",
    scores=SCORED,
)
FRESH = replace(STATUS, share=None, left_s=None, scores={}, players=1)


def console(**settings: Any) -> Console:
    return Console(file=io.StringIO(), width=100, **settings)


def text(shown: Console) -> str:
    assert isinstance(shown.file, io.StringIO)
    return shown.file.getvalue()


@pytest.mark.parametrize(
    ("seconds", "shown"),
    [(0, "0:00"), (59.6, "1:00"), (754, "12:34"), (3723, "1:02:03"), (360000, "100:00:00")],
)
def test_durations(seconds: float, shown: str) -> None:
    assert duration(seconds) == shown


@pytest.mark.parametrize(
    ("status", "line"),
    [
        (
            STATUS,
            "1:23 | 27%, 1:01:40 left | 12,345 episodes | 1,234 updates | 950 transitions/s | "
            "95.1 updates/s | reward 0.931, angle 1.21°, position 0.0103 | 2 workers | learning",
        ),
        (
            FRESH,
            "1:23 | 12,345 episodes | 1,234 updates | 950 transitions/s | 95.1 updates/s | "
            "1 worker | learning",
        ),
    ],
)
def test_a_line_tells_everything(status: Status, line: str) -> None:
    assert status_line(status) == line


@pytest.mark.parametrize(
    ("status", "words"),
    [
        (
            STATUS,
            ["27%  1:23, 1:01:40 left", "0.931", "1.21°", "2 workers, 1 evaluator · learning"],
        ),
        (FRESH, ["no bound: Ctrl-C ends the run", "mean reward", "1 worker, 1 evaluator"]),
    ],
)
def test_the_panel_tells_everything(status: Status, words: list[str]) -> None:
    shown = console()
    shown.print(status_panel(status, "tangram · run"))
    assert all(word in text(shown) for word in words)
    assert {len(line) for line in text(shown).splitlines()} == {76}


def test_plain_lines_come_at_a_bounded_rate_and_notices_at_once() -> None:
    shown = console()
    lines = PlainLines(shown, interval_s=1000.0)
    for _ in range(5):
        lines.show(STATUS)
    lines.notice("a [notice] " + "x" * 200)
    lines.close()
    assert text(shown).splitlines() == [status_line(STATUS), "a [notice] " + "x" * 200]


def test_the_panel_is_drawn_in_place_below_notices() -> None:
    shown = console(force_terminal=True)
    panel = LivePanel(shown, "tangram · run", interval_s=1000.0)
    panel.show(STATUS)
    panel.notice("worker 1 ended")
    for updates in range(2000, 2100):
        panel.show(replace(STATUS, updates=updates))
    panel.close()
    assert "worker 1 ended" in text(shown)
    # Once when it came, below the notice, and the last one at the end.
    assert text(shown).count("tangram · run") <= 4
    assert "2,098" not in text(shown)
    assert "2,099" in text(shown)
    assert text(shown).endswith("\x1b[?25h")  # the cursor is shown again


@pytest.mark.parametrize(("terminal", "kind"), [(True, LivePanel), (False, PlainLines)])
def test_terminals_get_a_panel_and_pipes_get_lines(terminal: bool, kind: type) -> None:
    made = make_progress(console(force_terminal=terminal), "run")
    made.close()
    assert isinstance(made, kind)


def json_lines(shown: Console) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in text(shown).splitlines()]
    for line in lines:
        assert datetime.fromisoformat(line.pop("time")).tzinfo is not None
    return lines


def test_programs_read_json() -> None:
    shown = console()
    lines = make_progress(shown, "run", "json")
    for _ in range(2):  # within one interval
        lines.show(STATUS)
    lines.notice("goes [on] " + "x" * 200)
    with notices_from("master", lines):
        Tally().note("malformed", "no header")
    make_lines(shown, "json").notice("the master ended")
    common = {"level": "INFO", "process": "master"}
    assert json_lines(shown) == [
        common | {"event": "status", "message": "learning"} | asdict(STATUS),
        common | {"event": "note", "message": "goes [on] " + "x" * 200},
        {
            "level": "WARNING",
            "process": "master",
            "event": "malformed",
            "message": "malformed (number 1): no header",
            "count": 1,
        },
        common | {"process": "launcher", "event": "note", "message": "the master ended"},
    ]


def test_warnings_of_the_hub_become_notices() -> None:
    shown, log = ShownProgress(), logging.getLogger("master.hub")
    with notices_from("master", shown):
        log.warning("%s (number %d)", "malformed", 1)
        log.info("not for the user")
    log.debug("afterwards")
    assert shown.notices == ["warning: malformed (number 1)"]


RESULT = dict.fromkeys(SCORES) | {
    "scored_updates": None,
    "updates": 1234,
    "episodes": 5678,
    "train_s": 61.0,
    "wall_s": 75.0,
    "ended_by": "max_updates=1234",
}


@pytest.mark.parametrize(
    ("change", "words", "without"),
    [
        ({}, ["none: no evaluator took part", "1:01 of training, 1:15 in all"], ["mean reward"]),
        (
            SCORED | {"scored_updates": 1234},
            ["0.931 on exact polygons", "- in the camera's", "1.21° (median)", "1,234"],
            ["weights after"],
        ),
        (SCORED | {"scored_updates": 1000}, ["weights after 1,000 updates"], []),
    ],
)
def test_the_final_table(
    tmp_path: Path, change: dict[str, Any], words: list[str], without: list[str]
) -> None:
    shown, folder = console(), RunFolder(tmp_path / ("deep_" * 30))
    show_result(shown, folder, RESULT | change)
    assert all(word in text(shown) for word in words)
    assert not any(word in text(shown) for word in without)
    assert f"tangram-play run_dir={folder.path} out=play.gif" in text(shown)
    assert f"tensorboard --logdir {folder.path}/tensorboard" in text(shown)
    assert "test_episodes.png" not in text(shown)


def test_commands_that_are_shown_can_be_pasted(tmp_path: Path) -> None:
    shown, folder = console(), RunFolder(tmp_path / "it's a=run")
    show_result(shown, folder, RESULT)
    curves, play = (shlex.split(line) for line in text(shown).splitlines()[-2:])
    assert curves[-1] == str(folder.tensorboard)
    (parsed,) = OverridesParser.create().parse_overrides([play[-2]])
    assert parsed.value() == str(folder.path)
