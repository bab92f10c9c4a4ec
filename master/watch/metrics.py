"""The curves of a run: TensorBoard, what is written, under which name, against what.

Curves are drawn against updates. Scores of the evaluator stand there three times: against updates
(`test`), against episodes (`test_by_episodes`) and against seconds of training (`test_by_seconds`).
All of it is one run in TensorBoard's list; docs/tensorboard.md explains every tag. For plots
without TensorBoard `curve.jsonl` has every evaluation, one JSON object a line.
"""

import json
import logging
import threading
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from tangram_core.arrays import Pixels
from tangram_core.run.process import Every
from tangram_core.scores import SHOWN, read
from tangram_core.store.files import make_folders, write_whole

FLUSH_S = 30
RETRY_S = 60.0
POINT = ("updates", "episodes", "train_s")  # where an evaluation stands
HPARAMS = ("seed", "updates", "episodes", "workers", "train_s")  # beside what tells task and agent

log = logging.getLogger(__name__)


class Means:
    """Means of named values since they were last taken."""

    def __init__(self) -> None:
        self._sums: defaultdict[str, float] = defaultdict(float)
        self._counts: defaultdict[str, int] = defaultdict(int)

    def add(self, values: Mapping[str, float], count: int = 1) -> None:
        """Add values that are each the mean of `count` cases."""
        for name, value in values.items():
            self._sums[name] += value * count
            self._counts[name] += count

    def take(self) -> dict[str, float]:
        """The means, and begin anew."""
        means = {name: total / self._counts[name] for name, total in self._sums.items()}
        self._sums.clear()
        self._counts.clear()
        return means


class Metrics:
    """Writes the curves of one run: to TensorBoard, and evaluations to curve.jsonl, too.

    What the disk does not take is left out, and told: curves are not worth a run. Points of an
    earlier process after the checkpoint that the run goes on from, with so many updates, are hidden
    or dropped, since they happen again.
    """

    def __init__(self, folder: Path, curve: Path, updates: int = 0) -> None:
        self._folder, self._curve = folder, curve
        self._hook, threading.excepthook = threading.excepthook, self._thread_failed
        kept = [line for line in _lines(curve) if line["updates"] <= updates]
        if curve.exists():
            write_whole(curve, "".join(map(_text, kept)).encode(), above=False)
        self._broken = False
        self._again = Every(RETRY_S)
        purge = updates + 1 if updates else None
        self._open(purge)
        # TensorBoard hides the points of every tag from that step on, and does not know that the
        # steps of some are episodes or seconds: those that stay are written again.
        for line in kept if purge else ():
            scores = {name: value for name, value in line.items() if name not in POINT}
            point = (line["episodes"], line["train_s"], updates + 1)
            self._try(partial(self._by_others, scores, *point))

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """Points of many curves at one step."""

        def write() -> None:
            for name, value in values.items():
                self._writer.add_scalar(name, value, step)

        self._try(write)

    def scores(
        self, scores: Mapping[str, float], updates: int, episodes: int, seconds: float
    ) -> None:
        """An evaluation of the weights after so many updates, episodes, seconds of training."""
        self.scalars({f"test/{name}": value for name, value in scores.items()}, updates)
        self._try(lambda: self._by_others(scores, episodes, seconds))
        line = {"updates": updates, "episodes": episodes, "train_s": round(seconds, 3), **scores}
        try:
            with self._curve.open("a", encoding="utf-8") as file:
                file.write(_text(line))
        except OSError as error:
            why = error.strerror
            log.warning("%s cannot be written (%s): a score is missing", self._curve, why)

    def picture(self, pixels: Pixels, updates: int) -> None:
        """The test episodes (height, width, 3) after so many updates."""
        content = np.asarray(pixels)
        self._try(
            lambda: self._writer.add_image("test/pictures", content, updates, dataformats="HWC")
        )

    def settings(self, resolved: Mapping[str, Any]) -> None:
        """The whole config as text."""
        text = yaml.safe_dump(dict(resolved), sort_keys=False)
        indented = "".join(f"    {line}\n" for line in text.splitlines())
        self._try(lambda: self._writer.add_text("config", indented))

    def hyperparameters(self, result: Mapping[str, Any], facts: Collection[str]) -> None:
        """What runs are compared by in the HPARAMS tab, and which curves end in their scores.

        `facts` are the names in result.json of what tells task and agent.
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
        """Write what is left."""
        self._try(self._writer.close)
        threading.excepthook = self._hook

    def _thread_failed(self, failure: threading.ExceptHookArgs) -> None:
        """TensorBoard's thread fails where the disk does, and its next write here tells it."""
        ours = type(failure.thread).__module__.startswith("tensorboard.")
        if not (ours and isinstance(failure.exc_value, OSError)):
            self._hook(failure)

    def _open(self, purge: int | None) -> None:
        make_folders(self._folder, above=False)  # a run folder that was deleted stays so
        self._writer = SummaryWriter(str(self._folder), purge_step=purge, flush_secs=FLUSH_S)

    def _by_others(
        self, scores: Mapping[str, float], episodes: int, seconds: float, least: int = 0
    ) -> None:
        """An evaluation against episodes and seconds, where they are `least` or more."""
        for group, step in (("test_by_episodes", episodes), ("test_by_seconds", seconds)):
            for name, value in scores.items() if int(step) >= least else ():
                self._writer.add_scalar(f"{group}/{name}", value, int(step))

    def _try(self, write: Callable[[], object]) -> None:
        """Write, unless the disk did not take anything a short while ago."""
        if self._broken and not self._again.due():
            return
        try:
            if self._broken:
                self._open(None)
                self._broken = False
            write()
        except OSError as error:
            if not self._broken:
                log.warning("curves cannot be written (%s): a gap is left in them", error.strerror)
                with suppress(OSError):
                    self._writer.close()
            self._broken, self._again = True, Every(RETRY_S)


def _plain(value: Any) -> float | str:
    """As the HPARAMS tab takes it."""
    return value if isinstance(value, int | float | str) else "+".join(map(str, value))


def _text(line: Mapping[str, Any]) -> str:
    return json.dumps(line) + "\n"


def _lines(path: Path) -> list[dict[str, Any]]:
    """What an earlier process wrote; a line that was cut short is left out."""
    found = []
    for text in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        try:
            line = json.loads(text)
        except (ValueError, RecursionError):
            continue
        if isinstance(line, dict) and all(isinstance(line.get(n), int | float) for n in POINT):
            found.append(line)
    return found
