"""What a run has come to: the final table, and commands that can be pasted."""

import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from master.record.rundir import RunFolder
from master.watch.result import commit, go_on_command, show_result
from tangram_core.scores import written
from tangram_tasks.place import ONE_TOKEN
from tests.master.builders import screen, text
from tests.master.watch.test_console import BRACKETS

pytestmark = pytest.mark.fast

SCORED = {
    "mean_reward": 0.9312,
    "coverage": 0.9656,
    "angle_error_deg_median": 1.214,
    "position_error_median": 0.01034,
}


RESULT = dict.fromkeys(score.name for score in ONE_TOKEN) | {
    "scores": written(ONE_TOKEN),
    "scored_updates": None,
    "updates": 1234,
    "episodes": 5678,
    "train_s": 61.0,
    "wall_s": 75.0,
    "ended_by": "max_updates=1234",
}


@pytest.mark.parametrize(
    ("change", "words", "without"),
    [
        ({}, ["none: no evaluator took part", "1:01 of training, 1:15 in all"], ["mean reward"]),
        (
            SCORED | {"scored_updates": 1234},
            ["mean reward", "0.931", "1.21°", "0.0103", "1,234"],
            ["weights after"],
        ),
        (SCORED | {"scored_updates": 1000}, ["weights after 1,000 updates"], ["go on"]),
        (
            {"scores": written([BRACKETS]), "speed": 1.5, "scored_updates": 1234},
            ["speed [m/s] [/]", "1.500"],
            [],
        ),
        ({"ended_by": "SIGINT"}, ["Ctrl-C (SIGINT)", "go on           tangram-train r"], []),
    ],
)
def test_the_final_table(
    tmp_path: Path, change: dict[str, Any], words: list[str], without: list[str]
) -> None:
    shown, folder = screen(), RunFolder(tmp_path / ("deep_" * 30))
    show_result(shown, folder, RESULT | change, {}, "tangram-train r")
    assert all(word in text(shown) for word in words)
    assert not any(word in text(shown) for word in without)
    assert f"tangram-eval run_dir={folder.path}" in text(shown)
    assert f"tensorboard --logdir {folder.path}/tensorboard" in text(shown)
    assert "test_episodes.png" not in text(shown)
    folder.path.mkdir()
    folder.picture.touch()
    show_result(shown, folder, RESULT | change, {})
    assert f"tangram-play run_dir={folder.path} out={folder.path}/play.gif" in text(shown)
    assert "test_episodes.png" in text(shown)


@pytest.mark.parametrize(("launched", "name"), [(True, "tangram-train"), (False, "tangram-master")])
def test_the_command_that_goes_on_has_the_workers_and_the_code_of_before(
    tmp_path: Path, launched: bool, name: str
) -> None:
    folder = RunFolder(tmp_path)
    bounds = {"max_hours": 0.0, "max_episodes": 0, "max_updates": 2000}
    (tmp_path / "own.py").touch()
    reward = {"reward": {"name": f"{tmp_path}/own.py:near"}}
    folder.write_config({"seed": 3, **bounds, "workers": 2, **reward})
    settings = f"run_dir={tmp_path} from_config={tmp_path}/config.yaml resume=auto seed=3 workers=2"
    own = f"reward.name={tmp_path}/own.py:near"
    assert go_on_command(folder, launched).endswith(f"{name} {settings} {own}")


@pytest.mark.parametrize("active", [True, False])
def test_commands_that_are_shown_can_be_pasted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, active: bool
) -> None:
    """Whether the environment is on or not, as after `make train`."""
    commands = Path(sys.executable).parent
    monkeypatch.setenv("PATH", str(commands) if active else str(tmp_path))
    shown, folder = screen(), RunFolder(tmp_path / "it's a=run")
    folder.path.mkdir()
    folder.picture.touch()
    show_result(shown, folder, RESULT, {})
    curves, play = (shlex.split(line) for line in text(shown).splitlines()[-2:])
    assert curves[-1] == str(folder.tensorboard)
    for command in (curves[-3], play[-3]):
        assert command == Path(command).name if active else Path(command).parent == commands
        assert (commands / command).exists()
    (parsed,) = OverridesParser.create().parse_overrides([play[-2]])
    assert parsed.value() == str(folder.path)


def test_results_that_an_experiment_writes_do_not_make_a_commit_dirty_and_code_does(
    tmp_path: Path,
) -> None:
    def git(*words: str) -> str:
        said = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b", *words]
        return subprocess.run(said, capture_output=True, text=True, check=True).stdout.strip()

    assert commit(tmp_path) is None
    (tmp_path / "docs" / "results").mkdir(parents=True)
    code, row = tmp_path / "code.py", tmp_path / "docs" / "results" / "rows.csv"
    for file in (code, row):
        file.write_text("1")
    for words in (["init", "-q"], ["add", "-A"], ["commit", "-qm", "first"]):
        git(*words)
    head = git("rev-parse", "HEAD")
    row.write_text("2")
    assert commit(tmp_path) == head
    code.write_text("2")
    assert commit(tmp_path) == f"{head}-dirty"
    (tmp_path / ".git" / "index").write_text("damaged")
    assert commit(tmp_path) is None
