"""The list of guards that `python -m tests.guards` removes, and what it cannot remove."""

from collections import Counter
from pathlib import Path

import pytest

from tests.guards.guard import Guard, GuardError, declared, faults

pytestmark = pytest.mark.fast


def test_there_are_guards_of_every_room() -> None:
    guards = declared()
    assert len(guards) >= 60
    assert min(Counter(guard.room for guard in guards).values()) >= 5
    assert len({guard.name for guard in guards}) == len(guards)
    assert all(guard.old != guard.new and guard.tests for guard in guards)
    assert faults(guards) == []  # each stands in the source as its row says


def guard(file: str, old: str, tests: str = "own.py") -> Guard:
    return Guard("room", "a bound holds", file, old, "pass", (tests,))


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    (tmp_path / "own.py").write_text("check()\nmove()\nmove()\n")
    return tmp_path


@pytest.mark.parametrize("place", ["own.py", "."])
def test_a_guard_is_removed_wherever_it_stands_below_its_place(tree: Path, place: str) -> None:
    path, rest = guard(place, "check()").removed_from(tree)
    assert (path, rest) == (tree / "own.py", "pass\nmove()\nmove()\n")
    assert path.read_text().startswith("check()")  # the tree is as it was


@pytest.mark.parametrize(
    ("one", "reason"),
    [
        (guard("own.py", "gone()"), "own.py holds 'gone()' 0 times, 1 is needed"),
        (guard("own.py", "move()"), "own.py holds 'move()' 2 times, 1 is needed"),
        (guard("other.py", "check()"), "other.py holds 'check()' 0 times, 1 is needed"),
        (guard("own.py", "check()", "test_own.py::test_it"), "there is no test_own.py"),
    ],
)
def test_a_declaration_that_no_longer_fits_is_told(tree: Path, one: Guard, reason: str) -> None:
    [told] = faults([one], tree)
    assert told.startswith("a bound holds: ")
    assert reason in told


def test_a_guard_that_is_gone_is_not_removed(tree: Path) -> None:
    with pytest.raises(GuardError, match="0 times"):
        guard("own.py", "gone()").removed_from(tree)
