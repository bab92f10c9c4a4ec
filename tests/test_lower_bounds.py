"""The oldest versions that pyproject.toml allows, installed and tried: make check."""

import os
import subprocess
import sys
from importlib.metadata import distribution, version
from pathlib import Path
from sysconfig import get_path

import pytest

from tests.test_house import ROOT

pytestmark = [pytest.mark.slow, pytest.mark.check, pytest.mark.timeout(3600)]

# As in .ci/lock.py: nothing is built to be looked at, and antlr4 comes as source only.
WHEELS = "--only-binary=:all: --no-binary=antlr4-python3-runtime"
EXTRAS = "--extra=studio --extra=video"
LOWEST = "pip compile pyproject.toml -q --no-header --no-annotate --resolution=lowest-direct"
TORCH = ("torch==", "triton==", "nvidia-", "cuda-")
# An old package warns of a newer one that it uses: an error in the gate, none for who uses it.
FAST = """-m pytest -q -m fast -p no:cacheprovider -W default::DeprecationWarning
    --ignore=tests/cluster/test_studio_browser.py
    --deselect=tests/test_house.py::test_import_contracts_catch_every_wrong_arrow"""


def run(*command: str | Path, cwd: Path = ROOT) -> str:
    own = {name: text for name, text in os.environ.items() if not name.startswith("PYTEST_")}
    result = subprocess.run(command, cwd=cwd, env=own, capture_output=True, text=True, check=False)
    told = f"{result.stdout[-5000:]}\n{result.stderr[-5000:]}"
    line = " ".join(str(word) for word in command[:3])
    assert result.returncode == 0, f"{line} failed; packages need a package index:\n{told}"
    return result.stdout


def test_the_oldest_versions_allowed_pass_the_fast_tests(tmp_path: Path) -> None:
    """In an environment of its own, where each direct dependency has its lowest version.

    torch is the running environment's, by links, whatever its version: indexes have the oldest with
    CUDA only, several GB. Its bound is resolved, but not tried. Nor are those of the other extras.
    """
    uv = pytest.importorskip("uv", reason="pip install '.[dev]'").find_uv_bin()
    python = tmp_path / "env" / "bin" / "python"
    run(uv, "venv", f"--python={sys.executable}", tmp_path / "env")
    pins = run(
        uv, *LOWEST.split(), *EXTRAS.split(), *WHEELS.split(), f"--python={python}"
    ).splitlines()
    pins = [pin for pin in pins if not pin.startswith(TORCH)]
    tools = ("hypothesis", "pytest", "pytest-timeout", "pytest-xdist")
    pins += [f"{tool}=={version(tool)}" for tool in tools]
    run(uv, "pip", "install", f"--python={python}", *WHEELS.split(), *pins)
    run(uv, "pip", "install", f"--python={python}", "--no-deps", "--editable", ROOT)
    here, site = Path(get_path("purelib")), next(tmp_path.glob("env/lib/python3*/site-packages"))
    files = distribution("torch").files or ()
    for name in {path.parts[0] for path in files} - {".."} | {"nvidia", "triton"}:
        (site / name).symlink_to(here / name)
    assert " passed" in run(python, *FAST.split())
    train, play = (python.with_name(f"tangram-{name}") for name in ("train", "play"))
    run(train, "max_updates=20", "service.log_format=json", cwd=tmp_path)
    run(play, "silhouette=cat", "out=cat.png", cwd=tmp_path)
