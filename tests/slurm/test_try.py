"""The job scripts on a real SLURM, made for the test: only on request."""

import os
import subprocess
from pathlib import Path

import pytest

pytestmark = pytest.mark.slurm

ROOT = Path(__file__).parents[2]
ASKED = "TANGRAM_TRY_SLURM"
LIMIT_S = 5400


def why_not() -> str | None:
    """Why it cannot be tried here, or None."""
    if os.environ.get(ASKED) != "1":
        return f"installs SLURM and takes a quarter of an hour: set {ASKED}=1 to try it"
    if os.geteuid() != 0:
        return f"{ASKED}=1 needs root: it installs packages and starts daemons"
    if not Path("/etc/debian_version").exists():
        return f"{ASKED}=1 needs Debian: it installs packages with apt-get"
    return None


@pytest.mark.timeout(LIMIT_S)
def test_everything_that_the_scripts_promise_holds() -> None:
    reason = why_not()
    if reason is not None:
        pytest.skip(reason)
    done = subprocess.run(
        [ROOT / "slurm" / "try.sh"],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
        timeout=LIMIT_S - 60,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "NOT held" not in done.stdout
    assert done.stdout.endswith("everything held\n")
