"""TensorBoard: what is written, under which name, against what.

Curves are drawn against updates. Scores of the evaluator stand there three times: against updates
(`test`), against episodes (`test_by_episodes`) and against seconds of training (`test_by_seconds`).
"""

from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from torch.utils.tensorboard import SummaryWriter

from tangram_sim.arrays import Pixels

FLUSH_S = 30


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
    """Writes the curves of one run."""

    def __init__(self, folder: Path, updates: int = 0) -> None:
        """Open the folder.

        Args:
            folder: of the event files.
            updates: of the checkpoint that the run goes on from; later points of an earlier
                process are hidden, since they happen again.
        """
        purge = updates + 1 if updates else None
        self._writer = SummaryWriter(str(folder), purge_step=purge, flush_secs=FLUSH_S)
        # Purging hides points of every tag in a folder by their step, so curves against episodes
        # and seconds, which nothing repeats, lie in a folder of their own.
        self._axes = SummaryWriter(str(folder / "axes"), flush_secs=FLUSH_S)

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """Points of many curves at one step."""
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def scores(
        self, scores: Mapping[str, float], updates: int, episodes: int, seconds: float
    ) -> None:
        """An evaluation of the weights after so many updates."""
        self.scalars({f"test/{name}": value for name, value in scores.items()}, updates)
        for group, step in (("test_by_episodes", episodes), ("test_by_seconds", seconds)):
            for name, value in scores.items():
                self._axes.add_scalar(f"{group}/{name}", value, int(step))

    def picture(self, pixels: Pixels, updates: int) -> None:
        """The test episodes (height, width, 3) after so many updates."""
        self._writer.add_image("test/pictures", np.asarray(pixels), updates, dataformats="HWC")

    def settings(self, resolved: Mapping[str, Any]) -> None:
        """The whole config as text."""
        text = yaml.safe_dump(dict(resolved), sort_keys=False)
        indented = "".join(f"    {line}\n" for line in text.splitlines())
        self._writer.add_text("config", indented)

    def hyperparameters(self, resolved: Mapping[str, Any], scores: Mapping[str, float]) -> None:
        """What runs are compared by in the HPARAMS tab, with the final scores."""
        metrics = {f"final/{name}": value for name, value in scores.items()}
        self._writer.add_hparams(flatten(resolved), metrics, run_name="final")

    def close(self) -> None:
        """Write what is left."""
        self._writer.close()
        self._axes.close()


def flatten(settings: Mapping[str, Any], prefix: str = "") -> dict[str, float | str | bool]:
    """Nested settings as dotted names; sequences become texts."""
    flat: dict[str, float | str | bool] = {}
    for name, value in settings.items():
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{prefix}{name}.")
        elif isinstance(value, bool | int | float | str):
            flat[f"{prefix}{name}"] = value
        else:
            flat[f"{prefix}{name}"] = str(value)
    return flat
