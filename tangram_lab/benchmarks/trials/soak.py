"""An hour of training: memory and open files of every process, drawn."""

import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import psutil

from tangram_lab.benchmarks.measure import show, write
from tangram_lab.benchmarks.trainings import processes_of, result_of, start_training, wait_for
from tangram_lab.figures import COLOURS, WIDTH_IN, legend_below, new_figure, save

SETTINGS = ("workers=2", "agent.replay_capacity=20000", "service.checkpoint_minutes=1")
EVERY_S = 10.0
# What fills up at first (the replay, caches) is no leak.
WARM_SHARE = 0.25
# Per hour; about half a gigabyte in three days.
FLAT_MIB, FLAT_FILES = 8.0, 1.0
PROCESSES = 5
MIB = 2**20

Samples = dict[str, list[tuple[float, float, int]]]  # name -> (minute, MiB, open files)


def run_soak(minutes: float, seed: int, out: Path | None, folder: Path) -> int:
    """Train for so long, and report how memory and files grew after the first quarter.

    Args:
        minutes: of training.
        seed: of the training.
        out: JSON file; a picture of the same name lies beside it.
        folder: of the run; must not hold any.

    Returns:
        0 if the training went well, no process was replaced and all of them stayed flat, else 1.
    """
    launcher = start_training(folder, f"seed={seed}", "max_updates=0", *SETTINGS)
    wait_for(folder / "connection.json", launcher)
    samples: Samples = {}
    began = time.monotonic()
    while time.monotonic() - began < minutes * 60.0 and launcher.poll() is None:
        time.sleep(EVERY_S)
        _sample(samples, (time.monotonic() - began) / 60.0, folder)
    launcher.terminate()
    status = launcher.wait(120)
    rows = [_row(name, points, minutes) for name, points in sorted(samples.items())]
    show("memory and open files after the first quarter", rows)
    result = result_of(folder)
    print(f"{result['episodes']:,} episodes, {result['updates']:,} updates, ended with {status}")
    write(
        out,
        {
            "minutes": minutes,
            "settings": SETTINGS,
            "status": status,
            "episodes": result["episodes"],
            "updates": result["updates"],
            "processes": rows,
            "samples": samples,
        },
    )
    if out is not None:
        _draw(samples, out.with_suffix(".png"))
    flat = len(rows) == PROCESSES and all(row["flat"] == "yes" for row in rows)
    return int(status != 0 or not flat)


def _sample(samples: Samples, minute: float, folder: Path) -> None:
    for process, line in processes_of(folder).items():
        try:
            memory, files = process.memory_info().rss / MIB, process.num_fds()
        except psutil.NoSuchProcess:
            continue  # it ended meanwhile
        points = samples.setdefault(f"{_name(line)} ({process.pid})", [])
        points.append((minute, memory, files))


def _name(line: str) -> str:
    for words, name in (("-m tangram_cli master", "master"), ("role=evaluator", "evaluator")):
        if words in line:
            return name
    return "worker" if "-m tangram_cli worker" in line else "launcher"


def _row(name: str, points: list[tuple[float, float, int]], minutes: float) -> dict[str, Any]:
    warm = [point for point in points if point[0] >= WARM_SHARE * minutes] or points
    hours = [minute / 60.0 for minute, _, _ in warm]
    memory, files = _growth(hours, [m for _, m, _ in warm]), _growth(hours, [f for _, _, f in warm])
    return {
        "process": name,
        "MiB": round(warm[-1][1], 1),
        "MiB per hour": round(memory, 2),
        "open files": warm[-1][2],
        "open files per hour": round(files, 2),
        "flat": "yes" if memory <= FLAT_MIB and files <= FLAT_FILES else "no",
    }


def _growth(hours: list[float], values: Sequence[float]) -> float:
    """Per hour, by the line that fits best."""
    return statistics.linear_regression(hours, values).slope if len(hours) > 1 else 0.0


def _draw(samples: Samples, path: Path) -> None:
    figure, panels = new_figure(WIDTH_IN * 0.4, 2)
    for (name, points), colour in zip(sorted(samples.items()), COLOURS, strict=False):
        minutes, memory, files = zip(*points, strict=True)
        for panel, values in zip(panels, (memory, files), strict=True):
            panel.plot(minutes, values, color=colour, label=name)
    for panel, label in zip(panels, ("memory (MiB)", "open files"), strict=True):
        panel.set_xlabel("minutes")
        panel.set_ylabel(label)
        panel.set_ylim(bottom=0)
    legend_below(figure, panels[0], len(samples))
    save(figure, path)
