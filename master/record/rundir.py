"""The run folder, the lock on it, and the record of a run's counters."""

import fcntl
import json
import os
import secrets
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import IO, Any, Self

import msgspec
import yaml

from master.config import MasterConfig
from master.record.journal import segments
from master.record.lease import Lease, is_elsewhere
from tangram_core.errors import ConfigError, RunError, TangramError, UnavailableError
from tangram_core.run.code import code_of, own_code, read_code
from tangram_core.run.outcome import FILE_NAME as RESULT
from tangram_core.run.outcome import bound_of, read_outcome
from tangram_core.setup import section_names
from tangram_core.store.checkpoints import list_checkpoints
from tangram_core.store.files import PRIVATE, PUBLIC, is_same, make_folders, private, write_whole

LOCK, LAUNCHER, LEASE = ".lock", ".launcher", ".lease.json"


class RunFolder:
    """The paths in a run folder, and the functions that read and write its files.

    Attributes:
        connection: address of the master; the file exists while the master runs.
        journal: folder of the batches since the last checkpoint.
        logs: folder of the output of workers and evaluator.
        curve: the scores of every evaluation.
        audit: log of peers that joined, left or were refused.
        result: the scores of the final weights.
        bad_batch: the last batch before the run ended with values that are not finite.
        picture: the test episodes of the newest evaluation; written at times and at the end.
        again: path -> function that writes the file again if the folder was deleted and made again.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path).expanduser()
        self.config = self.path / "config.yaml"
        self.connection = self.path / "connection.json"
        self.keys = self.path / "keys.json"
        self.checkpoints = self.path / "checkpoints"
        self.journal = self.path / "journal"
        self.tensorboard = self.path / "tensorboard"
        self.logs = self.path / "logs"
        self.curve = self.path / "curve.jsonl"
        self.audit = self.path / "audit.jsonl"
        self.result = self.path / RESULT
        self.bad_batch = self.path / "bad_batch.safetensors"
        self.picture = self.path / "test_episodes.png"
        self.again: dict[Path, Callable[[], object]] = {}

    def prepare(self, resume: str) -> None:
        """Make the folder; ConfigError if that fails, or it holds a run and `resume` is none."""
        if resume == "none" and self.holds_run():
            raise ConfigError(
                f"run_dir {self.path} holds a run already: choose another run_dir, or go on with "
                "resume=auto"
            )
        try:
            make_folders(self.path)
        except OSError as error:
            raise ConfigError(
                f"run_dir {self.path} cannot be made ({error.strerror}): choose another run_dir"
            ) from None

    def holds_run(self) -> bool:
        """Whether the folder has files of a run, which a new run would mix with its own."""
        curves = self.tensorboard.is_dir() and any(self.tensorboard.iterdir())
        return curves or self.holds_more()

    def holds_more(self) -> bool:
        """Whether the folder has more of a run than curves, which may be written after a loss."""
        kept = bool(list_checkpoints(self.checkpoints)) or bool(segments(self.journal))
        return self.result.exists() or kept

    def check_never_kept(self) -> None:
        """Refuse to start from nothing if the folder shows that it once had a checkpoint.

        The signs are a journal without its first segments, which a checkpoint deletes, and a result
        without a journal.

        Raises:
            RunError: the folder has lost its checkpoints.
        """
        first = min(segments(self.journal), default=0)
        if first > 1 or (first == 0 and self.result.exists()):
            raise RunError(
                f"run_dir {self.path} has lost its checkpoints: put them back into "
                f"{self.checkpoints}, or start a new run with another run_dir"
            )

    def has_finished(self, config: MasterConfig) -> bool:
        """Whether the run is complete: it has its final scores, and this config raises no bound."""
        if config.resume != "auto" or not self.result.exists():
            return False
        result = read_outcome(self.result)
        name, reached = bound_of(result)
        spent = bool(name) and 0 < getattr(config, name) <= reached
        return spent and result["scored_updates"] == result["updates"]

    def lock(self, name: str = LOCK) -> "Claim":
        """Lock the folder for this process, until `close` or the end; TangramError if it is in use.

        Args:
            name: `LOCK` for the process that writes the run, `LAUNCHER` for tangram-train.
        """
        return Claim(self, name)

    def write_again(self) -> None:
        """Write the missing files of the folder again, after the folder was made again."""
        for path, write in self.again.items():
            if not path.exists():
                write()

    def write_config(self, resolved: Mapping[str, Any]) -> None:
        """Write the resolved config as plain YAML, and a copy of the user's own code, if any.

        The copy is for the record only: no process loads it.
        """
        for setting, value in code_of(resolved).items():
            own = own_code(value)
            if own is not None:
                section = setting.partition(".")[0]
                digest = resolved[section].get("sha256")
                source, _ = read_code(setting, value, own[0], digest)
                self._write(self.path / f"{section}_{own[0].name}", source)
        self._write(self.config, yaml.safe_dump(dict(resolved), sort_keys=False).encode())

    def read_config(self) -> dict[str, Any]:
        """The config that `write_config` wrote."""
        data = self.config.read_bytes()
        self.again[self.config] = partial(write_whole, self.config, data, above=False)
        return dict(yaml.safe_load(data))

    def write_connection(self, connection: Mapping[str, Any]) -> None:
        """Write the connection data and the run's settings; only the user can read the file."""
        config = self.read_config()
        shared = (*section_names(config), "service")
        settings = {name: config[name] for name in shared if name in config}
        content = {**connection, "settings": settings}
        self._write(self.connection, json.dumps(content, indent=1).encode(), PRIVATE)

    def remove_connection(self) -> None:
        """Remove the connection data, unless a master on another machine has taken the run over."""
        with suppress(OSError):  # there is no lease, or the disk failed
            if is_elsewhere(self.path / LEASE):
                return
        with suppress(OSError):
            self.connection.unlink(missing_ok=True)

    def write_result(self, result: Mapping[str, Any]) -> None:
        """Write result.json."""
        self._write(self.result, (json.dumps(dict(result), indent=1) + "\n").encode())

    def _write(self, path: Path, data: bytes, mode: int = PUBLIC) -> None:
        write = partial(write_whole, path, data, mode, above=False)
        write()  # above=False: do not make a run folder again that was deleted
        self.again[path] = write


class FolderError(RunError):
    """The run folder is gone or was replaced by another one; no batch may be acknowledged."""


class Claim:
    """An exclusive lock on a run folder, with a lease for other machines."""

    def __init__(self, run: RunFolder, name: str = LOCK) -> None:
        """Lock the folder; TangramError if another process uses it."""
        self.run, self._name = run, name
        self._take()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def check(self) -> bool:
        """Lock the folder again if its lock file was deleted, or the folder is new and empty.

        Returns:
            Whether that was necessary.

        Raises:
            FolderError: the folder is gone or holds another run, or another process uses it.
            FailedError: a master on another machine has taken the run over.
        """
        path = self.run.path
        try:
            if is_same(self._lock.fileno(), path / self._name):
                if self._lease is not None:
                    self._lease.renew()
                return False
            if not path.is_dir():
                raise FolderError(f"run_dir {path} is gone")
            if not is_same(self._folder, path) and self.run.holds_more():
                raise FolderError(f"run_dir {path} was replaced by a folder with another run")
            before, lease = (self._lock, self._folder), self._lease
            self._take()
        except (OSError, ConfigError, UnavailableError) as error:
            why = error.strerror if isinstance(error, OSError) else "another process uses it"
            raise FolderError(f"run_dir {path} cannot be locked again ({why})") from None
        if lease is not None:
            lease.close()
        self._release(*before)
        return True

    def close(self) -> None:
        """Release the lock and the lease."""
        if self._lease is not None:
            self._lease.close()
        self._release(self._lock, self._folder)

    def _take(self) -> None:
        # The file is private, because every user who can open it can lock it.
        lock = open(self.run.path / self._name, "ab", opener=private)  # noqa: SIM115
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._lease = Lease(self.run.path / LEASE) if self._name == LOCK else None
        except BlockingIOError:
            lock.close()
            raise ConfigError(
                f"run_dir {self.run.path} is in use by another process: choose another run_dir, or "
                "stop that one first"
            ) from None
        except OSError as error:
            lock.close()
            raise ConfigError(
                f"{self.run.path / self._name} cannot be locked by flock ({error.strerror}): "
                "choose a run_dir on a file system that has locks"
            ) from None
        except TangramError:
            lock.close()
            raise
        # The folder stays open, so that its inode number is not used for another folder.
        self._lock, self._folder = lock, os.open(self.run.path, os.O_RDONLY)

    def _release(self, lock: IO[bytes], folder: int) -> None:
        lock.close()
        os.close(folder)


@dataclass
class Record:
    """Counters of a run that are kept over its processes, in the checkpoints.

    Attributes:
        run_id: random id of the run; a resumed run keeps it.
        loop_s: seconds in the main loop, including waits for workers.
        train_s: seconds in the main loop since the first episodes arrived.
        wall_s: seconds in all master processes.
        workers: largest number of players connected at the same time.
        scores: scores of the newest evaluation, by name.
        scored_version: version of the weights with these scores; -1 before the first evaluation.
    """

    run_id: str = field(default_factory=lambda: secrets.token_hex(8))
    loop_s: float = 0.0
    train_s: float = 0.0
    wall_s: float = 0.0
    workers: int = 0
    scores: dict[str, float] = field(default_factory=dict)
    scored_version: int = -1

    def score(self, scores: Mapping[str, float], version: int) -> None:
        """Store the scores of an evaluation and the version of its weights."""
        self.scores, self.scored_version = dict(scores), version

    def state(self) -> dict[str, Any]:
        """The record as JSON values."""
        return asdict(self)

    @staticmethod
    def of(state: Mapping[str, Any]) -> "Record":
        """Read the record of a checkpoint; RunError if a field is missing or has a wrong type."""
        lacking = [f.name for f in fields(Record) if f.name not in state]
        if lacking:
            raise RunError(
                f"the checkpoint's record lacks {', '.join(lacking)}: start a new run with "
                "another run_dir"
            )
        try:
            return msgspec.convert(dict(state), Record)
        except msgspec.ValidationError as error:
            raise RunError(
                f"the checkpoint's record cannot be read ({error}): start a new run with another "
                "run_dir"
            ) from None


class Clock:
    """Adds the times of this process to the record of a run."""

    def __init__(self, record: Record) -> None:
        self.record, self._wall_s = record, record.wall_s
        self._begun_s = self._last_s = time.monotonic()

    def advance(self, training: bool) -> None:
        """Add the time since the last call: to `loop_s`; if `training`, to `train_s`, too."""
        now_s = time.monotonic()
        self.record.loop_s += now_s - self._last_s
        if training:
            self.record.train_s += now_s - self._last_s
        self._last_s = now_s

    def read(self) -> Record:
        """The record, with `wall_s` up to now."""
        self.record.wall_s = self._wall_s + time.monotonic() - self._begun_s
        return self.record
