"""One real, short training that several tests look at."""

from pathlib import Path

import pytest

from tests.cluster.processes import run

UPDATES = 800


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a short training of the default agent through PyBullet and ZeroMQ."""
    folder = tmp_path_factory.mktemp("training") / "run"
    run(
        "tangram-train",
        f"run_dir={folder}",
        f"max_updates={UPDATES}",
        "service.eval_seconds=3",
        cwd=folder.parent,
        limit_s=300,
    )
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Of a run that a test starts."""
    path = tmp_path / "run"
    path.mkdir()
    return path
