"""What several tests look at: one real, short training, and one studio."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cluster.processes import LIMIT_S, run
from tests.cluster.studios import Running, studio

UPDATES = 600


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Real processes need minutes where the machine is busy; only what hangs takes so long."""
    for item in items:
        if item.path.parent == Path(__file__).parent:
            item.add_marker(pytest.mark.timeout(2 * LIMIT_S))


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a short training of the default agent through PyBullet and ZeroMQ."""
    folder = tmp_path_factory.mktemp("training") / "run"
    run(
        "tangram-train",
        f"run_dir={folder}",
        f"max_updates={UPDATES}",
        "service.eval_seconds=10",
        cwd=folder.parent,
    )
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Of a run that a test starts."""
    path = tmp_path / "run"
    path.mkdir()
    return path


@pytest.fixture(scope="session")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with studio(tmp_path_factory.mktemp("studio")) as found:
        yield found
