"""The curves of a run, for TensorBoard and in `curve.jsonl`.

The x axis of the curves is the number of updates. TensorBoard lists all of them as one run;
docs/tensorboard.md explains every tag. `curve.jsonl` has the evaluations as JSON lines, for plots
without TensorBoard, or against episodes or seconds.
"""

import json
import logging
import math
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from tangram_core.arrays import Pixels
from tangram_core.errors import RunError
from tangram_core.run.process import Every
from tangram_core.scores import SHOWN, read
from tangram_core.store.files import make_folders, write_whole

FLUSH_S = 30
RETRY_S = 60.0
POINT = ("updates", "episodes", "train_s")  # x values of an evaluation
POINTS = 2000  # about as many points are added each time the run's age grows by a factor of e
HPARAMS = ("seed", "updates", "episodes", "workers", "train_s")  # besides facts on task and agent

log = logging.getLogger(__name__)


class Means:
    """Means of named values since the last `take`."""

    def __init__(self) -> None:
        self._sums: defaultdict[str, float] = defaultdict(float)
        self._counts: defaultdict[str, int] = defaultdict(int)

    def add(self, values: Mapping[str, float], count: int = 1) -> None:
        """Add values that are each the mean of `count` cases."""
        for name, value in values.items():
            self._sums[name] += value * count
            self._counts[name] += count

    def take(self) -> dict[str, float]:
        """Return the means and start again from nothing."""
        means = {name: total / self._counts[name] for name, total in self._sums.items()}
        self._sums.clear()
        self._counts.clear()
        return means


class Thinning:
    """Selects points of a curve, ever more rarely, so that a long run does not fill the disk."""

    def __init__(self, age_s: float, points: int = POINTS) -> None:
        """Start at this age of the run; it gets `points` points each time its age grows e-fold."""
        self._points, self._begun_s, self._last_s = points, time.monotonic() - age_s, -math.inf

    def due(self) -> bool:
        """Whether to write a point now; counts as written."""
        now_s = time.monotonic()
        if now_s - self._last_s < (now_s - self._begun_s) / self._points:
            return False
        self._last_s = now_s
        return True


class Metrics:
    """Writes the curves of one run for TensorBoard, and evaluations to curve.jsonl, too.

    If the disk fails, points are missing and a warning is logged, but the run goes on. A resumed
    run starts at the checkpoint's `updates` and repeats what came after. So older points beyond
    `updates` are hidden or deleted. A file with wrong content in the way is renamed.
    """

    def __init__(self, folder: Path, curve: Path, updates: int = 0, age_s: float = 0.0) -> None:
        self._folder, self._curve, self._evaluated = folder, curve, Thinning(age_s)
        self._hook, threading.excepthook = threading.excepthook, self._thread_failed
        if folder.exists() and not folder.is_dir():
            _set_aside(folder)
        if curve.exists():
            self._keep(updates)
        self._broken = False
        self._again = Every(RETRY_S)
        self._open(updates + 1 if updates else None)

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """Write a point of several curves at one step."""

        def write() -> None:
            for name, value in values.items():
                self._writer.add_scalar(name, value, step)

        self._try(write)

    def scores(
        self, scores: Mapping[str, float], updates: int, episodes: int, seconds: float
    ) -> None:
        """Write the scores of weights after so many updates, episodes and seconds of training."""
        if not self._evaluated.due():
            return
        self.scalars({f"test/{name}": value for name, value in scores.items()}, updates)
        line = {"updates": updates, "episodes": episodes, "train_s": round(seconds, 3), **scores}
        try:
            with self._curve.open("a", encoding="utf-8") as file:
                file.write(_text(line))
        except OSError as error:
            why = error.strerror
            log.warning("%s cannot be written (%s): a score is missing", self._curve, why)

    def picture(self, pixels: Pixels, updates: int) -> None:
        """Write the picture (height, width, 3) of the test episodes after `updates` updates."""
        content = np.asarray(pixels)
        self._try(
            lambda: self._writer.add_image("test/pictures", content, updates, dataformats="HWC")
        )

    def settings(self, resolved: Mapping[str, Any]) -> None:
        """Write the whole config as text."""
        text = yaml.safe_dump(dict(resolved), sort_keys=False)
        indented = "".join(f"    {line}\n" for line in text.splitlines())
        self._try(lambda: self._writer.add_text("config", indented))

    def hyperparameters(self, result: Mapping[str, Any], facts: Collection[str]) -> None:
        """Write the values and scores with which TensorBoard's HPARAMS tab compares runs.

        `facts` are the names of the facts about task and agent in `result`.
        """
        values = {name: _plain(result[name]) for name in (*HPARAMS, *facts)}
        tags = {f"test/{score.name}": 0.0 for score in read(result["scores"])[:SHOWN]}

        def write() -> None:
            # The writer's own add_hparams makes another run in TensorBoard's list.
            writer: Any = self._writer.file_writer
            for summary in hparams(values, tags):  # type: ignore[no-untyped-call]
                writer.add_summary(summary)

        self._try(write)

    def close(self) -> None:
        """Write what is buffered and close the files."""
        self._try(self._writer.close)
        threading.excepthook = self._hook

    def _thread_failed(self, failure: threading.ExceptHookArgs) -> None:
        """Ignore disk errors in TensorBoard's thread: the next write here reports them."""
        ours = type(failure.thread).__module__.startswith("tensorboard.")
        if not (ours and isinstance(failure.exc_value, OSError)):
            self._hook(failure)

    def _open(self, purge: int | None) -> None:
        make_folders(self._folder, above=False)  # do not make a run folder again that was deleted
        self._writer = SummaryWriter(str(self._folder), purge_step=purge, flush_secs=FLUSH_S)

    def _keep(self, updates: int) -> None:
        """Delete evaluations after `updates`, and damaged lines, from curve.jsonl."""
        try:
            before = self._curve.read_bytes()
            kept = [line for line in _lines(before) if line["updates"] <= updates]
            after = "".join(map(_text, kept)).encode()
            if after != before:
                write_whole(self._curve, after, above=False)
        except (OSError, RunError):
            _set_aside(self._curve)

    def _try(self, write: Callable[[], object]) -> None:
        """Call `write`, unless the disk failed less than `RETRY_S` ago."""
        if self._broken and not self._again.due():
            return
        try:
            if self._broken:
                self._open(None)
                self._broken = False
            write()
        except OSError as error:
            if not self._broken:
                log.warning("curves cannot be written (%s): points are missing", error.strerror)
                with suppress(OSError):
                    self._writer.close()
            self._broken, self._again = True, Every(RETRY_S)


def _plain(value: Any) -> float | str:
    """A value as the HPARAMS tab accepts it: a number or text."""
    return value if isinstance(value, int | float | str) else "+".join(map(str, value))


def _text(line: Mapping[str, Any]) -> str:
    return json.dumps(line) + "\n"


def _set_aside(path: Path) -> None:
    """Rename a file or folder that is in the way; if that fails, too, points are missing."""
    try:
        aside = path.rename(path.with_name(f"{path.name}.{time.time():.0f}.aside"))
        log.warning("%s was not a readable curve: it was renamed to %s", path, aside.name)
    except OSError as error:
        log.warning("%s is in the way of curves (%s)", path, error.strerror)


def _lines(data: bytes) -> list[dict[str, Any]]:
    """The evaluations of an earlier process, without lines that are damaged or cut short."""
    found = []
    for text in data.splitlines():
        try:
            line = json.loads(text)
        except (ValueError, RecursionError):
            continue
        if isinstance(line, dict) and all(isinstance(line.get(n), int | float) for n in POINT):
            found.append(line)
    return found
