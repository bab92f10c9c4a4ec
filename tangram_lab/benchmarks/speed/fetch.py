"""Our goal agent and Stable-Baselines3's TD3 with hindsight, side by side on Fetch and Panda.

Both train at the same time, each on half of the cores, and on the GPU if there is one. Both
normalise inputs, and both use our network sizes, batch size, learning rate, discount and updates
per step, and targets that follow as fast. Stable-Baselines3 has its exploration from RL Zoo. RL
Zoo's own sizes (3 x 512, batches of 2,048, one update per step) would be too slow on a few cores.
"""

import importlib
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from master.watch.result import commit
from tangram_core.errors import ConfigError, TangramError
from tangram_core.store.files import write_whole
from tangram_lab.benchmarks.measure import Row, told
from tangram_lab.benchmarks.setups import goal_config, robot
from tangram_lab.benchmarks.trainings import start_training
from tangram_lab.figures import COLOURS, legend_below, new_figure, save
from tangram_tasks.gym.judge import INSTALL

STAGE, LIBRARY = "fetch", "stable_baselines3"
TASKS = (
    *("FetchPush-v4", "FetchPickAndPlace-v4", "FetchSlide-v4"),
    *("PandaPush-v3", "PandaPickAndPlace-v3"),
)
TESTS = 100
LOOK_S = 60.0  # between two tests
GOOD = 0.9
ENVS = 4
NOISE = 0.2
COLUMNS = ("train_s", "steps", "updates", "success")
# Seconds of training, steps of the environment, updates, share of tests that succeed.
Curve = list[tuple[float, int, int, float]]


@dataclass(frozen=True)
class Match:
    """One training of each side.

    Attributes:
        id: gymnasium id of the environment.
        seed: seed of both trainings.
        minutes: length of each training.
        agent: our preset.
        workers: number of our workers; 0: one fewer than its cores, but at least two.
    """

    id: str
    seed: int
    minutes: float
    agent: str
    workers: int

    @property
    def module(self) -> str:
        """Name of the Python module that registers the environment."""
        return "panda_gym" if self.id.startswith("Panda") else "gymnasium_robotics"


def label() -> str:
    """Name and version of Stable-Baselines3; ModuleNotFoundError if it is missing."""
    try:
        return f"Stable-Baselines3 {version('stable-baselines3')}"
    except PackageNotFoundError:
        raise ModuleNotFoundError(
            "this benchmark needs Stable-Baselines3: pip install stable-baselines3"
        ) from None


def measure_fetch(matches: Sequence[Match], rows: Path | None) -> list[Row]:
    """Run the matches that are not in `rows` yet, one after the other; return a table of all.

    Args:
        matches: the trainings to compare.
        rows: CSV file; after each match its tests are added, and a picture beside it is redrawn.

    Raises:
        ConfigError: `rows` has other columns.
        ModuleNotFoundError: Stable-Baselines3 or the environments are missing.
    """
    name, there = label(), _read(rows)
    for module in {match.module for match in matches}:
        if find_spec(module) is None:
            raise ModuleNotFoundError(f"{module} is missing: {INSTALL}")
    for match in matches:
        key = asdict(match)
        if not _of(there, match).empty:
            print(f"{match.id}, seed {match.seed}: already in {rows}", file=sys.stderr)
            continue
        ours, theirs = _play(match, name)
        pairs = zip_longest(ours, theirs, fillvalue=[math.nan] * len(COLUMNS))
        made = pd.DataFrame(
            [[*key.values(), commit(), *mine, *other] for mine, other in pairs],
            columns=_columns(),
        )
        there = pd.concat([there, made]) if len(there) else made
        if rows is not None:
            write_whole(rows, there.to_csv(index=False).encode())
            draw(there, name, rows.with_suffix(".png"))
    return [row for match in matches for row in _rows(match, there, name)]


def draw(table: pd.DataFrame, name: str, path: Path) -> None:
    """Plot success by minutes into a PNG, a panel per environment and a line per training."""
    ids, rest = list(dict.fromkeys(table["id"])), [one.name for one in fields(Match)][1:]
    figure, panels = new_figure(2.6, len(ids), sharey=True)
    for id, panel in zip(ids, panels, strict=True):  # noqa: A001
        trainings = [one for _, one in table[table["id"] == id].groupby(rest)]
        for side, who, colour in zip(("", "their_"), ("ours", name), COLOURS, strict=False):
            for number, one in enumerate(trainings):
                minutes, legend = one[f"{side}train_s"] / 60.0, who if number == 0 else None
                panel.plot(minutes, one[f"{side}success"], color=colour, label=legend)
        panel.set(title=id, xlabel="minutes", ylim=(0.0, 1.02))
    panels[0].set_ylabel("success")
    legend_below(figure, panels[0])
    save(figure, path)


def _columns() -> list[str]:
    match = [field.name for field in fields(Match)]
    return [*match, "commit", *COLUMNS, *(f"their_{one}" for one in COLUMNS)]


def _read(rows: Path | None) -> pd.DataFrame:
    if rows is None or not rows.exists():
        return pd.DataFrame(columns=_columns())
    found = pd.read_csv(rows)
    if list(found) != _columns():
        raise ConfigError(
            f"rows={rows} has other columns than {', '.join(_columns())}: name another file"
        )
    return found


def _of(table: pd.DataFrame, match: Match) -> pd.DataFrame:
    key = asdict(match)
    return table[(table[list(key)] == list(key.values())).all(axis=1)]


def _rows(match: Match, table: pd.DataFrame, name: str) -> list[Row]:
    case = f"{match.id}, {match.agent}, seed {match.seed}"
    found = _of(table, match)

    def row(what: str, unit: str, column: Callable[[str], float]) -> Row:
        pair = column(""), column("their_")
        return told(Row(STAGE, f"{case}: {what}", unit, pair[0], name, pair[1]))

    def until(side: str) -> float:
        good = found[found[f"{side}success"] >= GOOD]
        return float(good[f"{side}train_s"].min()) if len(good) else float("inf")

    def last(side: str) -> float:
        return float(found[f"{side}success"].dropna()[-3:].mean())

    return [
        row("success, last three tests", "share", last),
        row(f"seconds until {GOOD:g} (inf: never)", "s", until),
        row("steps", "steps", lambda s: float(found[f"{s}steps"].max())),
        row("updates", "updates", lambda s: float(found[f"{s}updates"].max())),
    ]


def _play(match: Match, name: str) -> tuple[Curve, Curve]:
    """Run both trainings at the same time; the learning curves of ours and theirs."""
    cores = sorted(os.sched_getaffinity(0))
    half = max(1, len(cores) // 2)
    given = json.dumps({**asdict(match), "cores": cores[half:] or cores})
    with tempfile.TemporaryDirectory(prefix="tangram-") as scratch:
        command = [sys.executable, "-m", "tangram_lab.benchmarks.speed.fetch", given]
        with Path(scratch, "theirs").open("w+") as said:
            rival = subprocess.Popen(command, stdout=said, stderr=subprocess.STDOUT)
            try:
                ours = _ours(match, Path(scratch) / "run", cores[:half])
                rival.wait()
            finally:
                rival.kill()
            said.seek(0)
            lines = said.read().splitlines()
        if rival.returncode:
            raise TangramError(f"{name} failed: {' '.join(lines[-3:])}")
    theirs = [tuple(json.loads(line)) for line in lines if line.startswith("[")]
    if not (ours and theirs):
        raise TangramError(f"{match.id}: no test in {match.minutes:g} minutes: give it more")
    return ours, theirs


def _agent(match: Match) -> list[str]:
    return [f"agent={match.agent}", f"seed={match.seed}"]


def _ours(match: Match, folder: Path, cores: list[int]) -> Curve:
    """Run our training on its cores; if there are few, master and workers share them."""
    settings = (
        *("task=gym", f"task.id={match.id}", f"task.imports=[{match.module}]"),
        *_agent(match),
        f"workers={match.workers or max(2, len(cores) - 1)}",
        *(f"service.eval_seconds={LOOK_S}", f"service.eval_episodes={TESTS}"),
        *(f"max_hours={match.minutes / 60.0}", "max_updates=0"),
    )
    every = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)  # children inherit it
    try:
        launcher = start_training(folder, *settings)
    finally:
        os.sched_setaffinity(0, every)
    if launcher.wait():
        raise TangramError(f"our training failed: {(folder / 'told').read_text()[-500:]}")
    result = json.loads((folder / "result.json").read_text())
    steps = result["transitions"] // max(1, result["episodes"])
    lines = [json.loads(line) for line in (folder / "curve.jsonl").read_text().splitlines()]
    return [
        (one["train_s"], one["episodes"] * steps, one["updates"], one["success"]) for one in lines
    ]


# Theirs, in a process of its own


def train(match: Match, cores: Sequence[int]) -> None:
    """Train Stable-Baselines3, and print each test; the time of tests does not count."""
    library = importlib.import_module(LIBRARY)
    vector, alone = importlib.import_module(f"{LIBRARY}.common.vec_env"), len(cores) == 1
    noise = importlib.import_module(f"{LIBRARY}.common.noise")
    logger = importlib.import_module(f"{LIBRARY}.common.logger")
    count = ENVS if alone else len(cores)
    kind = vector.DummyVecEnv if alone else vector.SubprocVecEnv
    env = vector.VecNormalize(
        kind([partial(_make, match)] * count), norm_reward=False, clip_obs=5.0
    )
    same = goal_config(robot(match.id, match.module, *_agent(match)))
    size = env.action_space.shape[0]
    model = library.TD3(
        "MultiInputPolicy",
        env,
        action_noise=noise.NormalActionNoise(np.zeros(size), np.full(size, NOISE)),
        batch_size=same.batch_size,
        buffer_size=1_000_000,
        device="auto",
        gamma=same.gamma,
        gradient_steps=count,
        learning_rate=same.learning_rate,
        learning_starts=1000,
        policy_kwargs={"net_arch": list(same.hidden)},
        replay_buffer_class=library.HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        seed=match.seed,
        tau=2.0 * (1.0 - same.polyak),  # only every second update moves their targets
        train_freq=(round(1.0 / same.updates_per_transition), "step"),
    )
    model.set_logger(logger.Logger(None, []))
    test, begun, due = _make(match), time.perf_counter(), LOOK_S

    def look(*_: object) -> bool:
        nonlocal begun, due
        passed = time.perf_counter() - begun
        if passed >= due:
            due += LOOK_S
            won = _successes(model, env, test)
            print(json.dumps([passed, model.num_timesteps, model._n_updates, won]), flush=True)
            begun = time.perf_counter() - passed
        return passed < 60.0 * match.minutes

    model.learn(10**9, callback=look)


def _make(match: Match) -> Any:
    import gymnasium  # noqa: PLC0415 - an extra

    importlib.import_module(match.module)
    return gymnasium.make(match.id)


def _successes(model: Any, env: Any, test: Any) -> float:
    won = 0
    for number in range(TESTS):
        (seen, _), over, info = test.reset(seed=10_000 + number), False, dict[str, Any]()
        while not over:
            rows = env.normalize_obs({name: part[None] for name, part in seen.items()})
            action = model.predict(rows, deterministic=True)[0][0]
            seen, _, ended, cut, info = test.step(action)
            over = ended or cut
        won += bool(info["is_success"])
    return won / TESTS


if __name__ == "__main__":
    asked = json.loads(sys.argv[1])
    own_cores = asked.pop("cores")
    os.sched_setaffinity(0, own_cores)
    torch.set_num_threads(len(own_cores))
    train(Match(**asked), own_cores)
