"""What the user sees while a run goes on: a live panel on a terminal, plain lines elsewhere.

The console outlives its terminal: it falls silent instead of failing.
"""

import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any, Protocol, TextIO, cast

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from master.status import Status, duration, left_text, plural, status_line
from tangram_agent.process import Every, formatter

PANEL_S = 0.5
LINE_S = 10.0
PANEL_WIDTH = 76


class _Sturdy:
    """A text file that turns into the null device when its reader is gone, and shows what it can.

    A closed terminal or pipe must not end a run that goes on without anybody watching, nor a clean
    end that has still to be written down.
    """

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def write(self, text: str) -> int:
        try:
            return self._file.write(text)
        except UnicodeEncodeError:  # a terminal that knows fewer characters, such as LC_ALL=C
            known = text.encode(self._file.encoding, "replace")
            return self._file.write(known.decode(self._file.encoding))
        except OSError:
            return self._silence(text)

    def flush(self) -> None:
        try:
            self._file.flush()
        except OSError:
            self._silence("")

    def _silence(self, text: str) -> int:
        null = os.open(os.devnull, os.O_WRONLY)
        # Under the buffered file, whose rest is written at the interpreter's end at the latest.
        os.dup2(null, self._file.fileno())
        os.close(null)
        return len(text)


def sturdy_console(file: TextIO) -> Console:
    """A console on stdout or stderr that falls silent instead of failing."""
    return Console(file=cast(TextIO, _Sturdy(file)))


class Progress(Protocol):
    """Shows statuses and notices until it is closed."""

    def show(self, status: Status) -> None:
        """Show a status; cheap, and may be called as often as one likes."""

    def notice(self, line: str, level: str = "info", **fields: Any) -> None:
        """Show one line at once, and keep it; the fields are for programs."""

    def close(self) -> None:
        """Leave the terminal as it was found."""


def make_progress(console: Console, title: str, log_format: str = "text") -> Progress:
    """A live panel where the console is a terminal, lines where it is not, or JSON."""
    if log_format == "json":
        return JsonLines(console, "master")
    return LivePanel(console, title) if console.is_terminal else PlainLines(console)


def make_lines(console: Console, log_format: str = "text") -> Progress:
    """Lines of the process that starts the others, beside whose progress there can be no panel."""
    return JsonLines(console, "launcher") if log_format == "json" else PlainLines(console)


class _Notices(logging.Handler):
    def __init__(self, progress: Progress) -> None:
        super().__init__(logging.WARNING)
        self._progress = progress

    def emit(self, record: logging.LogRecord) -> None:
        known = vars(logging.makeLogRecord({}))
        fields = {name: value for name, value in vars(record).items() if name not in known}
        self._progress.notice(record.getMessage(), record.levelname.lower(), **fields)


@contextmanager
def notices_from(logger_name: str, progress: Progress) -> Iterator[None]:
    """Show a logger's warnings as notices: written past a live panel they would be lost."""
    logger, handler = logging.getLogger(logger_name), _Notices(progress)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def print_line(console: Console, line: str) -> None:
    """One line as it is, however long."""
    console.print(line, soft_wrap=True, markup=False, highlight=False)


def _with_level(line: str, level: str) -> str:
    return line if level == "info" else f"{level}: {line}"


class PlainLines:
    """One line now and then: for log files, pipes and batch systems."""

    def __init__(self, console: Console, interval_s: float = LINE_S) -> None:
        self._console = console
        self._due = Every(interval_s, at_once=True)

    def show(self, status: Status) -> None:
        """Print the status if the last line is old enough."""
        if self._due.due():
            self.notice(status_line(status))

    def notice(self, line: str, level: str = "info", **_: Any) -> None:
        """Print one line."""
        print_line(self._console, _with_level(line, level))

    def close(self) -> None:
        """Nothing is left to do."""


class JsonLines:
    """One JSON object a line: for programs that collect logs."""

    def __init__(self, console: Console, who: str, interval_s: float = LINE_S) -> None:
        self._console, self._formatter = console, formatter("json", who)
        self._due = Every(interval_s, at_once=True)

    def show(self, status: Status) -> None:
        """Write the status if the last one is old enough."""
        if self._due.due():
            self.notice(status.activity, event="status", **asdict(status))

    def notice(self, line: str, level: str = "info", **fields: Any) -> None:
        """Write one line."""
        record = logging.makeLogRecord({"levelname": level.upper(), "msg": line} | fields)
        print_line(self._console, self._formatter.format(record))

    def close(self) -> None:
        """Nothing is left to do."""


class LivePanel:
    """A panel that is drawn again in place; notices scroll above it."""

    def __init__(self, console: Console, title: str, interval_s: float = PANEL_S) -> None:
        self._console, self._title = console, title
        self._due = Every(interval_s, at_once=True)
        self._last: Status | None = None
        self._live = Live(console=console, auto_refresh=False, transient=False)
        self._live.start()

    def show(self, status: Status) -> None:
        """Draw the panel if the last drawing is old enough."""
        self._last = status
        if self._due.due():
            self._draw(status)

    def notice(self, line: str, level: str = "info", **_: Any) -> None:
        """Print one line above the panel."""
        print_line(self._console, _with_level(line, level))

    def close(self) -> None:
        """Leave the last status and go below it."""
        if self._last is not None:
            self._draw(self._last)
        self._live.stop()

    def _draw(self, status: Status) -> None:
        self._live.update(status_panel(status, self._title), refresh=True)


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
    row.add_row(bar, f"{status.share:4.0%}  {duration(status.elapsed_s)}{left_text(status)}")
    return row


def _score(scores: Mapping[str, float], name: str, pattern: str) -> str:
    return pattern.format(scores[name]) if name in scores else "-"
