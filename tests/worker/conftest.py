"""What the tests of the worker share: a real hub, and a master that says what it is told."""

from collections.abc import Iterator

import pytest

from tests.master.hub.dealers import Stage, staged
from tests.worker.talk.conversation import StandIn, standing_in


@pytest.fixture
def stage() -> Iterator[Stage]:
    with staged() as made:
        yield made


@pytest.fixture
def master() -> Iterator[StandIn]:
    with standing_in() as made:
        yield made
