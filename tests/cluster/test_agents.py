"""tangram-eval and tangram-play as processes: agents of the package, and comparisons."""

import json
from pathlib import Path

import pytest
from PIL import Image

from tangram_agent.pretrained import agent_names
from tests.cluster.processes import refused, run, run_here
from tests.worker.builders import write_run

pytestmark = pytest.mark.cluster


def test_runs_are_compared_from_the_folder_that_they_lie_in(tmp_path: Path) -> None:
    for name in ("one", "two"):
        write_run(tmp_path / "runs" / name)
    printed = run(
        "tangram-play", "compare=[runs/one,runs/two]", "out=both.png", "episodes=2", cwd=tmp_path
    )
    assert "one: mean raw overlap" in printed
    with Image.open(tmp_path / "both.png") as picture:
        assert picture.format == "PNG"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "say which run: run_dir=runs/..., or which ones: compare=[runs/a,runs/b]"),
        (("run_dir=a", "compare=[b,c]"), "do not go together"),
        (("compare=one",), "compare must list 2 to 4 folders of runs, got 'one'"),
        (("compare=[one]",), "compare must list 2 to 4 folders of runs"),
        (("run_dir=pretrained/nobody",), "no pretrained agent 'nobody': choose from"),
    ],
)
def test_wrong_choices_of_runs_are_one_line(
    tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    line = refused("tangram-play", *arguments, cwd=tmp_path)
    assert line.startswith("tangram-play: ")
    assert words in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", agent_names())
def test_an_agent_of_the_package_is_scored_from_any_folder(tmp_path: Path, name: str) -> None:
    arguments = (f"run_dir=pretrained/{name}", "episodes=20", "seed=1", "out=scores.json")
    run_here("tangram-eval", *arguments, cwd=tmp_path)
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert scores["mean_reward"] > 0.9
    assert scores["run_dir"] == f"pretrained/{name}"
