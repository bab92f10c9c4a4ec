"""One setting over several seeds: every seed is reported, and the median with the spread."""

import json
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

from benchmarks.report import show, write
from tangram_sim.errors import RunError

COLUMNS = (
    "mean_reward",
    "mean_reward_camera",
    "raw_overlap",
    "raw_overlap_p10",
    "angle_error_deg_median",
    "position_error_median",
    "episodes",
    "updates",
    "train_s",
    "wall_s",
)


def train_seeds(
    seeds: list[int], folder: Path, overrides: tuple[str, ...], out: Path | None
) -> None:
    results = [_train(seed, folder / f"seed_{seed}", overrides) for seed in seeds]
    rows = [{"seed": r["seed"]} | {name: r[name] for name in COLUMNS} for r in results]
    for label, pick in (("median", statistics.median), ("least", min), ("most", max)):
        rows.append({"seed": label} | {name: pick([r[name] for r in results]) for name in COLUMNS})
    show(" ".join(("tangram-train", *overrides)), rows)
    write(out, {"overrides": list(overrides), "seeds": results, "rows": rows})


def _train(seed: int, run_dir: Path, overrides: tuple[str, ...]) -> dict[str, Any]:
    """Train one seed; a folder that holds a run already is refused by tangram-train."""
    command = Path(sys.executable).with_name("tangram-train")
    arguments = [f"seed={seed}", f"run_dir={run_dir}", *overrides]
    done = subprocess.run([command, *arguments], check=False)
    result = run_dir / "result.json"
    if done.returncode or not result.exists():
        raise RunError(f"seed {seed} did not finish (exit status {done.returncode})")
    content: dict[str, Any] = json.loads(result.read_text())
    content.pop("host", None)  # says nothing to anybody else
    return content
