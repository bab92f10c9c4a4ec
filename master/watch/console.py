"""Progress of a run for the user: a live panel on a terminal, plain log lines elsewhere.

If the terminal is closed, the console drops its output instead of failing. Lines come through
`logging`; with service.log_format=json each is one JSON object for programs.
"""

import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TextIO, TypeAlias, cast

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from tangram_core.run.outcome import duration, plural
from tangram_core.run.process import Every, formatter
from tangram_core.scores import read, told
from tangram_core.wire.messages import OPEN, RunStatus

PANEL_S = 0.5
LINE_S = 10.0
LINE = 3  # number of scores in a log line
PANEL_WIDTH = 76
TEST = "test/"  # prefix of the names of scores
PLAYED = "play/reward"  # mean reward of recent episodes of the players, with exploration

log = logging.getLogger(__name__)


class _Sturdy:
    """A text file that drops what cannot be written, and replaces unknown characters.

    A closed terminal or pipe, or a full disk, must not end the run, and not disturb its clean end.
    """

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def write(self, text: str) -> int:
        try:
            return self._file.write(text)
        except UnicodeEncodeError:  # the terminal has fewer characters, as with LC_ALL=C
            known = text.encode(self._file.encoding, "replace")
            return self._file.write(known.decode(self._file.encoding))
        except OSError:
            return self._drop(text)

    def flush(self) -> None:
        try:
            self._file.flush()
        except OSError:
            self._drop("")

    def _drop(self, text: str) -> int:
        own, null = self._file.fileno(), os.open(os.devnull, os.O_WRONLY)
        before = os.dup(own)
        os.dup2(null, own)
        self._file.flush()  # the buffer, too; a disk that is full now may take what comes later
        os.dup2(before, own)
        for one in (before, null):
            os.close(one)
        return len(text)


def sturdy_console(file: TextIO) -> Console:
    """A console on stdout or stderr that drops its output instead of failing."""
    return Console(file=cast(TextIO, _Sturdy(file)))


# Log lines


class _TextFormatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        line = record.getMessage()
        return line if record.levelno <= logging.INFO else f"{record.levelname.lower()}: {line}"


class _ConsoleHandler(logging.Handler):
    """Prints log lines without wrapping, above a live panel if the console has one."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        self._console.print(self.format(record), soft_wrap=True, markup=False, highlight=False)


@contextmanager
def logging_to(console: Console, log_format: str = "text", who: str = "master") -> Iterator[None]:
    """A context that shows the log lines of package master on a console.

    Args:
        console: takes the lines.
        log_format: `text`, or `json` for one object per line.
        who: name of the process, for `json`.
    """
    logger, handler = logging.getLogger("master"), _ConsoleHandler(console)
    handler.setFormatter(_TextFormatter() if log_format == "text" else formatter(log_format, who))
    before = logger.level
    logger.setLevel(logging.INFO)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


# The state of the run


def make_progress(
    console: Console, title: str, log_format: str = "text", evaluator: str = ""
) -> "Progress":
    """A live panel if the console is a terminal and log_format is text, else log lines.

    While no evaluator takes part, the panel shows `evaluator`, a command that starts one.
    """
    if console.is_terminal and log_format == "text":
        return LivePanel(console, title, evaluator)
    return StatusLines()


class StatusLines:
    """Shows the status as one log line at intervals, for log files, pipes and batch systems."""

    def __init__(self, interval_s: float = LINE_S) -> None:
        self._due = Every(interval_s, at_once=True)

    def show(self, status: RunStatus) -> None:
        """Log the status if a line is due; a JSON line has all numbers of the status, too."""
        if self._due.due():
            fields = {"event": "status", **status.texts, **status.numbers}
            log.info("%s", status_line(status), extra=fields)

    def close(self) -> None:
        """Do nothing."""


class LivePanel:
    """Shows the status in a panel that is updated in place; log lines scroll above it."""

    def __init__(
        self, console: Console, title: str, evaluator: str = "", interval_s: float = PANEL_S
    ) -> None:
        self._title, self._evaluator = title, evaluator
        self._due = Every(interval_s, at_once=True)
        self._last: RunStatus | None = None
        self._live = Live(console=console, auto_refresh=False, transient=False)
        self._live.start()

    def show(self, status: RunStatus) -> None:
        """Draw the panel if an update is due."""
        self._last = status
        if self._due.due():
            self._draw(status)

    def close(self) -> None:
        """Draw the last status and leave it on the screen."""
        if self._last is not None:
            self._draw(self._last)
        self._live.stop()

    def _draw(self, status: RunStatus) -> None:
        self._live.update(status_panel(status, self._title, self._evaluator), refresh=True)


Progress: TypeAlias = StatusLines | LivePanel


def status_line(status: RunStatus) -> str:
    """The status as one line of text."""
    n = status.numbers
    parts = [
        duration(n["elapsed_s"]),
        f"{n['share']:.0%}{_left(n)}" if n["share"] >= 0 else "",
        plural(n["episodes"], "episode"),
        plural(n["updates"], "update"),
        f"{n['transitions_per_s']:,.0f} transitions/s",
        f"{n['updates_per_s']:,.1f} updates/s",
        _scores(status),
        plural(n["players"], "worker"),
        status.texts["activity"],
        OPEN if n.get("open_to_all") else "",
    ]
    return " | ".join(part for part in parts if part)


def status_panel(status: RunStatus, title: str, evaluator: str = "") -> Panel:
    """The live panel with progress, rates, scores and the present activity."""
    n = status.numbers
    grid = Table.grid(padding=(0, 3), expand=True)
    for _ in range(2):
        grid.add_column(style="dim", no_wrap=True)
        grid.add_column(justify="right", no_wrap=True)
    grid.add_row("episodes", f"{n['episodes']:,.0f}", "updates", f"{n['updates']:,.0f}")
    rates = f"{n['transitions_per_s']:,.0f}", f"{n['updates_per_s']:,.1f}"
    grid.add_row("transitions/s", rates[0], "updates/s", rates[1])
    if PLAYED in n:
        grid.add_row("players' reward", f"{n[PLAYED]:.3f}", "with exploration", "")
    cells = _cells(status)
    for pair in zip(cells[::2], cells[1::2], strict=True):
        grid.add_row(*(cell for one in pair for cell in one))
    helpers = f"{plural(n['players'], 'worker')}, {plural(n['evaluators'], 'evaluator')}"
    text = f"{helpers} · {status.texts['activity']}"
    foot = Text(text, style="dim", no_wrap=True, overflow="ellipsis")
    body = Group(_bar(n), Text(), grid, Text(), foot)
    if n.get("open_to_all"):
        body.renderables.append(Text(OPEN, style="bold red"))
    if evaluator and not n["evaluators"]:
        body.renderables.append(Text(f"no evaluator: start one with {evaluator}", overflow="fold"))
    return Panel(body, title=title, title_align="left", width=PANEL_WIDTH, padding=(1, 2))


def _bar(n: Mapping[str, float]) -> Table:
    row = Table.grid(padding=(0, 2), expand=True)
    row.add_column(ratio=1)
    row.add_column(justify="right", no_wrap=True)
    if n["share"] < 0:
        row.add_row(Text("no bound: Ctrl-C ends the run", style="dim"), duration(n["elapsed_s"]))
        return row
    bar = ProgressBar(total=1.0, completed=n["share"], complete_style="cyan")
    row.add_row(bar, f"{n['share']:4.0%}  {duration(n['elapsed_s'])}{_left(n)}")
    return row


def _left(n: Mapping[str, float]) -> str:
    """The time left as text; empty if unknown."""
    return f", {duration(n['left_s'])} left" if n["left_s"] > 0 else ""


def _scores(status: RunStatus) -> str:
    """The most important scores as text; before the first evaluation, the players' reward."""
    n = status.numbers
    found = told(read(status.texts.get("scores", ""))[:LINE], n, TEST)
    return found or (f"players' reward {n[PLAYED]:.3f}" if PLAYED in n else "")


def _cells(status: RunStatus) -> list[tuple[str | Text, str | Text]]:
    """Label and value of each score, the first one highlighted, filled up to an even number."""
    cells = list[tuple[str | Text, str | Text]]()
    for score in read(status.texts.get("scores", "")):
        shown = score.shown(status.numbers.get(TEST + score.name))
        cells.append((Text(score.label), shown if cells else Text(shown, style="bold green")))
    return cells + [("", "")] * (len(cells) % 2)
