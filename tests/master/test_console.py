"""Output goes on being possible when nobody reads it any more; with real pipes and terminals."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.cluster

LIMIT_S = 30.0
# Prints until it is told that its output is gone, then more, and ends in order.
CODE = """
import sys
from master.console import sturdy_console
from master.console import make_progress
console = sturdy_console(sys.stdout)
print(console.is_terminal, file=sys.stderr)
progress = make_progress(console, "run")
progress.notice("before")
sys.stdin.readline()
for _ in range(3):
    progress.notice("x" * 100_000)
progress.close()
"""


@pytest.mark.parametrize("terminal", [False, True])
def test_a_reader_that_goes_away_ends_nothing(terminal: bool) -> None:
    ours, theirs = os.openpty() if terminal else os.pipe()
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    with subprocess.Popen(
        [sys.executable, "-c", CODE],
        env=environment | {"TERM": "xterm"},
        stdin=subprocess.PIPE,
        stdout=theirs,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        os.close(theirs)
        seen = b""
        while b"before" not in seen:
            seen += os.read(ours, 1000)
        os.close(ours)
        _, errors = process.communicate("go on\n", timeout=LIMIT_S)
    assert (process.returncode, errors) == (0, f"{terminal}\n")


def test_a_terminal_of_few_characters_shows_what_it_can() -> None:
    code = (
        "import sys\nfrom master.console import sturdy_console\n"
        "sturdy_console(sys.stdout).print('0.04° · done')"
    )
    environment = {
        **os.environ,
        "PYTHONPATH": str(Path(__file__).resolve().parents[2]),
        "PYTHONIOENCODING": "ascii",
    }
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=environment,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    assert (done.stdout, done.returncode) == ("0.04? ? done\n", 0), done.stderr
