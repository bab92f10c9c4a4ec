"""Writes lock.txt and constraints.txt: make lock.

lock.txt has the hash of every file of each version, for all extras, and for torch with CUDA, too;
.ci/install and the images take nothing else. constraints.txt has the same pins without hashes, for
`pip install --constraint constraints.txt .`.

What constraints.txt pins stays, what it lacks comes in its newest version. So a package is added in
pyproject.toml, and moved on by deleting its line in constraints.txt.
"""

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
LOCK, CONSTRAINTS = ROOT / "lock.txt", ROOT / "constraints.txt"
TITLE = "# Exact versions that the tests ran with. Written by make lock: .ci/lock.py explains it.\n"
# `name==version`, with a marker where it has one -> hashes.
Pins = dict[str, list[str]]

# Building a package to look at it would run what no hash vouches for yet. hydra's
# antlr4-python3-runtime comes as source only.
ARGUMENTS = """pip compile pyproject.toml --all-extras --universal --python-version=3.11
    --constraints=constraints.txt --generate-hashes --no-annotate --no-header --quiet
    --only-binary=:all: --no-binary=antlr4-python3-runtime
    --no-emit-package=cffi --no-emit-package=pycparser"""  # these two: PyPy only


def pins(text: str) -> Pins:
    """What a lock file says."""
    lines = text.replace("\\\n", "").splitlines()
    parts = (line.split("--hash=") for line in lines if line and not line.startswith("#"))
    return {name.strip(): [one.strip() for one in hashes] for name, *hashes in parts}


def resolved() -> Pins:
    """What uv finds in the package index that it is set up with, a usual one."""
    command = [Path(sys.executable).with_name("uv"), *ARGUMENTS.split()]
    return pins(subprocess.run(command, cwd=ROOT, check=True, stdout=-1, text=True).stdout)


def cpu_build(torch: str) -> list[str]:
    """The hash of torch's CPU build, which is not in the usual index, where pip is offered one."""
    options = "--dry-run --ignore-installed --no-deps --no-cache-dir --quiet --report -"
    options += " --only-binary=:all:"
    command = [sys.executable, "-m", "pip", "install", *options.split(), f"{torch}+cpu"]
    told = subprocess.run(command, check=False, capture_output=True, text=True).stdout
    found = json.loads(told)["install"] if told else []
    return ["sha256:" + one["download_info"]["archive_info"]["hashes"]["sha256"] for one in found]


def main() -> None:
    """Resolve, add the CPU build, write both."""
    before, now = pins(LOCK.read_text() if LOCK.exists() else ""), resolved()
    torch = next(name for name in now if name.startswith("torch=="))
    offered = cpu_build(torch)
    if not offered:
        sys.stderr.write(f"pip is offered no {torch}+cpu here: what lock.txt had of it stays\n")
    now[torch] = sorted({*now[torch], *before.get(torch, ()), *offered})
    locked = [" \\\n    --hash=".join([name, *hashes]) + "\n" for name, hashes in now.items()]
    LOCK.write_text(TITLE + "".join(locked))
    CONSTRAINTS.write_text(TITLE + "".join(f"{name}\n" for name in now))


if __name__ == "__main__":
    main()
