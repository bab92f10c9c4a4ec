"""A machine that loses its power: of what was not synced anything may be there, or nothing."""

import os
import stat
from pathlib import Path
from random import Random

import pytest


class PowerCutError(BaseException):
    """Nothing that follows is done."""


class Machine:
    """A folder on a disk that forgets what was not synced.

    Everything is done to real files; what is durable is noted at each fsync: the content of a file,
    the names in a folder. `restarted` makes a folder of what may be left of it.

    Attributes:
        folder: where to work.
        syncs: so many there were.
        cut_at: before this one the power fails, 0 for never.
    """

    def __init__(self, place: Path, patch: pytest.MonkeyPatch) -> None:
        """Begin with an empty folder, which is durable."""
        self._place, self._lives = place, 0
        self.syncs = self.cut_at = 0
        # Open, so that no number of a file is given to another one.
        self._held: dict[int, int] = {}
        self._contents: dict[int, bytes] = {}
        self._names: dict[int, dict[str, int]] = {}
        self._left: Path | None = None
        self.folder = self._next_folder()
        self.folder.mkdir(parents=True)
        patch.setattr(os, "fsync", self._sync)

    def close(self) -> None:
        """Let go of all files."""
        for handle in self._held.values():
            os.close(handle)
        self._held.clear()
        self._contents.clear()
        self._names.clear()

    def restarted(self, chance: Random) -> None:
        """Cut the power: what chance leaves is in a new folder, and durable there."""
        where = {path.stat().st_ino: path for path in self.folder.rglob("*")}
        before, self.folder = self.folder, self._next_folder()
        where[before.stat().st_ino] = before
        self._build(before.stat().st_ino, where, self.folder, chance)
        self.close()
        for path in [self.folder, *self.folder.rglob("*")]:
            self._note(path)

    def _next_folder(self) -> Path:
        self._lives += 1
        return self._place / str(self._lives)

    def _sync(self, handle: int) -> None:
        self.syncs += 1
        if self.syncs == self.cut_at:
            raise PowerCutError
        self._note(Path(f"/proc/self/fd/{handle}"))

    def _note(self, path: Path) -> None:
        number = self._hold(path)
        if path.is_dir():
            self._names[number] = {p.name: self._hold(p) for p in path.iterdir()}
        else:
            self._contents[number] = path.read_bytes()

    def _hold(self, path: Path) -> int:
        number = path.stat().st_ino
        if number not in self._held:
            self._held[number] = os.open(path, os.O_RDONLY)
        return number

    def _build(self, number: int, where: dict[int, Path], target: Path, chance: Random) -> None:
        """A folder with each name as it was synced, or as it is; a rename is done or not."""
        target.mkdir()
        path, synced = where.get(number), self._names.get(number, {})
        present = {p.name: p.stat().st_ino for p in path.iterdir()} if path else {}
        new: dict[int, bool] = {}
        for name in sorted(synced.keys() | present.keys()):
            moved = present.get(name, synced.get(name, 0))
            is_new = new.setdefault(moved, chance.random() < 0.5)
            found = (present if is_new else synced).get(name)
            if found is None:
                continue
            known = where.get(found, Path(f"/proc/self/fd/{self._held.get(found, -1)}"))
            if stat.S_ISDIR(known.stat().st_mode):
                self._build(found, where, target / name, chance)
            else:
                content = self._content(found, known.read_bytes(), chance)
                (target / name).write_bytes(content)

    def _content(self, number: int, present: bytes, chance: Random) -> bytes:
        """As it was synced, or as it is; of what was appended a part, or zeros in its place."""
        synced = self._contents.get(number, b"")
        if not present.startswith(synced):
            return chance.choice([synced, present])
        appended = present[len(synced) :]
        kept = appended[: chance.randint(0, len(appended))]
        zeros = b"\0" * chance.randint(0, len(appended) - len(kept))
        return synced + chance.choice([b"", appended, kept, kept + zeros])
