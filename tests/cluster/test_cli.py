"""The commands, started from another folder: their help, and what they refuse."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cluster.processes import here, refused

pytestmark = pytest.mark.cluster

COMMANDS = (
    "tangram-train",
    "tangram-master",
    "tangram-worker",
    "tangram-eval",
    "tangram-play",
    "tangram-experiment",
    "tangram-report",
)
WITH_GROUPS = COMMANDS[:3]
# One of the settings that a command's help explains.
SETTING = {
    "tangram-worker": "role: player",
    "tangram-experiment": "jobs: 2",
    "tangram-report": "runs: ???",
}
LIMIT_S = 60


def run(folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    """A console script of this environment, started in a folder of its own."""
    script, *arguments = command
    environment = {
        k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "HYDRA_FULL_ERROR")
    }
    return subprocess.run(
        [str(Path(sys.executable).with_name(script)), *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_help(tmp_path: Path, command: str) -> None:
    result = run(tmp_path, command, "--help")
    assert (result.returncode, result.stderr) == (0, "")
    text, _, examples = result.stdout.partition("Examples:\n")
    assert [line.split()[0] for line in examples.strip().splitlines()] == [command] * 3
    if command in WITH_GROUPS:
        assert "  agent    mlp, paper, tangram*\n" in text
        for group in ("tokens", "sim", "reward", "net", "service"):
            assert f"\n  {group} " in text
    assert SETTING.get(command, "seed: 0") in text


WRONG = [
    ("tangram-train sed=1", "unknown setting 'sed' (did you mean 'seed'?)"),
    ("tangram-train noise=1", "unknown setting 'noise' (did you mean 'agent.noise'?)"),
    ("tangram-train agent.gama=0", "unknown setting 'agent.gama' (did you mean 'agent.gamma'?)"),
    ("tangram-train ~zzz", "unknown setting 'zzz' (--help and --cfg job list them)"),
    ("tangram-train --seed=1", "unknown option '--seed=1': settings carry no dashes, as in seed=1"),
    ("tangram-train seed=1 --cfg jobs", "--cfg takes job, hydra, all, got 'jobs'"),
    ("tangram-train -m seed=1 --cfg job", "--cfg and --multirun do not go together"),
    ("tangram-train seed", "cannot read 'seed': write name=value"),
    ("tangram-train tokens.shapes=[square", "cannot read 'tokens.shapes=[square'"),
    ("tangram-train seed=1,2", "Ambiguous value for argument 'seed=1,2': a list is [1,2]"),
    ("tangram-train run_dir=${foo}", "cannot resolve the config: Interpolation key 'foo'"),
    ("tangram-train agent=best", "unknown agent 'best': choose from mlp, paper, tangram"),
    ("tangram-train tokens=pentagon", "unknown tokens 'pentagon': choose from hexagon, large_tri"),
    ("tangram-train tokens.shapes=[blob]", "unknown shape 'blob': choose from large_triangle"),
    ("tangram-master tokens.shapes=[blob]", "unknown shape 'blob': choose from large_triangle"),
    ("tangram-train workers=0", "workers must be at least 1, got 0"),
    ("tangram-train seed=abc", 'field "seed" - should be "int"'),
    ("tangram-train run_dir=", "run_dir must name a folder"),
    ("tangram-master +sim.colour=1", 'can not match "colour"'),
    ("tangram-master from_config=nowhere.yaml", "from_config=nowhere.yaml: No such file"),
    ("tangram-worker connect=tcp://127.0.0.1:1 reward.name=own.py:none", "cannot read 'own.py' on"),
    ("tangram-train tokens.shapes=[square,square,square] tokens.scale=2.2", "no room for token"),
    ("tangram-worker", "say which master: connect=tcp://host:port"),
    ("tangram-worker connect=tcp://127.0.0.1:1 role=judge", "role must be one of player, evalu"),
    ("tangram-eval", "say which run: run_dir=runs/..."),
    ("tangram-eval run_dir=runs/x episodes=0", "episodes must be between 1 and"),
    ("tangram-play", "say which run: run_dir=runs/..."),
    ("tangram-eval run_dir=pretrained/square puzzles=test", "puzzle 'trapezoid' has the pieces"),
    ("tangram-eval run_dir=pretrained/square puzzles=nowhere.json", "nowhere.json"),
    ("tangram-eval run_dir=pretrained/square agent.order=size", "nothing with one token"),
    ("tangram-play tokens=nobody", "no pretrained agent 'nobody': choose from pretrained/"),
    ("tangram-play tokens=pair run_dir=pretrained/square", "do not agree: the run moves square"),
    ("tangram-play runs_dir=x", "unknown setting 'runs_dir' (did you mean 'run_dir'?)"),
]


@pytest.mark.parametrize(("line", "message"), WRONG)
def test_wrong_input_is_one_line(tmp_path: Path, line: str, message: str) -> None:
    command, *arguments = line.split()
    told = refused(command, *arguments, cwd=tmp_path)
    assert told.startswith(f"{command}: ")
    assert message in told
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "line", ["tangram-train sed=1", "tangram-worker", "tangram-eval run_dir=x"]
)
def test_a_process_says_one_line_and_no_warning(tmp_path: Path, line: str) -> None:
    result = run(tmp_path, *line.split())
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith(f"{line.split(maxsplit=1)[0]}: ")
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "line", ["tangram-train", "tangram-master", "tangram-worker connect=tcp://127.0.0.1:1"]
)
def test_an_own_reward_that_fails_is_told_before_anything_starts(tmp_path: Path, line: str) -> None:
    (tmp_path / "own.py").write_text("def near(achieved, desired, layout): return 1 / 0")
    told = refused(*line.split(), "reward.name=own.py:near", cwd=tmp_path)
    assert "own.py:near failed: ZeroDivisionError" in told
    assert [path.name for path in tmp_path.iterdir()] == ["own.py"]


@pytest.mark.parametrize("command", COMMANDS)
def test_config_and_version_are_shown_and_leave_nothing_behind(
    tmp_path: Path, command: str
) -> None:
    assert here(command, "--version", cwd=tmp_path)[1].startswith(f"{command} 0.")
    status, out, err = here(command, "hydra.verbose=false", "--cfg", "job", cwd=tmp_path)
    assert (status, err) == (0, "")
    assert "hydra" not in out
    assert list(tmp_path.iterdir()) == []
