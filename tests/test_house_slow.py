"""Rules of the house that start other processes to be seen: tiers of tests, no engine, the site."""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Any
from unittest import mock
from zipfile import ZipFile

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.blocks import PAGES
from tests.conftest import (
    SECONDS,
    pytest_collection_modifyitems,
)
from tests.test_house import ROOT, locked, run, run_python

pytestmark = pytest.mark.slow


def test_master_and_registration_never_load_the_engine() -> None:
    loaded = run_python(
        "import gymnasium, master.cli, master.launch, master.run, sys, tangram_tasks.register\n"
        "assert 'Tangram-v0' in gymnasium.registry\n"
        "print([name for name in sys.modules if name.startswith(('pybullet', 'cv2'))])"
    )
    assert loaded == "[]"


def test_the_launcher_needs_no_torch() -> None:
    """It would start the master two seconds later, and hold 200 MB for as long as that trains."""
    needs = "master.launch, tangram_agent.agents.pair.agent, tangram_agent.agents.outline.agent"
    assert run_python(f"import sys, {needs}\nprint('torch' in sys.modules)") == "False"


@pytest.mark.parametrize(
    "line",
    [
        "eval episodes=3 sim.targets=fly",
        "play puzzle=nowhere.json",
        "play target=nowhere.png",
        "play silhouette=nowhere.png",
    ],
)
def test_what_cannot_be_played_is_refused_without_torch_or_opencv(line: str) -> None:
    given = [*line.split(), "run_dir=pretrained/tangram7"]
    told = run_python(
        "import sys\n"
        "from tangram_game.cli import evaluate, play\n"
        f"command, *sys.argv[1:] = {given}\n"
        "print({'eval': evaluate, 'play': play}[command](), {'torch', 'cv2'} & set(sys.modules))"
    )
    assert told == "2 set()"


def test_learning_needs_no_compiler() -> None:
    """Its import would take the master more than a second and 70 MB."""
    told = run_python(
        "import sys\n"
        "import numpy as np\n"
        "from tests.agent.builders import SCENE, random_transitions, setup\n"
        "made = setup(agent=SCENE)\n"
        "own = made.agent.learner(made.task, 0)\n"
        "own.learn(own.steps(random_transitions(made, 4), np.random.default_rng(0)))\n"
        "print('torch._dynamo' in sys.modules)"
    )
    assert told == "False"


def collected(expression: str, *tests: set[str]) -> list[str]:
    """Names of tests with these markers, by numbers, that run with -m."""
    config = mock.Mock(**{"option.markexpr": expression})
    items: list[Any] = [
        mock.Mock(nodeid=str(number), fixturenames=(), get_closest_marker=marks.__contains__)
        for number, marks in enumerate(tests)
    ]
    pytest_collection_modifyitems(config, items)
    return [item.nodeid for item in items]


@pytest.mark.parametrize(("tiers", "has"), [(set(), "none"), ({"fast", "slow"}, "fast, slow")])
def test_each_test_carries_one_tier(tiers: set[str], has: str) -> None:
    told = f"0 must carry exactly one of the markers .*, has {has}$"
    with pytest.raises(pytest.UsageError, match=told):
        collected("", tiers)


@pytest.mark.parametrize(
    ("expression", "run"), [("", ["0"]), ("fast", ["0"]), ("check or slow", ["0", "1"])]
)
def test_what_is_too_long_for_the_gate_runs_by_its_name(expression: str, run: list[str]) -> None:
    assert collected(expression, {"fast"}, {"fast", "check"}) == run


def test_the_longest_tests_are_there_and_come_first() -> None:
    for name in SECONDS:
        file, _, test = name.partition("::")
        texts = [path.read_text() for path in (ROOT / "tests").rglob(file)]
        assert any(f"def {test}" in text for text in texts), name
    items: list[Any] = [
        mock.Mock(nodeid=name, fixturenames=(), get_closest_marker={"slow"}.__contains__)
        for name in ("other", *reversed(SECONDS))
    ]
    pytest_collection_modifyitems(mock.Mock(**{"option.markexpr": ""}), items)
    assert [item.nodeid for item in items[:1] + items[-1:]] == [next(iter(SECONDS)), "other"]


# What is installed


def made_wheel(folder: Path, name: str, version: str = "99") -> str:
    """The line of a lock file of a package that has nothing in it."""
    path, about = folder / f"{name}-{version}-py3-none-any.whl", f"{name}-{version}.dist-info"
    with ZipFile(path, "w") as wheel:
        wheel.writestr(
            f"{about}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
        )
        wheel.writestr(f"{about}/WHEEL", "Wheel-Version: 1.0\nTag: py3-none-any\n")
        wheel.writestr(f"{about}/RECORD", "")
    return (
        f"{name}=={version} \\\n    --hash=sha256:{hashlib.sha256(path.read_bytes()).hexdigest()}\n"
    )


def try_install(
    folder: Path, lock: str, extras: str, needs: str = "run"
) -> subprocess.CompletedProcess[str]:
    """The script itself, with wheels made here and no index; pip only says what it would do."""
    (folder / "lock.txt").write_text(lock)
    (folder / "pyproject.toml").write_text(
        f'[project]\nname = "it"\nversion = "1"\ndependencies = ["{needs}"]\n'
        '[project.optional-dependencies]\nmore = ["extra"]\n[tool.setuptools]\npackages = []\n'
    )
    python = folder / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    python.chmod(0o755)
    options = ("DRY_RUN", "IGNORE_INSTALLED", "NO_INDEX")
    environment = {name: text for name, text in os.environ.items() if name[:4] != "PIP_"}
    environment |= {f"PIP_{name}": "1" for name in options}
    environment |= {"PIP_CONFIG_FILE": os.devnull, "PIP_LOG": str(folder / "log")}
    environment["PIP_FIND_LINKS"] = f"{folder} {folder / 'page.html'}"
    return subprocess.run(
        [ROOT / ".ci" / "install", ".venv", extras],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize(
    ("extras", "changed", "told"),
    [
        pytest.param("more", None, "installing into", marks=pytest.mark.check),
        pytest.param("", "pip", "DO NOT MATCH THE HASHES", marks=pytest.mark.check),
        ("", "run", "DO NOT MATCH THE HASHES"),
        pytest.param("more", "extra", "DO NOT MATCH THE HASHES", marks=pytest.mark.check),
        ("more", "nothing", "must have their versions pinned"),
        ("more,mroe", None, "install: there is no extra mroe; there are more"),
    ],
)
def test_install_refuses_a_file_with_another_hash(
    tmp_path: Path, extras: str, changed: str | None, told: str
) -> None:
    lock = {name: made_wheel(tmp_path, name) for name in ("pip", "setuptools", "run", "extra")}
    if changed == "nothing":
        del lock["extra"]
    elif changed:
        digit = lock[changed][-2]
        lock[changed] = lock[changed][:-2] + ("0" if digit != "0" else "1") + "\n"
    result = try_install(tmp_path, "".join(lock.values()), extras)
    assert told in result.stdout + result.stderr
    assert (result.returncode == 0) == told.startswith("installing"), result.stderr


@pytest.mark.parametrize(
    "offered", ["wheel", "source", pytest.param("not", marks=pytest.mark.check)]
)
def test_install_takes_the_cpu_build_where_it_is_offered(tmp_path: Path, offered: str) -> None:
    """Of the build whose hash an index tells pip thinks more, which is the one with CUDA.

    To look whether it is there pip has no hash: a source, which names itself by its code, is none.
    """
    lock = "".join(made_wheel(tmp_path, name) for name in ("pip", "setuptools", "torch"))
    wheel, digest = "torch-99-py3-none-any.whl", lock.rpartition(":")[2].strip()
    (tmp_path / "page.html").write_text(f'<a href="{wheel}#sha256={digest}">{wheel}</a>')
    cpu = made_wheel(tmp_path, "torch", "99+cpu").partition("\n")[2]
    if offered != "wheel":
        (tmp_path / "torch-99+cpu-py3-none-any.whl").unlink()
    if offered == "source":
        builder = '[build-system]\nrequires = []\nbuild-backend = "own"\nbackend-path = ["."]\n'
        code = f"open({str(tmp_path / 'ran')!r}, 'w')\n"
        with tarfile.open(tmp_path / "torch-99+cpu.tar.gz", "w:gz") as source:
            for name, text in (("pyproject.toml", builder), ("own.py", code)):
                data = text.encode()
                about = tarfile.TarInfo(f"torch-99+cpu/{name}")
                about.size = len(data)
                source.addfile(about, BytesIO(data))
    result = try_install(tmp_path, f"{lock[:-1]} \\\n{cpu}", "", needs="torch")
    assert result.returncode == 0, result.stderr
    taken = re.findall(r"Would install (torch-\S+)", (tmp_path / "log").read_text())
    assert taken[-1] == ("torch-99+cpu" if offered == "wheel" else "torch-99")
    assert not (tmp_path / "ran").exists()


@pytest.mark.check
def test_the_bill_of_materials_has_the_lock(tmp_path: Path) -> None:
    """Of an environment with all extras; make sbom also validates it, which takes long."""
    for module in ("mkdocs", "av"):
        pytest.importorskip(module, reason="pip install '.[docs,video]'")
    recipe = run(["make", "--dry-run", "sbom"]).stdout.splitlines()
    command = next(line for line in recipe if "cyclonedx-py" in line)
    assert "--no-validate" not in command
    quick = command.replace("sbom.json", str(tmp_path / "sbom.json")).split()
    result = run([*quick, "--no-validate"])
    assert result.returncode == 0, result.stderr
    content = json.loads((tmp_path / "sbom.json").read_text())
    assert content["bomFormat"] == "CycloneDX"
    has = {canonicalize_name(one["name"]): one["version"] for one in content["components"]}
    cuda = () if not version("torch").endswith("+cpu") else ("nvidia-", "cuda-", "triton")
    pins = (Requirement(pin) for pin in locked() if not pin.startswith(cuda))
    for pin in (pin for pin in pins if pin.marker is None or pin.marker.evaluate()):
        assert pin.specifier.contains(has[pin.name]), pin


# The documentation site


def built_site(config: Path, site: Path) -> subprocess.CompletedProcess[str]:
    pytest.importorskip("mkdocs", reason="pip install '.[docs]'")
    options = ["--strict", f"--config-file={config}", f"--site-dir={site}"]
    return run([sys.executable, "-m", "mkdocs", "build", *options])


@pytest.mark.check
def test_the_site_is_whole_and_asks_no_other_host(tmp_path: Path) -> None:
    """Strictly: each link and anchor leads somewhere, and each page is in the navigation."""
    result = built_site(ROOT / "mkdocs.yml", tmp_path)
    assert result.returncode == 0, result.stdout + result.stderr
    shown = [page.relative_to(ROOT).with_suffix("") for page in PAGES]
    for page in [name.parent if name.name == "README" else name for name in shown]:
        assert (tmp_path / page / "index.html").is_file()
    assert (
        'id="tangram_tasks.goal_env.TaskEnv.step"'
        in (tmp_path / "api" / "tangram_tasks.goal_env" / "index.html").read_text()
    )
    loads = r"<(?:script|img|source)[^>]* src=.?(?:https?:)?//|<link[^>]* href=.?(?:https?:)?//"
    loading = [p for p in tmp_path.rglob("*.*") if p.suffix in (".html", ".css")]
    assert [p for p in loading if re.search(rf"{loads}|url\(.?(?:https?:)?//", p.read_text())] == []


def test_a_dead_link_a_dead_anchor_and_a_lost_page_stop_the_site(tmp_path: Path) -> None:
    config = (ROOT / "mkdocs.yml").read_text().partition("\nnav:")[0]
    (tmp_path / "mkdocs.yml").write_text(f"{config}\nnav: [README.md]\n")
    (tmp_path / "docs").mkdir()
    for name in ("hooks.py", "site.css"):
        shutil.copy(ROOT / "docs" / name, tmp_path / "docs")
    (tmp_path / "docs" / "lost.md").write_text("# Lost\n")
    (tmp_path / "README.md").write_text(
        "# A page\n\n[a](#a-page) [b](gone.md) [c](docs/lost.md#no)\n\n```bash\n# no heading\n```\n"
    )
    result = built_site(tmp_path / "mkdocs.yml", tmp_path / "site")
    told = result.stdout + result.stderr
    assert result.returncode == 1, told
    assert "Aborted with 3 warnings in strict mode" in told
    for fault in ("docs/lost.md", "'gone.md'", "'docs/lost.md#no'"):
        assert fault in told
