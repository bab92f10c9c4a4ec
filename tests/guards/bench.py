"""A copy of the tree, and a process that runs tests in it again and again.

The process has loaded what takes long and never changes, and forks for every run: each begins with
the product's files as they stand then.
"""

import importlib
import json
import os
import shutil
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

# Nothing that brings a plugin of pytest: it must come after pytest, which rewrites its asserts.
LOADED = (
    "gymnasium",
    "msgspec",
    "numpy",
    "PIL.Image",
    "pybullet",
    "safetensors.numpy",
    "scipy.optimize",
    "shapely",
    "torch",
    "yaml",
    "zmq",
)
LIMIT_S = 300.0  # of the tests of one file, which take seconds
NOT_ENDED = -1


class Bench:
    """Runs tests in a copy of the tree.

    Attributes:
        tree: the copy.
    """

    def __init__(self, root: Path, tree: Path) -> None:
        """Copy the tree as it stands, without what git ignores."""
        self.tree = tree
        listed = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            cwd=root,
            capture_output=True,
            text=True,
            check=True,
        )
        for name in filter(None, listed.stdout.split("\0")):
            if (root / name).is_file():
                (tree / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(root / name, tree / name)
        # No bytecode: a file changed within a second, at equal length, would pass for the old one.
        env = {**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
        self._process = subprocess.Popen(
            [sys.executable, "-P", __file__],
            cwd=tree,
            env=env,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def run(self, tests: tuple[str, ...]) -> tuple[int, str]:
        """Pytest's exit status and output of the tests, up to the first that fails.

        The status is NOT_ENDED where they took longer than LIMIT_S for each of them.
        """
        if self._process.stdin is None or self._process.stdout is None:
            raise RuntimeError("the process of the bench has no pipes")
        self._process.stdin.write(json.dumps(tests) + "\n")
        self._process.stdin.flush()
        status, output = json.loads(self._process.stdout.readline())
        return int(status), str(output)

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


def serve() -> None:
    """Run what each line of the input names, and answer with a line."""
    answers = os.fdopen(os.dup(1), "w")
    for name in LOADED:
        with suppress(ImportError):
            importlib.import_module(name)
    log = Path("guards.log").resolve()
    for line in sys.stdin:
        status = _forked(json.loads(line), log)
        answers.write(json.dumps([status, log.read_text(errors="replace")]) + "\n")
        answers.flush()


def _forked(tests: list[str], log: Path) -> int:
    child = os.fork()
    if child == 0:
        os.setsid()
        with log.open("w") as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
        os._exit(_pytest(tests))
    ends = time.monotonic() + LIMIT_S * len(tests)
    while time.monotonic() < ends:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.02)
    os.killpg(child, 9)
    os.waitpid(child, 0)
    return NOT_ENDED


def _pytest(tests: list[str]) -> int:
    pytest: Any = importlib.import_module("pytest")
    status = int(pytest.main(["-q", "-x", "-p", "no:cacheprovider", *tests]))
    sys.stdout.flush()
    return status


if __name__ == "__main__":
    serve()
