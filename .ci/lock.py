"""Writes lock.txt and constraints.txt: make lock.

lock.txt has the hashes of all files of each package, for all extras and for torch with CUDA.
.ci/install and the images install only these files. constraints.txt has the same versions without
hashes, for `pip install --constraint constraints.txt .`.

Packages in constraints.txt keep their version; others get their newest one. To add a package, name
it in pyproject.toml. To update a package, delete its line in constraints.txt.
"""

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
LOCK, CONSTRAINTS = ROOT / "lock.txt", ROOT / "constraints.txt"
TITLE = "# Exact versions that the tests ran with. Written by make lock: .ci/lock.py explains it.\n"
# `name==version`, plus a marker if there is one -> hashes.
Pins = dict[str, list[str]]

# Only wheels: building a source package would run code that no hash has verified yet. The exception
# is hydra's antlr4-python3-runtime, which exists only as source.
ARGUMENTS = """pip compile pyproject.toml --all-extras --universal --python-version=3.11
    --constraints=constraints.txt --generate-hashes --no-annotate --no-header --quiet
    --only-binary=:all: --no-binary=antlr4-python3-runtime
    --no-emit-package=cffi --no-emit-package=pycparser"""  # these two: PyPy only


def pins(text: str) -> Pins:
    """Parse the text of a lock file."""
    lines = text.replace("\\\n", "").splitlines()
    parts = (line.split("--hash=") for line in lines if line and not line.startswith("#"))
    return {name.strip(): [one.strip() for one in hashes] for name, *hashes in parts}


def resolved() -> Pins:
    """Versions and hashes that uv resolves from its configured package index."""
    command = [Path(sys.executable).with_name("uv"), *ARGUMENTS.split()]
    return pins(subprocess.run(command, cwd=ROOT, check=True, stdout=-1, text=True).stdout)


def cpu_build(torch: str) -> list[str]:
    """Hash of torch's CPU build, as a list; empty if pip's package indexes do not have it."""
    options = "--dry-run --ignore-installed --no-deps --no-cache-dir --quiet --report -"
    options += " --only-binary=:all:"
    command = [sys.executable, "-m", "pip", "install", *options.split(), f"{torch}+cpu"]
    told = subprocess.run(command, check=False, capture_output=True, text=True).stdout
    found = json.loads(told)["install"] if told else []
    return ["sha256:" + one["download_info"]["archive_info"]["hashes"]["sha256"] for one in found]


def main() -> None:
    """Resolve all versions, add torch's CPU build, and write both files."""
    before, now = pins(LOCK.read_text() if LOCK.exists() else ""), resolved()
    torch = next(name for name in now if name.startswith("torch=="))
    offered = cpu_build(torch)
    if not offered:
        sys.stderr.write(f"pip finds no {torch}+cpu here: its old hashes in lock.txt stay\n")
    now[torch] = sorted({*now[torch], *before.get(torch, ()), *offered})
    locked = [" \\\n    --hash=".join([name, *hashes]) + "\n" for name, hashes in now.items()]
    LOCK.write_text(TITLE + "".join(locked))
    CONSTRAINTS.write_text(TITLE + "".join(f"{name}\n" for name in now))


if __name__ == "__main__":
    main()
