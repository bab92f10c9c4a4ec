"""What the page shows of a run: its files, and its master where one answers.

All of it is distrusted: a folder may be anybody's, and is read by fixed names and in bounds.
"""

import json
import math
import stat
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from itertools import islice
from os import scandir, stat_result
from pathlib import Path
from typing import Any, NamedTuple

from tangram_agent.messages import RunStatus
from tangram_agent.outcome import CTRL_C, duration, outcome_rows, plural, read_outcome
from tangram_agent.outcome import FILE_NAME as RESULT
from tangram_agent.runs import CONFIG, read_config
from tangram_agent.setup import from_mapping
from tangram_sim.config import SimConfig
from tangram_sim.errors import ConfigError, RunError, TangramError
from worker.discovery import FILE_NAME as CONNECTION
from worker.discovery import MasterAddress, as_address, find_master
from worker.status import TABLE_COLUMNS, ask_alone, status_rows, worker_rows

CURVE, PICTURE = "curve.jsonl", "test_episodes.png"
FILES = (CONFIG, CURVE, RESULT, CONNECTION)
PATIENCE_S = 2.0
MAX_POINTS = 500
MAX_CURVE, MAX_PICTURE, MAX_SETTINGS = 20 * 10**6, 20 * 10**6, 10**6  # bytes
MAX_LINE, MAX_LINES = 10**5, 10**5  # bytes of one, a master's has some 700; and how many
MAX_VALUE = 1e12
MAX_WORKERS = 200
MAX_ENTRIES = 2000  # that are looked at in one folder
MAX_NAME, MAX_TOLD = 4096, 600  # characters
PNG = b"\x89PNG\r\n\x1a\n"
POINT = ("updates", "train_s", "mean_reward")
OF_SEVERAL = ("coverage", "share_solved")  # scores of several tokens
NAMES = f"name a run folder, its {CONNECTION}, or host:port of a master"
# What other commands say to whoever typed connect=...
ON_A_PAGE = (
    ("connect=... takes", "name"),
    (" in connect=", ""),
    ("connect=RUN_DIR", "RUN_DIR"),
)


class Curve(NamedTuple):
    """What `curve.jsonl` holds.

    Attributes:
        points: of test scores, thinned to MAX_POINTS, the last one kept.
        told: what was left out, in words.
    """

    points: list[dict[str, float]]
    told: list[str]


class Place(NamedTuple):
    """Where a run is.

    Attributes:
        connect: what its master is found by.
        folder: of the run; None where only its master is known.
    """

    connect: str
    folder: Path | None


class Master(NamedTuple):
    """What a master said.

    Attributes:
        address: where it listens, None where there is no connection file.
        status: its answer, None where it gave none.
        silent: why it gave none.
    """

    address: MasterAddress | None
    status: RunStatus | None
    silent: str


def view(source: str) -> dict[str, Any]:
    """How a run stands, as JSON values.

    Args:
        source: a run folder, a connection file, or host:port of a master.

    Raises:
        RunError: it names no run, in one line for the page.
    """
    with _plainly(source):
        place = _find(source)
        master = _ask(place)
        return _view(source, place, master)


def episodes_picture(source: str) -> bytes:
    """The picture of a run's newest test episodes, a PNG.

    Raises:
        RunError: it names no run folder, or the folder holds no such picture.
    """
    with _plainly(source):
        folder = _find(source).folder
        if folder is None:
            raise RunError("a master sends no pictures: name its run folder")
        path = folder / PICTURE
        if _file(path, MAX_PICTURE) is None:
            raise RunError(f"{folder} has no {PICTURE} yet: a master draws it twice a minute")
        data = _read(path, MAX_PICTURE)
        if not data.startswith(PNG):
            raise RunError(f"{path} is no PNG: delete it, or name another run")
        return data


def recent_runs(folder: Path, limit: int = 30) -> list[str]:
    """Run folders below a folder, at most two levels deep, the newest first, as a person types."""
    found = list[tuple[float, str]]()
    for one in _within(folder):
        within = [one] if _is_run(one) else [deeper for deeper in _within(one) if _is_run(deeper)]
        found += [(_newest(run), str(run)) for run in within]
    typed = [(at, name) for at, name in found if name.isprintable()]
    return [name for _, name in sorted(typed, reverse=True)[:limit]]


# Where it is


@contextmanager
def _plainly(source: str) -> Iterator[None]:
    """Have every error say what is wrong, in one line for the page."""
    try:
        yield
    except TangramError as error:
        raise RunError(_line(str(error))) from None
    except OSError as error:
        raise RunError(_line(f"cannot read {source} ({error.strerror}): {NAMES}")) from None


def _line(text: str) -> str:
    for ours, page in ON_A_PAGE:
        text = text.replace(ours, page)
    shown = "".join(letter if letter.isprintable() else "?" for letter in text)
    return shown if len(shown) <= MAX_TOLD else f"{shown[: MAX_TOLD // 2]} … {shown[-250:]}"


def _find(source: str) -> Place:
    name = source.strip()
    if not name:
        raise RunError(f"no run is named: {NAMES}")
    if len(name) > MAX_NAME or "\0" in name or any("\ud800" <= one <= "\udfff" for one in name):
        raise RunError(f"'{name[:80]}' cannot be the name of a file: {NAMES}")
    if as_address(name) is not None:
        return Place(name, None)
    try:
        path = Path(name).expanduser()
    except RuntimeError:
        raise RunError(f"{name} is in the home of nobody who is known here: {NAMES}") from None
    if path.name == CONNECTION and _holds(path.parent, CONFIG, CURVE):
        path = path.parent  # also when the master has ended and its file is gone
    if path.is_dir():
        if not _holds(path, *FILES):
            raise RunError(f"{name} is no run folder, it has none of {', '.join(FILES)}: {NAMES}")
        return Place(str(path), path)
    if _file(path, MAX_SETTINGS) is None:
        raise RunError(f"there is no {name}: {NAMES}")
    find_master(str(path))  # refuses any other file
    return Place(str(path), None)


def _holds(folder: Path, *names: str) -> bool:
    return any((folder / name).is_file() for name in names)


def _file(path: Path, most: int) -> stat_result | None:
    """A file to be read; None where there is none.

    Raises:
        RunError: it is none that can be read, or larger than this many bytes.
    """
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    if not stat.S_ISREG(found.st_mode):
        raise RunError(f"{path} is no file: delete it, or name another run")
    if found.st_size > most:
        raise RunError(f"{path} has more than {most // 10**6} MB: it is not what a master writes")
    return found


def _read(path: Path, most: int) -> bytes:
    """The end of a file, so many bytes at most."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - most))
        return file.read(most)


def _within(folder: Path) -> list[Path]:
    """What is in a folder; nothing where it is none that can be read."""
    try:
        with scandir(folder) as entries:
            return [Path(one) for one in islice(entries, MAX_ENTRIES)]
    except OSError:
        return []


def _is_run(folder: Path) -> bool:
    try:
        return _holds(folder, CONFIG) and _holds(folder, CURVE, CONNECTION)
    except OSError:
        return False


def _newest(run: Path) -> float:
    """When a score or the settings of a run were written."""
    times = [0.0]
    for name in FILES:
        try:
            times.append((run / name).stat().st_mtime)
        except OSError:
            continue
    return max(times)


# What its master says


def _ask(place: Place) -> Master:
    address, silent = None, ""
    try:
        if place.folder is not None:
            _file(place.folder / CONNECTION, MAX_SETTINGS)  # no pipe, which would hold us
        address = find_master(place.connect)
        status = ask_alone(place.connect, PATIENCE_S)
        run_id = status.texts.get("run_id", "")
        if address is None or address.run_id in ("", run_id):
            return Master(address, status, "")
        silent = f"what answers at {address.endpoint} is another run's master: name its folder"
    except TangramError as error:
        silent = str(error)
    return Master(address, None, silent)


# What is shown


class Shown(NamedTuple):
    """What depends on whether a master answers.

    Attributes:
        name: of the run.
        state: training, waiting, ended or stopped.
        told: sentences.
        rows: names and texts.
        points: of the curve.
        updates: that were done.
    """

    name: str
    state: str
    told: list[str]
    rows: list[tuple[str, str]]
    points: list[dict[str, float]]
    updates: float


def _view(source: str, place: Place, master: Master) -> dict[str, Any]:
    folder, status = place.folder, master.status
    curve = Curve([], []) if folder is None else _curve_of(folder / CURVE)
    if status is not None:
        shown = _live(status, None if folder is None else curve.points)
    elif folder is not None:
        shown = _silent(folder, curve.points, master.silent)
    else:
        raise RunError(master.silent)
    stage, odd = _stage(folder, master.address, int(shown.updates))
    picture, wrong = _picture(folder)
    share = -1.0 if status is None else status.numbers.get("share", -1.0)
    workers = [] if status is None else worker_rows(status)
    rows = [*shown.rows, *_of_several(shown.points)]
    return {
        "source": source,
        "name": _line(shown.name),
        "folder": None if folder is None else str(folder),
        "state": shown.state,
        "activity": "" if status is None else status.texts.get("activity", ""),
        "told": [_line(one) for one in (*shown.told, *curve.told, *odd, *wrong)],
        "share": share if 0 <= share <= 1 else None,
        "rows": [(name, _line(text)) for name, text in rows],
        "workers": {
            "columns": TABLE_COLUMNS,
            "rows": workers[:MAX_WORKERS],
            "more": len(workers[MAX_WORKERS:]),
        },
        "curve": shown.points,
        "stage": stage,
        "episodes": picture,
    }


def _live(status: RunStatus, points: list[dict[str, float]] | None) -> Shown:
    """Of a run whose master answers; without points where only that is known."""
    activity, numbers = status.texts.get("activity", ""), status.numbers
    told = [f"The master answers: {activity}."]
    if numbers.get("evaluators") == 0:
        told.append("No evaluator takes part: there are no new scores.")
    if points is None:
        told.append("Only its master is known, so the curve begins where you began to watch.")
        points = _told_point(numbers)
    state = "training" if activity.startswith("learning") else "waiting"
    updates = numbers.get("updates", 0.0)
    return Shown(status.texts.get("run", "?"), state, told, status_rows(status), points, updates)


def _silent(folder: Path, points: list[dict[str, float]], why: str) -> Shown:
    """Of a run whose master does not answer, or has ended."""
    name, last = folder.absolute().name, points[-1] if points else None
    updates = last["updates"] if last else 0
    if found := _file(folder / RESULT, MAX_SETTINGS):
        result = read_outcome(folder / RESULT)
        ended_by = CTRL_C.get(result["ended_by"], result["ended_by"])
        told = [f"The run has ended, by {ended_by}, on {_moment(found.st_mtime)}."]
        if (folder / CONNECTION).is_file():
            told.append(f"Later it went on, and no master answers ({why}).")
        return Shown(name, "ended", told, outcome_rows(result), points, updates)
    told, rows = [f"No master answers, and the run has no result ({why})."], []
    if last:
        ago = duration(max(0.0, time.time() - (folder / CURVE).stat().st_mtime))
        told.append(f"It was killed, or cannot be reached; its last score came {ago} ago.")
        reward, after = f"mean reward {last['mean_reward']:.3f}", plural(updates, "update")
        rows = [("last test", f"{reward} after {after}"), ("time", duration(last["train_s"]))]
    return Shown(name, "stopped", told, rows, points, updates)


def _moment(at_s: float) -> str:
    return time.strftime("%Y-%m-%d at %H:%M", time.localtime(at_s))


def _of_several(points: list[dict[str, float]]) -> list[tuple[str, str]]:
    last = points[-1] if points else {}
    covered, solved = (last.get(name) for name in OF_SEVERAL)
    rows = [] if covered is None else [("covered", f"{covered:.1%} of the target, last test")]
    return rows if solved is None else [*rows, ("solved", f"{solved:.0%} of test episodes")]


def _told_point(n: Mapping[str, float]) -> list[dict[str, float]]:
    """The newest scores that a master has told, as a curve of one point."""
    if n.get("scored_updates", -1.0) < 0 or "test/mean_reward" not in n:
        return []
    several = {name: n[f"test/{name}"] for name in OF_SEVERAL if f"test/{name}" in n}
    values = (n["scored_updates"], n.get("train_s", 0.0), n["test/mean_reward"])
    return [dict(zip(POINT, values, strict=True)) | several]


def _stage(
    folder: Path | None, address: MasterAddress | None, updates: int
) -> tuple[dict[str, Any] | None, list[str]]:
    """The stage of the curriculum; None where there is none; and what is wrong with it."""
    try:
        sim = _sim(folder, address)
    except TangramError as error:
        return None, [f"Its settings cannot be read: {error}"]
    if sim is None or not sim.stages:
        return None, []
    number = sim.stage(updates)
    after = sim.stages[number : number + 1]
    then = f"{sim.told(number + 1)}, from update {after[0].updates:,} on" if after else ""
    return {"number": number, "of": len(sim.stages), "told": sim.told(number), "then": then}, []


def _sim(folder: Path | None, address: MasterAddress | None) -> SimConfig | None:
    if folder is not None:
        found = _file(folder / CONFIG, MAX_SETTINGS)
        return found and _sim_of((folder / CONFIG).absolute(), found.st_mtime_ns, found.st_size)
    return _checked_sim(address.settings) if address and address.settings else None


@lru_cache(maxsize=8)
def _sim_of(path: Path, _mtime_ns: int, _size: int) -> SimConfig:
    """As the file was then: a page asks every two seconds."""
    return _checked_sim(read_config(path))


def _checked_sim(settings: Mapping[str, Any]) -> SimConfig:
    if not isinstance(settings.get("sim"), Mapping):
        raise ConfigError("they have no section sim")
    return from_mapping(SimConfig, settings["sim"])


def _picture(folder: Path | None) -> tuple[dict[str, float] | None, list[str]]:
    """When the newest picture was drawn; None where there is none; and what is wrong with it."""
    try:
        found = _file(folder / PICTURE, MAX_PICTURE) if folder else None
    except RunError as error:
        return None, [str(error)]
    return (None if found is None else {"at": round(found.st_mtime, 3)}), []


# The curve


def _curve_of(path: Path) -> Curve:
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return Curve([], [])
    if not stat.S_ISREG(found.st_mode):
        return Curve([], [f"{CURVE} is no file."])
    return _curve(path.absolute(), found.st_mtime_ns, found.st_size)


@lru_cache(maxsize=8)
def _curve(path: Path, _mtime_ns: int, size: int) -> Curve:
    """As the file was then: a page asks every two seconds."""
    *lines, last = _read(path, MAX_CURVE).rsplit(b"\n", MAX_LINES)
    told = list[str]()
    if size > MAX_CURVE or len(lines) == MAX_LINES:
        lines = lines[1:]  # the first one is cut
        told.append(f"{CURVE} is larger than any master writes it: its newest part is shown.")
    read = [_point(line) for line in lines if line.strip()]
    points = [point for point in read if point is not None]
    if unread := len(read) - len(points):
        told.append(f"{plural(unread, 'line')} of {CURVE} could not be read and left out.")
    # A master may just be writing the last line.
    if (newest := _point(last)) is not None:
        points.append(newest)
    return Curve(_thinned(points), told)


def _point(line: bytes) -> dict[str, float] | None:
    """The scores in a line; None where it has none that can be drawn."""
    if len(line) > MAX_LINE:
        return None
    try:
        found = json.loads(line.decode())
        values = {name: _number(found[name]) for name in (*POINT, *OF_SEVERAL) if name in found}
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return None
    whole = values.keys() >= set(POINT)
    return values if whole and min(values["updates"], values["train_s"]) >= 0 else None


def _number(value: Any) -> float:
    if isinstance(value, bool) or not math.isfinite(value) or abs(value) > MAX_VALUE:
        raise ValueError("no number to draw")
    return value if isinstance(value, int) else float(value)


def _thinned(points: list[dict[str, float]]) -> list[dict[str, float]]:
    """Evenly, with the first and the last."""
    step = max(1.0, (len(points) - 1) / (MAX_POINTS - 1))
    count = min(len(points), MAX_POINTS)
    return [points[min(round(i * step), len(points) - 1)] for i in range(count)]
