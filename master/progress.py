"""What the user sees while a run goes on: a live panel on a terminal, plain lines elsewhere."""

import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

PANEL_S = 0.5
LINE_S = 10.0
PANEL_WIDTH = 76


@dataclass(frozen=True)
class Status:
    """A run at one moment.

    Attributes:
        episodes, transitions, updates: since the run began.
        elapsed_s: seconds of training since the run began.
        share: used share of the budget, or None where nothing is bounded.
        left_s: seconds left, or None when unknown.
        transitions_per_s, updates_per_s: over the last seconds.
        players, evaluators: connected now.
        activity: what happens, or what is waited for.
        scores: of the last evaluation, by name; empty before the first.
    """

    episodes: int
    transitions: int
    updates: int
    elapsed_s: float
    share: float | None
    left_s: float | None
    transitions_per_s: float
    updates_per_s: float
    players: int
    evaluators: int
    activity: str
    scores: Mapping[str, float]


class Progress(Protocol):
    """Shows statuses and notices until it is closed."""

    def show(self, status: Status) -> None:
        """Show a status; cheap, and may be called as often as one likes."""

    def notice(self, line: str) -> None:
        """Show one line at once, and keep it."""

    def close(self) -> None:
        """Leave the terminal as it was found."""


def make_progress(console: Console, title: str) -> Progress:
    """A live panel where the console is a terminal, plain lines where it is not."""
    return LivePanel(console, title) if console.is_terminal else PlainLines(console)


class _Notices(logging.Handler):
    def __init__(self, progress: Progress) -> None:
        super().__init__(logging.WARNING)
        self._progress = progress

    def emit(self, record: logging.LogRecord) -> None:
        self._progress.notice(f"{record.levelname.lower()}: {record.getMessage()}")


@contextmanager
def notices_from(logger_name: str, progress: Progress) -> Iterator[None]:
    """Show a logger's warnings as notices: written past a live panel they would be lost."""
    logger, handler = logging.getLogger(logger_name), _Notices(progress)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


class PlainLines:
    """One line now and then: for log files, pipes and batch systems."""

    def __init__(self, console: Console, interval_s: float = LINE_S) -> None:
        self._console = console
        self._interval_s = interval_s
        self._next_s = 0.0

    def show(self, status: Status) -> None:
        """Print the status if the last line is old enough."""
        now_s = time.monotonic()
        if now_s >= self._next_s:
            self._next_s = now_s + self._interval_s
            self.notice(status_line(status))

    def notice(self, line: str) -> None:
        """Print one line."""
        self._console.print(line, soft_wrap=True, markup=False, highlight=False)

    def close(self) -> None:
        """Nothing is left to do."""


class LivePanel:
    """A panel that is drawn again in place; notices scroll above it."""

    def __init__(self, console: Console, title: str, interval_s: float = PANEL_S) -> None:
        self._console, self._title = console, title
        self._interval_s = interval_s
        self._next_s = 0.0
        self._last: Status | None = None
        self._live = Live(console=console, auto_refresh=False, transient=False)
        self._live.start()

    def show(self, status: Status) -> None:
        """Draw the panel if the last drawing is old enough."""
        self._last = status
        now_s = time.monotonic()
        if now_s >= self._next_s:
            self._next_s = now_s + self._interval_s
            self._draw(status)

    def notice(self, line: str) -> None:
        """Print one line above the panel."""
        self._console.print(line, soft_wrap=True, markup=False, highlight=False)

    def close(self) -> None:
        """Leave the last status and go below it."""
        if self._last is not None:
            self._draw(self._last)
        self._live.stop()

    def _draw(self, status: Status) -> None:
        self._live.update(status_panel(status, self._title), refresh=True)


def duration(seconds: float) -> str:
    """0:07, 12:34 or 1:02:03."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def plural(count: int, noun: str) -> str:
    """1 worker, 2 workers."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"


def status_line(status: Status) -> str:
    """One line for people and for grep."""
    parts = [duration(status.elapsed_s)]
    if status.share is not None:
        parts.append(f"{status.share:.0%}{_left(status)}")
    parts += [
        plural(status.episodes, "episode"),
        plural(status.updates, "update"),
        f"{status.transitions_per_s:,.0f} transitions/s",
        f"{status.updates_per_s:,.1f} updates/s",
        score_text(status.scores),
        plural(status.players, "worker"),
        status.activity,
    ]
    return " | ".join(part for part in parts if part)


def score_text(scores: Mapping[str, float]) -> str:
    """The scores that matter most, or nothing before the first evaluation."""
    known = (
        ("mean_reward", "reward {:.3f}"),
        ("angle_error_deg_median", "angle {:.2f}°"),
        ("position_error_median", "position {:.4f}"),
    )
    return ", ".join(text.format(scores[name]) for name, text in known if name in scores)


def status_panel(status: Status, title: str) -> Panel:
    """The live panel: how far, how fast, how good, and what is waited for."""
    grid = Table.grid(padding=(0, 3), expand=True)
    for _ in range(2):
        grid.add_column(style="dim", no_wrap=True)
        grid.add_column(justify="right", no_wrap=True)
    grid.add_row("episodes", f"{status.episodes:,}", "updates", f"{status.updates:,}")
    grid.add_row(
        "transitions/s",
        f"{status.transitions_per_s:,.0f}",
        "updates/s",
        f"{status.updates_per_s:,.1f}",
    )
    scores = status.scores
    grid.add_row(
        "mean reward",
        Text(_score(scores, "mean_reward", "{:.3f}"), style="bold green"),
        "raw overlap",
        _score(scores, "raw_overlap", "{:.3f}"),
    )
    grid.add_row(
        "angle error",
        _score(scores, "angle_error_deg_median", "{:.2f}°"),
        "position error",
        _score(scores, "position_error_median", "{:.4f}"),
    )
    helpers = f"{plural(status.players, 'worker')}, {plural(status.evaluators, 'evaluator')}"
    foot = Text(f"{helpers} · {status.activity}", style="dim", no_wrap=True, overflow="ellipsis")
    body = Group(_bar(status), Text(), grid, Text(), foot)
    return Panel(body, title=title, title_align="left", width=PANEL_WIDTH, padding=(1, 2))


def _bar(status: Status) -> Table:
    row = Table.grid(padding=(0, 2), expand=True)
    row.add_column(ratio=1)
    row.add_column(justify="right", no_wrap=True)
    if status.share is None:
        row.add_row(Text("no bound: Ctrl-C ends the run", style="dim"), duration(status.elapsed_s))
        return row
    bar = ProgressBar(total=1.0, completed=status.share, complete_style="cyan")
    row.add_row(bar, f"{status.share:4.0%}  {duration(status.elapsed_s)}{_left(status)}")
    return row


def _left(status: Status) -> str:
    return f", {duration(status.left_s)} left" if status.left_s else ""


def _score(scores: Mapping[str, float], name: str, pattern: str) -> str:
    return pattern.format(scores[name]) if name in scores else "-"
