"""The rules of the house: arrows, packaging, tiers of tests."""

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import EntryPoint
from itertools import chain
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from setuptools import find_packages

from tangram_cli.commands import COMMANDS

pytestmark = pytest.mark.fast

ROOT = Path(__file__).parents[1]
OURS = (
    "tangram_agent",
    "tangram_cli",
    "tangram_core",
    "tangram_game",
    "tangram_lab",
    "tangram_sim",
    "tangram_studio",
    "tangram_tasks",
    "tangram_vision",
)
PACKAGES = ("conf", "master", "worker", *OURS)


def run(command: list[str], cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Without what `make test ARGS=...` would hand on to another make."""
    handed = ("MAKE", "ARGS", "BUDGET")
    own = {name: value for name, value in os.environ.items() if not name.startswith(handed)}
    return subprocess.run(
        command, cwd=cwd, env=own, capture_output=True, text=True, check=False, timeout=60
    )


def run_python(code: str) -> str:
    result = run([sys.executable, "-c", code])
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


# Arrows


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    tool = Path(sys.executable).with_name("lint-imports")
    return run([str(tool), "--no-cache", "--no-logo"], cwd=folder)


def test_import_contracts_catch_every_wrong_arrow(tmp_path: Path) -> None:
    for name in PACKAGES:
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    wrong = {
        "tangram_sim/wrong.py": "import torch, pybullet, cv2, zmq, omegaconf",
        "tangram_sim/geometry/wrong.py": "import tangram_sim.world.engine",
        "tangram_agent/wrong.py": "import worker.config, conf.help, tangram_vision.pictures.seeing",
        "master/wrong.py": "import tangram_lab.experiments.studies, tangram_sim.wrong, uvicorn",
        "master/record/wrong.py": "import master.hub.hub",
        "worker/talk/wrong.py": "import worker.play.rollout",
        "tangram_game/show/wrong.py": "import master.config, tangram_game.figures.puzzles",
        "tangram_vision/pictures/wrong.py": "import tangram_vision.given.photos",
        "tangram_lab/benchmarks/trials/wrong.py": "import tangram_lab.benchmarks.speed.wire",
    }
    for path, code in wrong.items():
        (tmp_path / path).write_text(code)
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    result = lint_imports(tmp_path)
    assert f"0 kept, {len(contracts['contracts'])} broken" in result.stdout, result.stdout


def test_command_lines_load_nothing_heavy() -> None:
    loaded = run_python(
        "import master.cli, tangram_cli.commands, tangram_lab.benchmarks.cli, sys\n"
        "import tangram_game.cli, tangram_lab.experiments.cli, tangram_studio.cli, worker.cli\n"
        "print({'torch', 'numpy', 'hydra', 'zmq', 'gymnasium'} & set(sys.modules))"
    )
    assert loaded == "set()"


# Packaging


def test_console_scripts_come_through_the_door() -> None:
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts.keys() == {f"tangram-{command}" for command in COMMANDS}
    for name, place in scripts.items():
        script = EntryPoint(name, place, "console_scripts")
        assert script.module == "tangram_cli.commands"
        assert script.load() is COMMANDS[name.removeprefix("tangram-")]


def test_every_package_is_installed() -> None:
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]
    how = tools["setuptools"]["packages"]["find"]
    assert how.pop("namespaces") is False
    code = {path.parent for name in PACKAGES for path in (ROOT / name).rglob("*.py")}
    found = {".".join(path.relative_to(ROOT).parts) for path in code}
    assert found == set(find_packages(str(ROOT), **how))


# Folders


def test_a_folder_has_at_most_twelve_files_and_says_what_is_in_it() -> None:
    for folder in {path.parent for name in PACKAGES for path in (ROOT / name).rglob("*.py")}:
        place = str(folder.relative_to(ROOT))
        assert len(list(folder.glob("*.py"))) <= 12, place
        told = ast.get_docstring(ast.parse((folder / "__init__.py").read_text()))
        assert told is not None, place
        assert len(told.splitlines()) <= 10, place


def locked() -> dict[str, list[str]]:
    """`name==version`, with its marker where it has one -> hashes."""
    lines = (ROOT / "lock.txt").read_text().replace("\\\n", "").splitlines()
    parts = (re.split(r"\s+--hash=", line) for line in lines if not line.startswith("#"))
    return {pin: hashes for pin, *hashes in parts}


def test_the_lock_has_all_that_is_required_each_file_by_its_hash() -> None:
    """Of the project, of its extras, of what builds it, and of the images."""
    pins = locked()
    for pin, hashes in pins.items():
        assert hashes, f"{pin} has no hash"
        assert all(re.fullmatch("sha256:[0-9a-f]{64}", one) for one in hashes), pin
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    assert [line for line in lines if not line.startswith("#")] == list(pins), "make lock"
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project = settings["project"]
    lists = [path.read_text().splitlines() for path in (ROOT / "docker").glob("*.txt")]
    extras = project["optional-dependencies"].values()
    wanted = [*project["dependencies"], *settings["build-system"]["requires"], *chain(*extras)]
    wanted += [line for line in chain(*lists) if line[:1].isalpha()]
    versions = dict(pin.partition(" ;")[0].split("==") for pin in pins)
    for one in map(Requirement, wanted):
        assert one.specifier.contains(versions[canonicalize_name(one.name)]), f"{one}: make lock"


def test_every_file_that_is_no_code_is_package_data() -> None:
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"][
        "package-data"
    ]
    packed = {p for name, own in patterns.items() for one in own for p in (ROOT / name).glob(one)}
    every = {path for name in PACKAGES for path in (ROOT / name).rglob("*.*") if path.is_file()}
    data = {p for p in every if p.suffix not in (".py", ".pyc") and p.name != "README.md"}
    assert packed == data


# The Makefile


@pytest.mark.parametrize(
    ("given", "refused"),
    [
        ("seed=7", True),
        ("ARG=seed=7", True),
        ("tokens.scale=2", True),
        ("ARGS=seed=7 tokens=square", False),
        ("BUDGET=smoke", False),
    ],
)
def test_make_refuses_a_variable_that_it_would_drop(given: str, refused: bool) -> None:
    result = run(["make", "--dry-run", "help", given])
    assert (result.returncode != 0) == refused
    name = given.partition("=")[0]
    assert (f'make knows no {name}=...: settings go into ARGS="..."' in result.stderr) == refused
