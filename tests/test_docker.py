"""The images and the compose file, as far as they can be judged without a docker daemon."""

import ast
import re
import runpy
import shlex
import sys
import tomllib
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import pytest
import yaml

from conf.cli import composed
from tangram_cli.commands import COMMANDS

pytestmark = pytest.mark.fast

ROOT = Path(__file__).parents[1]
OURS = {"conf", "master", "worker"}
OURS |= {f"tangram_{name}" for name in ("agent", "core", "game", "sim", "tasks", "vision")}
DOCKER = ROOT / "docker"
COMPOSE: dict[str, Any] = yaml.safe_load((DOCKER / "docker-compose.yml").read_text())
# Neither plays nor learns: the figures of reports.
LEFT_OUT = {"matplotlib", "pandas"}
DISTRIBUTIONS = cache(packages_distributions)  # of all that is installed: a second
EXTRAS = {"av", "onnx", "onnxruntime"}  # of films and exported agents, which no container makes


def requirements(name: str) -> set[str]:
    """Names in a list of an image, those that it refers to included."""
    found: set[str] = set()
    for line in (DOCKER / name).read_text().splitlines():
        if line.startswith("-r "):
            found |= requirements(line.removeprefix("-r "))
        elif line and not line.startswith("#"):
            found.add(line.partition(" ;")[0])
    return found


def defaults() -> dict[str, str]:
    lines = (DOCKER / ".env").read_text().splitlines()
    return dict(line.split("=", 1) for line in lines if line and not line.startswith("#"))


def filled(text: str) -> str:
    """A command with the defaults of docker/.env."""
    return re.sub(r"\$\{(\w+)(?::-[^}]*)?\}", lambda match: defaults()[match[1]], text)


def stages() -> dict[str, str]:
    """Stage -> what it is made from."""
    text = (DOCKER / "Dockerfile").read_text()
    return {name: base for base, name in re.findall(r"^FROM (\S+) AS (\S+)", text, re.MULTILINE)}


def test_images_have_all_that_the_project_needs_and_nothing_else() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = {re.match(r"[\w-]+", text)[0] for text in project["dependencies"]}  # type: ignore[index]
    assert requirements("worker.txt") | requirements("master.txt") == wanted - LEFT_OUT
    assert "tensorboard" not in requirements("worker.txt")
    assert "pybullet" not in requirements("master.txt")


@pytest.mark.parametrize(
    ("image", "more"),
    [("master", []), ("worker", ["tangram_game", "tangram_tasks", "tangram_vision"])],
)
def test_what_an_image_imports_is_in_it(image: str, more: list[str]) -> None:
    """Of tangram_sim each image has what it uses: the tests of the house look at that."""
    distributions, lacking = DISTRIBUTIONS(), set()
    packages = (image, "tangram_agent", "tangram_core", *more)
    for path in (path for name in packages for path in (ROOT / name).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [one.name for one in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            for name in {name.partition(".")[0] for name in names} - OURS:
                known = {one.lower().replace("_", "-") for one in distributions.get(name, [name])}
                lacking |= set() if known & requirements(f"{image}.txt") else {name}
    assert lacking - EXTRAS - sys.stdlib_module_names == set()


def test_the_targets_are_there() -> None:
    assert {"worker", "master-cpu", "master-gpu", "test"} <= stages().keys()
    assert list(stages())[-1] == "master-gpu"  # a builder that makes all stages stops before it
    built = {s["build"]["target"] for s in COMPOSE["services"].values()}
    assert built == {"worker", "master-cpu", "master-gpu"}


@pytest.mark.parametrize("name", ["Dockerfile", "apptainer.def"])
def test_images_take_nothing_without_a_hash(name: str) -> None:
    text = (DOCKER / name).read_text().replace("\\\n", "")
    installs = re.findall(r"pip install (.*)", text)
    assert len(installs) >= 3
    for one in installs:
        assert "--require-hashes" in one or "--no-deps --no-build-isolation ." in one


@pytest.mark.parametrize("service", COMPOSE["services"])
def test_a_service_has_no_rights_and_writes_to_its_volume_only(service: str) -> None:
    about = COMPOSE["services"][service]
    assert about["cap_drop"] == ["ALL"]
    assert about["security_opt"] == ["no-new-privileges:true"]
    assert about["read_only"] is True
    assert (about["volumes"], about["tmpfs"]) == (["runs:/runs"], ["/tmp:size=256m"])
    assert about["pids_limit"] == 512
    assert not about.keys() & {"cap_add", "privileged", "network_mode", "pid"}


def test_connection_files_stay_out_of_images_and_commits() -> None:
    """tangram-keys leaves them in the current folder, often that of a clone, and they have keys."""
    assert "*.json" in (ROOT / ".dockerignore").read_text().splitlines()
    assert "/*.json" in (ROOT / ".gitignore").read_text().splitlines()


def test_nothing_runs_as_root() -> None:
    text = (DOCKER / "Dockerfile").read_text()
    stages = re.split(r"^FROM ", text, flags=re.MULTILINE)[1:]
    users = {stage.split()[2]: "\nUSER 10001\n" in stage for stage in stages}
    assert {name for name, user in users.items() if user} >= {"worker", "master-cpu", "test"}


@pytest.mark.parametrize("service", ["master", "master-gpu", "worker", "evaluator"])
def test_commands_of_the_compose_file_are_settings_that_exist(service: str) -> None:
    primary = "master" if service.startswith("master") else "worker"
    command = COMPOSE["services"][service]["command"].replace("${RUN:-run}", "lr=1e-3 ü")
    config = composed(primary, shlex.split(filled(command)))
    assert "/runs/lr=1e-3 ü" in (config.get("run_dir"), config.get("connect"))


def test_the_command_of_the_master_image_exists() -> None:
    text = (DOCKER / "Dockerfile").read_text().replace("\\\n", "")
    commands = [
        re.findall(r'"([^"]+)"', line) for line in re.findall(r"^CMD (.*)$", text, re.MULTILINE)
    ]
    composed("worker", commands[0])
    composed("master", commands[1])


def test_every_variable_has_a_default_that_the_file_shows() -> None:
    text = (DOCKER / "docker-compose.yml").read_text()
    used = dict(re.findall(r"\$\{(\w+):-([^}]*)\}", text))
    shown = defaults()
    assert {name: shown[name] for name in used} == used
    assert shown.keys() - used.keys() == {"COMPOSE_PROFILES"}
    assert len(re.findall(r"\$\{", text)) == len(re.findall(r"\$\{\w+:-", text))


def test_ports_reach_this_machine_only() -> None:
    for service in COMPOSE["services"].values():
        for port in service.get("ports", ()):
            assert port.startswith("127.0.0.1:")


def test_a_master_has_time_for_its_checkpoint() -> None:
    assert COMPOSE["services"]["master"]["stop_grace_period"] == "120s"
    assert all(service["restart"] == "on-failure" for service in COMPOSE["services"].values())


@pytest.mark.parametrize(("status", "told"), [(0, 0), (1, 1), (2, 0), (75, 75)])
def test_wrong_settings_alone_end_a_container_for_good(
    monkeypatch: pytest.MonkeyPatch, status: int, told: int
) -> None:
    monkeypatch.setattr(sys, "argv", ["entry.py", "worker", "seed=1"])
    monkeypatch.setitem(COMMANDS, "worker", lambda: status if sys.argv[1:] == ["seed=1"] else -1)
    with pytest.raises(SystemExit) as caught:
        runpy.run_path(str(DOCKER / "entry.py"), run_name="__main__")
    assert caught.value.code == told
    for service in COMPOSE["services"].values():
        image = service["build"]["target"]
        own = service["entrypoint"][:2] == ["python3", "/opt/tangram/entry.py"]
        assert own == ("tensorboard" not in service["entrypoint"])
        assert not own or image.startswith(service["entrypoint"][2])
