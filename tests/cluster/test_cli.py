"""The commands, started from another folder: their help, and what they refuse."""

import hashlib
import json
import os
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest
import yaml

from conf.cli import composed
from tangram_cli.commands import COMMANDS, run
from tests.cluster.processes import BIN, ended, here, refused

pytestmark = pytest.mark.cluster

ROOT = Path(__file__).parents[2]
TRAINING = ("tangram-train", "tangram-master", "tangram-worker")
WITH_HELP = (
    *TRAINING,
    "tangram-keys",
    "tangram-eval",
    "tangram-play",
    "tangram-export",
    "tangram-studio",
    "tangram-experiment",
    "tangram-report",
)
# One of the settings that a command's help explains.
SETTING = {
    "tangram-worker": "role: player",
    "tangram-keys": "add: null",
    "tangram-export": "out: runs/agent.onnx",
    "tangram-studio": "port: 8765",
    "tangram-experiment": "jobs: 2",
    "tangram-report": "runs: null",
}


@pytest.mark.parametrize(("given", "found"), [(None, "1"), ("4", "4")])
def test_numpy_computes_in_one_thread_unless_told_otherwise(
    monkeypatch: pytest.MonkeyPatch, given: str | None, found: str
) -> None:
    monkeypatch.setattr(os, "environ", {"OPENBLAS_NUM_THREADS": given} if given else {})
    monkeypatch.setattr(sys, "meta_path", list(sys.meta_path))
    assert run("os", "getpid") == os.getpid()
    assert os.environ["OPENBLAS_NUM_THREADS"] == found


@pytest.mark.parametrize("place", ["tangram_cli.commands.import_module", "master.cli.entry"])
def test_ctrl_c_ends_a_command_without_a_word_also_while_it_loads(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], place: str
) -> None:
    monkeypatch.setattr(place, Mock(side_effect=KeyboardInterrupt))
    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path])
    assert COMMANDS["train"]() == 130
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("command", WITH_HELP)
def test_help_config_and_version_are_shown_and_leave_nothing_behind(
    tmp_path: Path, command: str
) -> None:
    status, out, err = here(command, "--help", cwd=tmp_path)
    assert (status, err) == (0, "")
    text, _, examples = out.partition("Examples:\n")
    assert [line.split()[0] for line in examples.strip().splitlines()] == [command] * 3
    if command in TRAINING:
        assert "  agent    goal, goal_large, mlp, outline, paper, push, quick, tangram*, or" in text
        for group in ("tokens", "sim", "reward", "net", "service"):
            assert f"\n  {group} " in text
    assert SETTING.get(command, "seed: 0") in text
    assert here(command, "--version", cwd=tmp_path)[1].startswith(f"{command} 0.")
    status, out, err = here(command, "hydra.verbose=false", "--cfg", "job", cwd=tmp_path)
    assert (status, err) == (0, "")
    assert "hydra" not in out
    assert list(tmp_path.iterdir()) == []


WRONG = [
    ("tangram-train sed=1", "unknown setting 'sed' (did you mean 'seed'?)"),
    ("tangram-train noise=1", "unknown setting 'noise' (did you mean 'agent.noise'?)"),
    ("tangram-train sim.observe=silhouette", "is for an agent of outlines: train one"),
    ("tangram-train +~zzz", "cannot read '+~zzz'"),
    ("tangram-train zzz=1", "unknown setting 'zzz' (--help and --cfg job list them)"),
    ("tangram-train --seed=1", "unknown option '--seed=1': settings have no dashes, as in seed=1"),
    ("tangram-train seed=1 --cfg jobs", "--cfg takes job, hydra, all, got 'jobs'"),
    ("tangram-train -m seed=1 --cfg job", "--cfg and --multirun do not go together"),
    ("tangram-train seed", "cannot read 'seed': write name=value"),
    ("tangram-train tokens.shapes=[square", "cannot read 'tokens.shapes=[square'"),
    ("tangram-train seed=1,2", "Ambiguous value for argument 'seed=1,2': write [1,2] for a list"),
    ("tangram-train run_dir=${foo}", "cannot resolve the config: Interpolation key 'foo'"),
    (
        "tangram-train agent=best",
        "unknown agent 'best': choose from goal, goal_large, mlp, outline, paper, push, quick, t",
    ),
    ("tangram-train seed=abc", "seed must be a whole number, got abc"),
    ("tangram-train run_dir=", "run_dir must name a folder"),
    (
        "tangram-experiment run_dir=/dev/null",
        "run_dir=/dev/null/paper.csv cannot be written",
    ),
    (
        f"tangram-train run_dir=a/{'x' * 256}",
        "run_dir must be a path of at most 3840 bytes, 255 in",
    ),
    (f"tangram-play run_dir={'x/' * 2000}", "run_dir must be a path of at most 3840 bytes"),
    ("tangram-master +sim.colour=1", "there is no setting sim.colour: delete it"),
    ("tangram-worker connect=tcp://127.0.0.1:1 reward.name=own.py:none", "cannot read 'own.py' on"),
    ("tangram-train tokens.shapes=[square,square,square] tokens.scale=2.2", "no room for token"),
    ("tangram-master tokens.scale=1000", "does not fit into an arena of width 2"),
    (
        "tangram-train task=gym task.id=Wears-v0 task.imports=[tests.core.toy] "
        "service.mode=lockstep",
        "depend on earlier ones: set task.fresh=true",
    ),
    ("tangram-master run_dir=/proc/tangram", "run_dir /proc/tangram cannot be made"),
    ("tangram-worker", "say which run: connect=runs/..., or connect= a copy"),
    ("tangram-status connect=tcp://127.0.0.1:65536", "port from 1 to 65535"),
    ("tangram-eval run_dir=pretrained/square puzzle=test", "puzzle 'trapezoid' has the pieces"),
    ("tangram-eval run_dir=pretrained/square sim.mirrored=0.5", "sim.mirrored"),
    ("tangram-eval run_dir=pretrained/square out=..", "cannot be written (it is a folder): name"),
    ("tangram-play run_dir=pretrained/square out=/proc/a.gif", "out=/proc/a.gif cannot be written"),
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
    """A console script of this environment."""
    command, *arguments = line.split()
    env = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "HYDRA_FULL_ERROR")}
    done = ended(BIN / command, *arguments, cwd=tmp_path, env=env)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"{command}: ")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "line", ["tangram-train", "tangram-master", "tangram-worker connect=tcp://127.0.0.1:1"]
)
def test_an_own_reward_that_fails_is_told_before_anything_starts(tmp_path: Path, line: str) -> None:
    (tmp_path / "own.py").write_text("def near(achieved, desired, layout): return 1 / 0")
    told = refused(*line.split(), "reward.name=own.py:near", cwd=tmp_path)
    assert "own.py:near failed: ZeroDivisionError" in told
    assert [path.name for path in tmp_path.iterdir()] == ["own.py"]


MARKS = """
from pathlib import Path
Path(__file__).with_name("loaded").touch()
def near(achieved, desired, layout): return -abs(achieved - desired).mean(axis=(1, 2))
"""
READ = [
    "tangram-worker connect=run",
    "tangram-worker connect=run/connection.json role=evaluator",
    "tangram-worker connect=tcp://127.0.0.1:1 from_config=run/config.yaml",
    "tangram-train from_config=run/config.yaml",
    "tangram-master from_config=run/config.yaml run_dir=run resume=auto",
    "tangram-eval run_dir=run",
    "tangram-play run_dir=run",
    "tangram-train --config-dir presets reward=mine",
]


@pytest.mark.parametrize(("line", "folder"), [*((line, ".") for line in READ), (READ[0], "{}")])
def test_code_is_loaded_only_if_the_command_line_names_it(
    tmp_path: Path, line: str, folder: str
) -> None:
    """Not from the working folder either, where a file may lie that somebody else has named."""
    name, digest = f"{folder.format(tmp_path)}/own.py:near", "0" * 64
    (tmp_path / "own.py").write_text(MARKS)
    settings = composed("train", []) | {"reward": {"name": name, "sha256": digest}}
    connection = {"endpoint": "tcp://127.0.0.1:1", "run_id": "a" * 16, "settings": settings}
    for place, content in (
        ("run/config.yaml", yaml.safe_dump(settings)),
        ("run/connection.json", json.dumps(connection)),
        ("presets/reward/mine.yaml", yaml.safe_dump(settings["reward"])),
    ):
        path = tmp_path / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    before = sorted(tmp_path.rglob("*"))
    told = refused(*line.split(), cwd=tmp_path)
    assert f"name code, {name} (sha256 {digest}), which is not loaded unless you name it: " in told
    assert told.endswith(f"add reward.name={name} if you trust it")
    told = refused(*line.split(), f"reward.name={name}", cwd=tmp_path)
    found = hashlib.sha256(MARKS.encode()).hexdigest()
    other = f"has sha256 {found}, and the settings of the run want {digest}"
    assert (other in told) != ("no checkpoint in" in told)  # which eval and play look for first
    assert sorted(tmp_path.rglob("*")) == before


def test_a_warm_start_from_nowhere_is_refused(tmp_path: Path) -> None:
    line = refused("tangram-train", "run_dir=x", "warm_start=nowhere", cwd=tmp_path)
    assert line.startswith(f"tangram-train: warm_start={tmp_path / 'nowhere'} has no checkpoint")


def test_a_command_that_there_is_not_is_told(tmp_path: Path) -> None:
    done = ended(sys.executable, "-m", "tangram_cli", "trian", cwd=tmp_path)
    told = f"tangram_cli: name a command: {', '.join(COMMANDS)}\n"
    assert (done.returncode, done.stderr) == (1, told)
