"""JSON files that are checked before they are used."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

from tangram_sim.errors import RunError

Row = dict[str, Any]


class Record:
    """A mapping of a JSON file; its getters raise RunError, naming file, key and remedy.

    Attributes:
        content: the mapping.
        path: the file that it comes from.
    """

    def __init__(self, content: object, path: Path, remedy: str, where: str = "") -> None:
        self.path, self._remedy, self._where = path, remedy, where
        if not isinstance(content, dict):
            self._fail(f"{where or 'its content'} must be a mapping, not {_kind(content)}")
        self.content: Row = content

    def text(self, name: str) -> str:
        """A text."""
        value = self._get(name)
        if not isinstance(value, str):
            self._wrong(name, "a text", value)
        return value

    def maybe_text(self, name: str) -> str | None:
        """A text or null."""
        return None if self._get(name) is None else self.text(name)

    def texts(self, name: str) -> tuple[str, ...]:
        """A list of texts."""
        return tuple(
            v if isinstance(v, str) else self._wrong(name, "texts", v) for v in self._list(name)
        )

    def integer(self, name: str) -> int:
        """A whole number, not below 0."""
        return self._integer(name, self._get(name))

    def integers(self, name: str) -> tuple[int, ...]:
        """A list of whole numbers, not below 0."""
        return tuple(self._integer(name, value) for value in self._list(name))

    def number(self, name: str) -> float:
        """A finite number."""
        return self._number(name, self._get(name))

    def maybe_number(self, name: str) -> float | None:
        """A finite number or null."""
        value = self._get(name)
        return None if value is None else self._number(name, value)

    def record(self, name: str) -> "Record":
        """A mapping."""
        return Record(self._get(name), self.path, self._remedy, self._path_of(name))

    def records(self, name: str) -> dict[str, "Record"]:
        """A mapping of names to mappings."""
        inner = self.record(name)
        return {key: inner.record(key) for key in inner.content}

    def _get(self, name: str) -> Any:
        if name not in self.content:
            self._fail(f"it lacks {self._path_of(name)}")
        return self.content[name]

    def _list(self, name: str) -> list[Any]:
        value = self._get(name)
        if not isinstance(value, list):
            self._wrong(name, "a list", value)
        return value

    def _integer(self, name: str, value: object) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or value < 0:
            self._wrong(name, "a whole number of at least 0", value)
        return value

    def _number(self, name: str, value: object) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            self._wrong(name, "a number", value)
        if not math.isfinite(value):
            self._wrong(name, "a finite number", value)
        return float(value)

    def _path_of(self, name: str) -> str:
        return f"{self._where}.{name}" if self._where else name

    def _wrong(self, name: str, wanted: str, value: object) -> NoReturn:
        self._fail(f"{self._path_of(name)} must be {wanted}, got {_short(value)}")

    def _fail(self, message: str) -> NoReturn:
        raise RunError(f"{self.path}: {message}; {self._remedy}")


def read_record(path: Path, remedy: str) -> Record:
    """A file that holds one JSON mapping.

    Raises:
        RunError: it cannot be read, is not JSON or not a mapping.
    """
    return Record(_parse(_read(path, remedy), path, remedy), path, remedy)


def read_records(path: Path, remedy: str) -> list[Record]:
    """A file with one JSON mapping a line; a last line without its end is still being written.

    Raises:
        RunError: it cannot be read, or a line is not JSON or not a mapping.
    """
    lines = _read(path, remedy).split("\n")[:-1]
    return [
        Record(_parse(line, path, remedy, number), path, remedy, f"line {number}")
        for number, line in enumerate(lines, 1)
    ]


def _read(path: Path, remedy: str) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise RunError(f"{path}: cannot be read ({error.strerror}); {remedy}") from None
    except UnicodeDecodeError:
        raise RunError(f"{path}: it is not JSON; {remedy}") from None


def _parse(text: str, path: Path, remedy: str, line: int | None = None) -> object:
    try:
        content: object = json.loads(text, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        at = error.lineno if line is None and isinstance(error, json.JSONDecodeError) else line
        place = f" (line {at})" if at else ""
        raise RunError(f"{path}: it is not JSON{place}; {remedy}") from None
    return content


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not JSON")


def without(row: Mapping[str, Any], *names: str) -> Row:
    """A copy that lacks some keys."""
    return {name: value for name, value in row.items() if name not in names}


def _kind(value: object) -> str:
    return {list: "a list", str: "a text", type(None): "null"}.get(type(value), "a single value")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
