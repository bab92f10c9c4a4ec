"""An hour of training: memory and open files of every process, drawn."""

import time
from pathlib import Path
from typing import Any

from benchmarks.chaos import processes_of, start_training, wait_for
from benchmarks.report import show, write
from experiments.report.style import COLOURS, WIDTH_IN, drawing, empty_figure, save

SETTINGS = ("workers=2", "agent.replay_capacity=20000", "service.checkpoint_minutes=1")
EVERY_S = 10.0
# What fills up at first (the replay, caches) is no leak.
WARM_SHARE = 0.25
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
        1 if a process was replaced meanwhile or the training failed, else 0.
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
    write(out, {"minutes": minutes, "status": status, "processes": rows, "samples": samples})
    if out is not None:
        _draw(samples, out.with_suffix(".png"))
    return int(status != 0 or len(samples) != 5)


def _sample(samples: Samples, minute: float, folder: Path) -> None:
    for pid, line in processes_of(folder).items():
        try:
            pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
            files = len(list(Path(f"/proc/{pid}/fd").iterdir()))
        except OSError:
            continue  # it ended meanwhile
        points = samples.setdefault(f"{_name(line)} ({pid})", [])
        points.append((minute, pages * 4096 / MIB, files))


def _name(line: str) -> str:
    for words, name in (("-m master", "master"), ("role=evaluator", "evaluator")):
        if words in line:
            return name
    return "worker" if "-m worker" in line else "launcher"


def _row(name: str, points: list[tuple[float, float, int]], minutes: float) -> dict[str, Any]:
    warm = [point for point in points if point[0] >= WARM_SHARE * minutes] or points
    first, last = warm[0], warm[-1]
    hours = max(last[0] - first[0], 1e-9) / 60.0
    return {
        "process": name,
        "MiB": round(last[1], 1),
        "MiB per hour": round((last[1] - first[1]) / hours, 2),
        "open files": last[2],
        "more open files": last[2] - first[2],
    }


def _draw(samples: Samples, path: Path) -> None:
    with drawing():
        figure = empty_figure(WIDTH_IN, WIDTH_IN * 0.4)
        panels = figure.subplots(1, 2)
        for (name, points), colour in zip(sorted(samples.items()), COLOURS, strict=False):
            minutes, memory, files = zip(*points, strict=True)
            for panel, values in zip(panels, (memory, files), strict=True):
                panel.plot(minutes, values, color=colour, label=name)
        for panel, label in zip(panels, ("memory (MiB)", "open files"), strict=True):
            panel.set_xlabel("minutes")
            panel.set_ylabel(label)
            panel.set_ylim(bottom=0)
        panels[0].legend()
        save(figure, path.parent, path.stem)
