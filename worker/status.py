"""tangram-status: asks a master for the status of its run, from any machine a worker may use."""

import json
import math
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import zmq
from rich.console import Console
from rich.table import Table
from rich.text import Text

from tangram_core.errors import TangramError, WireError
from tangram_core.run.code import argument, code_of
from tangram_core.run.outcome import FILE_NAME, duration, outcome_rows, read_outcome
from tangram_core.scores import read, told
from tangram_core.store.stored import CONFIG
from tangram_core.wire.messages import (
    OPEN,
    WORKER_COLUMNS,
    AskStatus,
    RunStatus,
    decode_from_master,
)
from worker.config import StatusConfig
from worker.talk.connection import Sockets
from worker.talk.discovery import find_master, host_error, keys_error

PATIENCE_S = 10.0
ASK_AGAIN_S = 1.0
MINUTE_S = 60.0
UNKNOWN = -1.0
TABLE_COLUMNS = ("process", "heard of", "weights", "batches", "episodes", "waiting")
REFUSED = {
    "refused_keys": ("refused keys", "with no key for this run and role: see audit.jsonl"),
    "refused_handshakes": ("ended handshakes", "connections that showed no key"),
}


def show_status(config: StatusConfig) -> int:
    """Print the status of a run, or its result if it has finished; return exit status 0.

    Raises:
        TangramError: there is neither a connection file nor a result, the keys are wrong, or the
            master does not answer.
    """
    console, result = Console(), Path(config.connect) / FILE_NAME
    if result.is_file() and find_master(config.connect) is None:
        _print_result(console, read_outcome(result), config)
        return 0
    with zmq.Context() as context:
        status = ask_status(config.connect, context)
    if config.json:
        console.print(json.dumps(_plain(status)), soft_wrap=True, highlight=False)
    else:
        _print(console, status, config.connect)
    return 0


def _print_result(console: Console, result: Mapping[str, Any], config: StatusConfig) -> None:
    if config.json:
        console.print(json.dumps(result), soft_wrap=True, highlight=False)
        return
    console.print(f"run {Path(config.connect).name} has ended", highlight=False, markup=False)
    _print_rows(console, outcome_rows(result))


def ask_status(
    connect: str, context: "zmq.Context[zmq.Socket[bytes]]", patience_s: float = PATIENCE_S
) -> RunStatus:
    """The status of a run; RunError if `connect` is no address, TangramError without an answer."""
    address = find_master(connect)
    if address is None:
        raise TangramError(f"no connection file at {connect}: {_nobody(Path(connect))}")
    unknown_host = host_error(address.endpoint, connect)
    if unknown_host:
        raise TangramError(unknown_host)
    sockets = Sockets(context, address)
    try:
        until_s, ask_s = time.monotonic() + patience_s, 0.0
        while time.monotonic() < until_s:
            if time.monotonic() >= ask_s:
                sockets.send(AskStatus().encode())
                ask_s = time.monotonic() + ASK_AGAIN_S
            sockets.wait(0.1)
            if sockets.handshake_failed():
                raise TangramError(keys_error(connect, address.endpoint))
            for frames in sockets.messages():
                status = _read(frames)
                if status is not None:
                    return status
    finally:
        sockets.close()
    raise TangramError(
        f"the master at {address.endpoint} has not answered for {patience_s:g} s: is it still "
        "running?"
    )


def _nobody(connect: Path) -> str:
    """Why there is no connection file: a master writes its config first, when it starts."""
    config = (connect.parent if connect.suffix == ".json" else connect) / CONFIG
    if not config.is_file():
        return "correct connect, or start a master"
    ago = duration(max(0.0, time.time() - config.stat().st_mtime))
    return f"its master was started {ago} ago and is still starting, or failed to: ask again"


def _read(frames: list[bytes]) -> RunStatus | None:
    try:
        message = decode_from_master(frames, None)
    except WireError as error:
        raise TangramError(f"the answer of the master cannot be decoded: {error}") from None
    return message if isinstance(message, RunStatus) else None


def _plain(status: RunStatus) -> dict[str, Any]:
    rows = [dict(zip(WORKER_COLUMNS, row, strict=True)) for row in status.workers.tolist()]
    texts = {name: text for name, text in status.texts.items() if name != "scores"}
    return {**texts, **status.numbers, "workers": rows}


def _print(console: Console, status: RunStatus, connect: str) -> None:
    texts = status.texts
    head = f"run {texts.get('run', '?')} ({texts.get('run_id', '?')})"
    console.print(head, highlight=False, markup=False)
    numbers = defaultdict(lambda: UNKNOWN, status.numbers)
    _print_rows(console, [*_lines(numbers, texts), *_scores(status)])
    if len(status.workers):
        console.print(_table(status))
    if status.numbers.get("evaluators") == 0:  # on one line, so that it can be copied
        said = f"no evaluator yet (tangram-train starts its own): {_evaluator(connect)}"
        console.print(said, soft_wrap=True, markup=False, highlight=False)


def _evaluator(connect: str) -> str:
    """The command that starts an evaluator, or why this connection file cannot start one."""
    address = find_master(connect)
    if address is not None and address.keys and "evaluator" not in address.keys:
        return f"{connect} has no key for one; make it with tangram-keys (add=NAME role=evaluator)"
    own = {} if address is None else code_of(address.settings or {})
    given = [
        argument("connect", connect),
        "role=evaluator",
        *(argument(*one) for one in own.items()),
    ]
    return " ".join(["tangram-worker", *given])


def _print_rows(console: Console, rows: Iterable[tuple[str, str]]) -> None:
    grid = Table.grid(padding=(0, 3))
    for name, text in rows:
        grid.add_row(Text(name), Text(text))
    console.print(grid, highlight=False)


def _scores(status: RunStatus) -> Iterator[tuple[str, str]]:
    n = status.numbers
    if "play/reward" in n:
        yield "players' reward", f"{n['play/reward']:.3f}, with exploration"
    found = told(read(status.texts.get("scores", "")), n, "test/")
    if found:
        yield "last test", found


def _lines(n: Mapping[str, float], texts: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """The rows above the table of workers: name and text."""
    yield "does", texts.get("activity", "?")
    yield "episodes", f"{n['episodes']:,.0f}, {n['transitions_per_s']:,.1f} transitions/s"
    due = f"{n['lag_updates']:,.0f} due"
    yield "updates", f"{n['updates']:,.0f}, {n['updates_per_s']:,.1f}/s, {due}"
    if n["could_play"] > 0 and n["could_learn"] > 0:
        yield "balance", _balance(n["could_play"], n["could_learn"], n["players"])
    yield "time", _time(n["elapsed_s"], n["left_s"], n["share"])
    share = n["replay"] / max(n["replay_capacity"], 1.0)
    yield "replay", f"{n['replay']:,.0f} transitions, {share:.0%} of its capacity"
    yield "waiting batches", f"{n['queue']:,.0f}"
    yield "last checkpoint", _age(n["checkpoint_age_s"])
    if n["open_to_all"] > 0:
        yield "access", OPEN
    if n["disk_failing"] > 0:
        yield "disk", "full, broken or gone: nothing is acknowledged"
    for name, (row, who) in REFUSED.items():
        if n[f"hub/{name}"] > 0:
            yield row, f"{n[f'hub/{name}']:,.0f} {who}"
    if n["undone_updates"] > 0:
        yield "undone updates", f"{n['undone_updates']:,.0f} were not finite"


def _balance(play: float, learn: float, players: float) -> str:
    """Whether workers or the learner wait, and how many workers would be enough."""
    waits = "workers wait" if play > learn else "the learner waits"
    text = f"{waits}: {play:,.0f} transitions/s can be played, {learn:,.0f} learned from"
    enough = max(1, math.ceil(players * learn / play))
    return f"{text}; {enough:,} worker{'s' if enough > 1 else ''} would do"


def _time(elapsed_s: float, left_s: float, share: float) -> str:
    text = f"{elapsed_s / MINUTE_S:,.1f} min"
    if share >= 0:
        text += f", {share:.0%} done"
    return text + (f", {left_s / MINUTE_S:,.1f} min left" if left_s >= 0 else "")


def _age(seconds: float) -> str:
    return "none since the master started" if seconds < 0 else f"{seconds / MINUTE_S:,.1f} min ago"


def _table(status: RunStatus) -> Table:
    table = Table(box=None, padding=(0, 2))
    for name in TABLE_COLUMNS:
        table.add_column(name, justify="left" if name == "process" else "right")
    for row in status.workers.tolist():
        table.add_row(*_worker_row(row))
    return table


def _worker_row(row: Sequence[float]) -> tuple[str, ...]:
    one = dict(zip(WORKER_COLUMNS, row, strict=True))
    return (
        f"{'evaluator' if one['evaluator'] else 'worker'} {one['index']:.0f}",
        f"{one['silent_s']:.1f} s ago",
        "-" if one["behind"] < 0 else f"{one['behind']:,.0f} behind",
        f"{one['batches']:,.0f}",
        f"{one['episodes']:,.0f}",
        f"{one['waiting']:,.0f}",
    )
