"""Study folders as tangram-experiment leaves them, from a few chosen numbers."""

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np

Row = dict[str, Any]

BASELINES = {
    "position only": {
        "mean_reward": 0.764,
        "mean_reward_dense": 1.0,
        "angle_error_deg_median": 23.8,
        "position_error_median": 0.0,
    },
    "random": {
        "mean_reward": -0.96,
        "mean_reward_dense": -0.62,
        "angle_error_deg_median": 24.6,
        "position_error_median": 1.57,
    },
    "exact": {
        "mean_reward": 1.0,
        "mean_reward_dense": 1.0,
        "angle_error_deg_median": 0.0,
        "position_error_median": 0.0,
    },
}
VERSIONS = {"python": "3.11.7", "torch": "2.13.0"}


def training(label: str, family: str, *overrides: str) -> Row:
    return {"label": label, "family": family, "overrides": list(overrides), "after": None}


def trial(label: str, actions: int | None = None, corner_noise: float | None = None) -> Row:
    asked = {"sim.actions_per_token": actions, "sim.corner_noise": corner_noise}
    overrides = [f"{name}={value}" for name, value in asked.items() if value is not None]
    return {"label": label, "overrides": overrides}


def experiment(kind: str, trainings: list[str], source: str = "beyond", **more: Any) -> Row:
    return {
        "title": f"A {kind} title",
        "source": source,
        "kind": kind,
        "note": f"What {kind} are.",
        "trainings": trainings,
        "tests": [],
    } | more


def plan(experiments: Row, trainings: Row, tests: Row, seeds: tuple[int, ...] = (0, 1, 2)) -> Row:
    return {
        "format": 2,
        "command": "tangram-experiment experiment=[all] budget=laptop run_dir=runs/paper jobs=2",
        "commit": "0123abc",
        "budget": {
            "name": "laptop",
            "note": "Narrower MHA.",
            "seeds": list(seeds),
            "test_episodes": 100,
        },
        "experiments": experiments,
        "trainings": trainings,
        "tests": tests,
    }


def result(seed: int, mean_reward: float | None = 0.75, **more: Any) -> Row:
    angle = None if mean_reward is None else 100.0 * (1.0 - mean_reward)
    return {
        "mean_reward": mean_reward,
        "mean_reward_dense": mean_reward,
        "mean_reward_camera": mean_reward,
        "raw_overlap": 0.9,
        "raw_overlap_p10": 0.8,
        "angle_error_deg_median": angle,
        "angle_error_deg_p90": angle,
        "position_error_median": 0.0005,
        "position_error_p90": 0.001,
        "test_episodes": 100,
        "scored_updates": 2000,
        "episodes": 20_640,
        "transitions": 20_640,
        "updates": 2000,
        "wall_s": 60.0 + seed,
        "train_s": 54.0 + 6 * seed,
        "ended_by": "max_updates=2000",
        "seed": seed,
        "agent": "paper",
        "net": "mha",
        "tokens": ["square"],
        "actions_per_token": 1,
        "reward": "overlap",
        "backend": "physics",
        "device": "cpu",
        "workers": 1,
        "parameters": 32_600,
        "run_id": "1b81e6278bde5956",
        "versions": VERSIONS,
        "commit": "0123abc",
        "host": "secret-host",
        "processor": "AMD EPYC",
        "cores": 2,
    } | more


def learning_curve(
    seed: int, final: float, count: int = 25, episodes: int = 20_000, minutes: float = 1.0
) -> list[Row]:
    """From chance to a final score, with noise, evaluated at points that differ by seed."""
    generator = np.random.default_rng(seed)
    at = np.linspace(0.01 + 0.005 * seed, 1.0, count)
    score = final - (final + 0.96) * np.exp(-at * 9.0) + 0.01 * generator.normal(size=count)
    return [
        {
            "updates": round(2000 * share),
            "episodes": round(episodes * share),
            "train_s": 60.0 * minutes * share,
            "mean_reward": float(min(value, 1.0)),
            "mean_reward_dense": float(min(value + 0.1, 1.0)),
            "angle_error_deg_median": float(25.0 * np.exp(-share * 5)),
            "position_error_median": 0.01,
        }
        for share, value in zip(at, score, strict=True)
    ]


def scores(mean_reward: float, baselines: Row | None = BASELINES, **more: Any) -> Row:
    row: Row = {
        "mean_reward": mean_reward,
        "angle_error_deg_median": 100.0 * (1.0 - mean_reward),
        "run_dir": "/home/somebody/run",
    } | more
    return row if baselines is None else row | {"baselines": baselines}


def write_plan(folder: Path, content: Row) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "plan.json").write_text(json.dumps(content))


def write_run(
    folder: Path, name: str, final: Row | None, curve: list[Row], tests: Row | None = None
) -> Path:
    """A run's folder; without `final` it was cut while it wrote its curve."""
    seed = final["seed"] if final else 2
    run = folder / "trainings" / name / f"seed_{seed}"
    (run / "tests").mkdir(parents=True)
    lines = "".join(json.dumps(point) + "\n" for point in curve)
    (run / "curve.jsonl").write_text(lines if final else lines + '{"updates": 99')
    if final:
        (run / "result.json").write_text(json.dumps(final))
    for test, row in (tests or {}).items():
        (run / "tests" / f"{test}.json").write_text(json.dumps(row))
    return run


# A whole study: `paper` is finished, `mlp` lacks seed 2, `ours` was cut in seed 2.

TRAININGS = {
    "paper": training("MHA (paper)", "paper", "agent=paper"),
    "mlp": training("MLP", "mlp", "agent=mlp"),
    "ours": training("ours", "tangram"),
}
TESTS = {
    "actions_1": trial("1 action", 1),
    "actions_2": trial("2 actions", 2),
    "noise_0": trial("exact corners", corner_noise=0.0),
    "noise_010": trial("1 % noise", corner_noise=0.01),
}
EXPERIMENTS = {
    "fig4": experiment("curves", ["paper", "mlp", "ours"], "Fig. 4"),
    "fig6": experiment("rewards", ["paper", "ours"], "Fig. 6"),
    "table1": experiment("complexity", ["paper", "mlp"], "Table I"),
    "table2": experiment("tests", ["paper", "ours"], "Table II", tests=["actions_1", "actions_2"]),
    "noise": experiment("tests", ["ours"], tests=["noise_0", "noise_010"]),
    "ablation": experiment("ranking", ["ours", "paper", "mlp"]),
}
FINAL = {
    "paper": {0: 0.758, 1: 0.75, 2: 0.762},
    "mlp": {0: 0.7, 1: 0.69},
    "ours": {0: 0.996, 1: 0.995},
}


def write_study(folder: Path) -> Row:
    """The study described above; returns its plan."""
    content = copy.deepcopy(plan(EXPERIMENTS, TRAININGS, TESTS))
    write_plan(folder, content)
    for name, finals in FINAL.items():
        for seed, final in finals.items():
            tests: Row = {"actions_1": scores(final), "actions_2": scores(final - 0.01)}
            if name == "ours":
                tests |= {"noise_0": scores(final), "noise_010": scores(final - 0.1)}
            write_run(folder, name, result(seed, final), learning_curve(seed, final), tests)
    write_run(folder, "ours", None, learning_curve(2, 0.99, count=3))
    return content


def cells(text: str, label: str) -> list[list[str]]:
    """The cells of every row that begins with a label."""
    rows = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("|")]
    return [[c.strip() for c in row[1:]] for row in rows if row[0].strip() == label]
