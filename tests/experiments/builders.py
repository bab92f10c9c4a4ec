"""Study folders as tangram-experiment leaves them, from a few chosen numbers."""

import json
from pathlib import Path
from typing import Any

import numpy as np

Row = dict[str, Any]

KEYS = ("mean_reward", "mean_reward_dense", "angle_error_deg_median", "position_error_median")
BASELINES = {
    "position only": dict(zip(KEYS, (0.764, 1.0, 23.8, 0.0), strict=True)),
    "random": dict(zip(KEYS, (-0.96, -0.62, 24.6, 1.57), strict=True)),
    "exact": dict(zip(KEYS, (1.0, 1.0, 0.0, 0.0), strict=True)),
}


def training(label: str, family: str, *overrides: str, after: str | None = None) -> Row:
    return {"label": label, "family": family, "overrides": list(overrides), "after": after}


def trial(label: str, actions: int | None = None, corner_noise: float | None = None) -> Row:
    asked = {"sim.actions_per_token": actions, "sim.corner_noise": corner_noise}
    overrides = [f"{name}={value}" for name, value in asked.items() if value is not None]
    return {"label": label, "overrides": overrides}


def experiment(kind: str, trainings: list[str], source: str = "beyond", **more: Any) -> Row:
    texts = {"title": f"A {kind} title", "source": source, "note": f"What {kind} are."}
    return {**texts, "kind": kind, "trainings": trainings, "tests": []} | more


SETTINGS = {"agent": {"batch_size": 64}, "max_updates": 2000}
FINGERPRINT = {"mean_reward": 0.5, "weights": 1000.0}


def plan(experiments: Row, trainings: Row, tests: Row, seeds: tuple[int, ...] = (0, 1, 2)) -> Row:
    budget = {"name": "laptop", "note": "Narrower MHA.", "test_episodes": 100, "test_seed": 2}
    return {
        "format": 4,
        "command": "tangram-experiment experiment=[all] budget=laptop run_dir=runs/paper jobs=2",
        "commit": "0123abc",
        "budget": budget,
        "experiments": experiments,
        "trainings": {
            name: one | {"seeds": list(seeds), "settings": SETTINGS}
            for name, one in trainings.items()
        },
        "tests": tests,
        "fingerprints": dict.fromkeys(trainings, FINGERPRINT),
    }


def result(seed: int, mean_reward: float | None = 0.75, **more: Any) -> Row:
    """As far as a report looks at it, and what it must not tell."""
    return {
        "mean_reward": mean_reward,
        "mean_reward_dense": mean_reward,
        "angle_error_deg_median": None if mean_reward is None else 100.0 * (1.0 - mean_reward),
        "position_error_median": 0.0005,
        "test_episodes": 100,
        "episodes": 20_640,
        "updates": 2000,
        "scored_updates": 2000,
        "wall_s": 60.0 + seed,
        "train_s": 54.0 + 6 * seed,
        "ended_by": "max_updates=2000",
        "seed": seed,
        "tokens": ["square"],
        "parameters": 32_600,
        "versions": {"python": "3.11.7", "torch": "2.13.0"},
        "commit": "0123abc",
        "host": "secret-host",
        "processor": "AMD EPYC",
        "cores": 2,
    } | more


def learning_curve(seed: int, final: float, count: int = 25) -> list[Row]:
    """From chance to a final score, with noise, evaluated at points that differ by seed."""
    generator = np.random.default_rng(seed)
    at = np.linspace(0.01 + 0.005 * seed, 1.0, count)
    score = final - (final + 0.96) * np.exp(-at * 9.0) + 0.01 * generator.normal(size=count)
    return [
        {
            "updates": round(2000 * share),
            "episodes": round(20_000 * share),
            "train_s": 60.0 * share,
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
        "episodes": 100,
        "test_seed": 2,
        "updates": 2000,
    } | more
    return row if baselines is None else row | {"baselines": baselines}


def of_several(coverage: list[float], **more: Any) -> Row:
    """Scores of a test with several tokens."""
    return {
        "coverage": float(np.mean(coverage)),
        "coverage_each": coverage,
        "episodes": len(coverage),
        "share_solved": float(np.mean(np.array(coverage) >= 0.95)),
        "iou": 0.9,
        "wrong": 0.25,
        "doubly_used": 0.0,
        "blocked": 0.5,
        "seconds_per_puzzle": 0.125,
        "position_error_median": 0.0012,
    } | more


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


# A whole study. `paper` is finished, `mlp` lacks seed 2, `ours` was cut in seed 2; `triangle` was
# stopped and has no tests, nor has its task; `inexact` has no policy to compare with; of `seven`
# one test is missing, and one seed was not tested in the listed order.

TRAININGS = {
    "paper": training("MHA (paper)", "paper", "agent=paper"),
    "mlp": training("MLP", "mlp", "agent=mlp"),
    "ours": training("ours", "tangram"),
    "triangle": training("tri|angle <b>", "tangram", "tokens=triangle", after="ours"),
    "inexact": training("inexact", "tangram", "sim.damping=0.04"),
    "seven": training("seven tokens", "game", "tokens=tangram7"),
}
TESTS = {
    "actions_1": trial("1 action", 1),
    "actions_2": trial("2 actions", 2),
    "noise_0": trial("exact corners", corner_noise=0.0),
    "noise_010": trial("1 % noise", corner_noise=0.01),
    "random": trial("random targets"),
}
TWO = ["actions_1", "actions_2"]
EXPERIMENTS = {
    "fig4": experiment("curves", ["paper", "mlp", "ours"], "Fig. 4"),
    "fig6": experiment("rewards", ["paper", "ours"], "Fig. 6", labels={"ours": "ours, both"}),
    "table1": experiment("complexity", ["paper", "mlp"], "Table I"),
    "table2": experiment("tests", ["paper", "ours"], "Table II", tests=TWO),
    "noise": experiment("tests", ["ours"], tests=["noise_0", "noise_010"]),
    "ablation": experiment("ranking", ["ours", "paper", "mlp", "triangle", "inexact"]),
    "game": experiment("game", ["seven"], tests=["random", "actions_1"]),
    "one_test": experiment("game", ["seven"], tests=["actions_1"]),
    "worlds": experiment("worlds", ["seven"], tests=["random"]),
    "changed": experiment("worlds", ["ours"], tests=["noise_0", "noise_010"]),
    "untested": experiment("tests", ["triangle"], tests=TWO),
    "no_curve": experiment("curves", ["inexact"]),
    "later": experiment("curves", ["later"]),
}
FINAL: dict[str, dict[int, float]] = {
    "paper": {0: 0.758, 1: 0.75, 2: 0.762},
    "mlp": {0: 0.7, 1: 0.69},
    "ours": {0: 0.996, 1: 0.995},
}


def write_study(folder: Path) -> Row:
    """The study described above; returns its plan."""
    content = plan(EXPERIMENTS, TRAININGS | {"later": training("later", "tangram")}, TESTS)
    write_plan(folder, content)
    for name, finals in FINAL.items():
        for seed, final in finals.items():
            tests: Row = {"actions_1": scores(final), "actions_2": scores(final - 0.01)}
            if name == "ours":
                tests |= {"noise_0": scores(final), "noise_010": scores(final - 0.1)}
            write_run(folder, name, result(seed, final), learning_curve(seed, final), tests)
    write_run(folder, "ours", None, learning_curve(2, 0.99, count=3))
    triangle = result(0, 0.9, tokens=["large_triangle"])
    write_run(folder, "triangle", triangle, learning_curve(0, 0.9))
    write_run(folder, "triangle", triangle | {"seed": 1, "ended_by": "SIGINT"}, [])
    write_run(folder, "inexact", result(0, 0.8), [], {})
    for seed, own in enumerate(([1.0, 0.98], [0.96, 0.9])):
        known: Row = {
            "exact": of_several([1.0, 1.0], mean_reward=1.0),
            "random": of_several([0.1, 0.3], mean_reward=-0.9),
            "order=listed": of_several([0.9, 0.9]),
            **({"order=size": of_several([0.9, 0.9])} if seed == 0 else {}),
        }
        test = {"random": scores(0.9, known, **of_several(own))}
        write_run(folder, "seven", result(seed, tokens=["square"] * 7), [], test)
    return content


def cells(text: str, label: str) -> list[list[str]]:
    """The cells of every row that begins with a label."""
    rows = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("|")]
    return [[c.strip() for c in row[1:]] for row in rows if row[0].strip() == label]
