"""A guard: a few characters of the product that a test must miss when they are gone."""

import tomllib
from dataclasses import dataclass
from pathlib import Path

from tangram_sim.errors import TangramError

HERE = Path(__file__).parent
ROOT = HERE.parents[1]


class GuardError(TangramError):
    """A declaration does not fit the source that it speaks of."""


@dataclass(frozen=True)
class Guard:
    """One guard, as a table of tests/guards/*.toml declares it."""

    room: str  # the role or promise it belongs to
    name: str  # what is lost when it goes, as a short sentence
    file: str  # a file, or a folder so that it may move among the files below it
    old: str  # as it stands there, once
    new: str  # what stands there instead when the guard is removed
    tests: tuple[str, ...]  # files or ids of pytest, of which one must turn red

    def removed_from(self, root: Path) -> tuple[Path, str]:
        """The file that holds the guard, and its text without it.

        Raises:
            GuardError: there is no such place, or it does not hold ``old`` exactly once.
        """
        place = root / self.file
        paths = sorted(place.rglob("*.py")) if place.is_dir() else [place]
        texts = {path: path.read_text() for path in paths if path.is_file()}
        if (times := sum(text.count(self.old) for text in texts.values())) != 1:
            raise GuardError(
                f"{self.name}: {self.file} holds {self.old!r} {times} times, 1 is needed; "
                "write what stands there now"
            )
        [(path, text)] = [item for item in texts.items() if self.old in item[1]]
        return path, text.replace(self.old, self.new)


def declared(folder: Path = HERE) -> list[Guard]:
    """All guards of the folder's files, in the order of the files' names."""
    guards = []
    for path in sorted(folder.glob("*.toml")):
        for room, entries in tomllib.loads(path.read_text()).items():
            for entry in entries:
                tests = tuple(entry.pop("tests"))
                guards.append(Guard(room=room, tests=tests, **entry))
    return guards


def faults(guards: list[Guard], root: Path = ROOT) -> list[str]:
    """What keeps guards from being removed, in words; empty when all can be."""
    found = []
    for guard in guards:
        try:
            guard.removed_from(root)
        except GuardError as error:
            found.append(str(error))
        missing = [test for test in guard.tests if not (root / test.split("::")[0]).exists()]
        found += [f"{guard.name}: there is no {test}" for test in missing]
    return found
