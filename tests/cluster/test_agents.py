"""tangram-eval and tangram-play from any folder: agents of the package, and comparisons."""

import json
from pathlib import Path

import pytest

from tangram_agent.pretrained import agent_names
from tests.cluster.processes import run_here

pytestmark = pytest.mark.cluster


@pytest.mark.parametrize("name", agent_names())
def test_an_agent_of_the_package_is_scored_from_any_folder(tmp_path: Path, name: str) -> None:
    few = 4 if name == "tangram7" else 20  # seven tokens take their time
    least = {"hand": ("solved", 0.6), "tangram7_silhouette": ("mean_reward", 0.7)}
    score, bound = least.get(name, ("mean_reward", 0.9))
    arguments = (
        f"run_dir=pretrained/{name}",
        f"episodes={few}",
        "seed=1",
        "out=scores.json",
        "rivals=[]",
        *(["task.count=2"] if name == "hand" else []),
    )
    run_here("tangram-eval", *arguments, cwd=tmp_path)
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert scores[score] > bound
    assert scores["run_dir"] == f"pretrained/{name}"
