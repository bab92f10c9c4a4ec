"""What the tests of the master share: a hub with peers, and journals that are closed afterwards."""

from collections.abc import Iterator

import pytest

from tests.master.builders import close_journals
from tests.master.hub.dealers import Dealer, Stage, staged


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    yield
    close_journals()


@pytest.fixture
def stage() -> Iterator[Stage]:
    with staged() as made:
        yield made


@pytest.fixture
def player(stage: Stage) -> Dealer:
    """The first player, welcomed."""
    made = stage.dealer()
    made.join()
    return made
