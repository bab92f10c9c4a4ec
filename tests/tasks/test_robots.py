"""Robots of others are tasks, where their packages are installed."""

from importlib.util import find_spec

import pytest

from tangram_core.conformance import check_task
from tangram_tasks.gym.task import Gym, GymConfig

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("package", "id", "fresh"),
    [
        ("gymnasium_robotics", "FetchPush-v4", False),
        ("panda_gym", "PandaReach-v3", False),
        ("panda_gym", "PandaPush-v3", True),
    ],
)
def test_robots_keep_the_promises_of_a_task(package: str, id: str, fresh: bool) -> None:  # noqa: A002
    if not find_spec(package):
        pytest.skip(f"{package} is not installed: pip install '.[robotics]'")
    task = Gym(GymConfig(id=id, imports=(package,), fresh=fresh))
    check_task(task)
    assert task.judge.repeats() != fresh  # what must be made anew is what does not repeat itself
