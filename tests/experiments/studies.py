"""Studies small enough to be read at a glance."""

from pathlib import Path
from typing import Any

from tangram_agent.setup import from_mapping
from tangram_lab.experiments.plan import StudyConfig


def content(run_dir: Path, **changes: Any) -> dict[str, Any]:
    """The settings of a study of two experiments that share a training."""
    settings = {
        "run_dir": str(run_dir),
        "budget": {
            "name": "tiny",
            "note": "Nothing is learned.",
            "seeds": [0, 1],
            "test_episodes": 5,
            "overrides": {"all": ["a=1", "b=1"], "ours": ["b=2"]},
        },
        "families": {"ours": ["agent=tangram"], "theirs": ["agent=paper"]},
        "trainings": {
            "square": {"label": "square", "family": "ours"},
            "paper": {"label": "paper", "family": "theirs", "overrides": ["b=3", "c=1"]},
            "warm": {"label": "warm", "family": "ours", "after": "square"},
        },
        "tests": {
            "twice": {"label": "2 actions", "actions": 2},
            "noisy": {"label": "1 % noise", "corner_noise": 0.01},
        },
        "experiments": {
            "one": experiment(["paper", "square"], ["twice"]),
            "two": experiment(["square", "warm"], ["twice", "noisy"]),
        },
    }
    return settings | changes


def experiment(trainings: list[str], tests: list[str]) -> dict[str, Any]:
    """A table of these trainings and tests."""
    texts = {"title": "A title", "source": "Table I", "note": "A note.", "kind": "tests"}
    return texts | {"trainings": trainings, "tests": tests}


def study(run_dir: Path, **changes: Any) -> StudyConfig:
    """The study as tangram-experiment would make it."""
    return from_mapping(StudyConfig, content(run_dir, **changes))
