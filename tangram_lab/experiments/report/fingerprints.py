"""Fingerprints of the code that trains: what 20 updates in lockstep come to, for each family.

Figures stay true while a training comes to the same numbers as when they were made.
"""

import math
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from master.children import command, environment, override
from tangram_agent.checkpoints import ACTING, CHECKPOINTS, load_checkpoint, newest_checkpoint
from tangram_lab.experiments.jobs import read_object
from tangram_sim.errors import RunError

UPDATES = 20
SETTINGS = (
    "seed=0",
    *(f"max_updates={UPDATES}", "max_episodes=0", "service.mode=lockstep"),
    *("service.envs=4", "service.batch_episodes=8", "service.eval_episodes=8"),
    *("agent.batch_size=16", "agent.learning_starts=32"),
)
# Lockstep has no pace at which weights are sent.
LEFT_OUT = ("service.publish_seconds",)
SCORES = ("mean_reward", "raw_overlap", "angle_error_deg_p90", "position_error_p90")
AT_ONCE = 2  # trainings
TOLERANCE = 1e-3  # other processors add numbers up in another order
LONGEST_S = 300

Fingerprint = dict[str, float]


def make_fingerprints(trainings: Mapping[str, Mapping[str, Any]]) -> dict[str, Fingerprint]:
    """Family -> its fingerprint, by the first of its trainings.

    Args:
        trainings: of a plan.

    Raises:
        RunError: a training failed.
    """
    firsts = families(trainings)
    with TemporaryDirectory() as folder, ThreadPoolExecutor(AT_ONCE) as pool:
        places = [Path(folder, family) for family in firsts]
        return dict(zip(firsts, pool.map(_trained, places, firsts.values()), strict=True))


def families(trainings: Mapping[str, Mapping[str, Any]]) -> dict[str, list[str]]:
    """Family -> the arguments of the first of its trainings, of those of a plan."""
    firsts = dict[str, list[str]]()
    for training in trainings.values():
        firsts.setdefault(training["family"], list(training["overrides"]))
    return firsts


def _trained(folder: Path, overrides: list[str]) -> Fingerprint:
    kept = [one for one in overrides if not one.startswith(LEFT_OUT)]
    said = {text.partition("=")[0]: text for text in (*kept, *SETTINGS)}
    told = [*command("train"), override("run_dir", str(folder)), *said.values()]
    log = folder.with_suffix(".log")
    with log.open("wb") as out:
        ended = subprocess.run(
            [sys.executable, *told],
            env=environment(),
            stdout=out,
            stderr=out,
            timeout=LONGEST_S,
            check=False,
        )
    if ended.returncode:
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
        raise RunError(f"the training of family {folder.name} failed: {' '.join(lines[-3:])}")
    result = read_object(folder / "result.json")
    checkpoint = load_checkpoint(newest_checkpoint(folder / CHECKPOINTS), [ACTING])
    weights = checkpoint.arrays[ACTING].values()
    total = math.fsum(float(np.abs(one.astype(np.float64)).sum()) for one in weights)
    return {**{name: float(result[name]) for name in SCORES}, "weights": total}


def differences(
    names: Iterable[str], stored: Mapping[str, Fingerprint], now: Mapping[str, Fingerprint]
) -> Iterator[str]:
    """Where a family trains otherwise than it did, or nobody kept how it did.

    Args:
        names: of all families.
        stored, now: family -> its fingerprint.
    """
    for family in names:
        if family not in stored:
            yield f"family {family} has no fingerprint: make the report with fingerprints=true"
        for name, value in stored.get(family, {}).items():
            found = now[family].get(name)
            if found is None or not np.isclose(found, value, rtol=TOLERANCE, atol=TOLERANCE):
                yield (
                    f"family {family} trains otherwise than when its figures were made: after "
                    f"{UPDATES} updates {name} is {found}, and was {value}: make them anew with "
                    "make evidence"
                )
