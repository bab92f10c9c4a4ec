"""What README and docs show is in the data, and the data are of this code: tangram-report check."""

import subprocess
from pathlib import Path

import pytest

from tests.cluster.processes import BIN

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(600)]


def test_every_score_of_the_pages_is_in_the_data_and_the_code_still_trains_alike(
    tmp_path: Path,
) -> None:
    command = (BIN / "tangram-report", "check")
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=500, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines()[-1] == "every score of README and docs is in the data"
