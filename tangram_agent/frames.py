"""Headers of messages: one small msgpack map each, whose fields are read one by one and checked.

Nothing of a header is believed: its size is checked before it is unpacked, every length and the
depth are limited, and a field that is missing, unknown, of another type or out of range is a
WireError that says so.
"""

import re
from collections.abc import Collection, Mapping
from typing import Any

import msgpack

from tangram_sim.errors import WireError

PROTOCOL = 2
MAX_HEADER = 16 * 1024
MAX_TEXT = 1024
MAX_ID = 64
MAX_ENTRIES = 64
MAX_INTEGER = 2**63 - 1
MAX_NUMBER = 1e18
NAME = re.compile(r"[a-z0-9_./]{1,64}")


class ProtocolError(WireError):
    """The other side speaks another version of the protocol."""


def pack_header(kind: str, fields: Mapping[str, object]) -> bytes:
    """The header {v, kind, fields...}.

    Raises:
        WireError: it would be larger than a receiver accepts.
    """
    header = pack_map(kind, fields)
    if len(header) > MAX_HEADER:
        raise WireError(f"{kind}: the header has {len(header)} bytes, at most {MAX_HEADER}")
    return header


def pack_map(kind: str, fields: Mapping[str, object]) -> bytes:
    """The msgpack map {v, kind, fields...} of any size."""
    packed: bytes = msgpack.packb({"v": PROTOCOL, "kind": kind, **fields})
    return packed


def unpack_header(frame: bytes) -> "Fields":
    """The fields of a header.

    Raises:
        ProtocolError: another version.
        WireError: too large, or not a header.
    """
    return unpack_map(frame, MAX_HEADER, max_bin=0)


def unpack_map(frame: bytes, max_size: int, max_bin: int) -> "Fields":
    """The fields of a msgpack map {v, kind, ...} of at most `max_size` bytes.

    Raises:
        ProtocolError: another version.
        WireError: too large, or not such a map.
    """
    if len(frame) > max_size:
        raise WireError(f"the header has {len(frame)} bytes, at most {max_size}")
    try:
        values = msgpack.unpackb(
            frame,
            raw=False,
            strict_map_key=True,
            max_str_len=MAX_TEXT,
            max_bin_len=max_bin,
            max_array_len=0,
            max_map_len=MAX_ENTRIES,
            max_ext_len=0,
        )
    except (ValueError, msgpack.UnpackException) as error:
        raise WireError(f"the header is not msgpack within the limits: {error}") from None
    if not isinstance(values, dict):
        raise WireError(f"the header must be a map, got {_shown(values)}")
    fields = Fields(values)
    version = fields.integer("v", 0)
    if version != PROTOCOL:
        raise ProtocolError(
            f"the other side speaks protocol {version}, this one {PROTOCOL}: "
            "install the same version of tangram on both"
        )
    fields.kind = fields.text("kind", 32)
    return fields


class Fields:
    """The fields of one message; each is taken once, and `end` refuses what is left.

    Attributes:
        kind: of the message, in front of every reason.
    """

    def __init__(self, values: dict[str, Any]) -> None:
        self.kind = "header"
        self._values = values

    def integer(self, name: str, low: int, high: int = MAX_INTEGER) -> int:
        """An integer between low and high."""
        value = self._take(name)
        if type(value) is not int or not low <= value <= high:
            raise self._error(name, f"an integer between {low} and {high}", value)
        return value

    def boolean(self, name: str) -> bool:
        """True or false."""
        value = self._take(name)
        if not isinstance(value, bool):
            raise self._error(name, "true or false", value)
        return value

    def text(self, name: str, limit: int = MAX_TEXT, choices: Collection[str] = ()) -> str:
        """A text of at most `limit` characters, one of the choices if there are any."""
        value = self._take(name)
        if not isinstance(value, str) or len(value) > limit:
            raise self._error(name, f"a text of at most {limit} characters", value)
        if choices and value not in choices:
            raise self._error(name, f"one of {', '.join(choices)}", value)
        return value

    def texts(self, name: str, limit: int) -> dict[str, str]:
        """A map from names to texts of at most `limit` characters."""
        values = self._map(name)
        for key, value in values.items():
            if not isinstance(value, str) or len(value) > limit:
                raise self._error(f"{name}.{key}", f"a text of at most {limit} characters", value)
        return values

    def numbers(self, name: str) -> dict[str, float]:
        """A map from names to finite numbers."""
        values = self._map(name)
        for key, value in values.items():
            check_number(f"{self.kind}: {name}.{key}", value)
        return {key: float(value) for key, value in values.items()}

    def data(self, name: str) -> bytes:
        """Raw bytes."""
        value = self._take(name)
        if not isinstance(value, bytes):
            raise self._error(name, "bytes", value)
        return value

    def end(self) -> None:
        """Raise WireError if a field was not taken."""
        if self._values:
            raise WireError(f"{self.kind}: unknown field {_shown(min(self._values))}")

    def _map(self, name: str) -> dict[str, Any]:
        values = self._take(name)
        if not isinstance(values, dict):
            raise self._error(name, "a map", values)
        for key in values:
            check_name(f"{self.kind}: {name}", key)
        return values

    def _take(self, name: str) -> Any:
        if name not in self._values:
            raise WireError(f"{self.kind}: the field {name} is missing")
        return self._values.pop(name)

    def _error(self, name: str, wanted: str, value: object) -> WireError:
        return WireError(f"{self.kind}: {name} must be {wanted}, got {_shown(value)}")


def check_name(where: str, name: object) -> None:
    """Raise WireError unless it is 1 to 64 characters of a-z, 0-9, underscore, dot and slash."""
    if not (isinstance(name, str) and NAME.fullmatch(name)):
        raise WireError(
            f"{where}: a name is 1 to 64 characters of a-z, 0-9, _, . and /, got {_shown(name)}"
        )


def check_number(where: str, value: Any) -> None:
    """Raise WireError unless it is a finite number (a boolean is none)."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    # NaN compares false, so it is refused here as well.
    if not (number and -MAX_NUMBER <= value <= MAX_NUMBER):
        raise WireError(f"{where} must be a finite number, got {_shown(value)}")


def checked_numbers(where: str, values: Mapping[str, float]) -> dict[str, float]:
    """The same as a plain dict, for packing.

    Raises:
        WireError: too many, or a name or value that a receiver would refuse.
    """
    if len(values) > MAX_ENTRIES:
        raise WireError(f"{where}: at most {MAX_ENTRIES} numbers, got {len(values)}")
    plain = {name: float(value) for name, value in values.items()}
    for name, value in plain.items():
        check_name(where, name)
        check_number(f"{where}: {name}", value)
    return plain


def _shown(value: object) -> str:
    """A short form that is safe in a log: quoted, and never a nested structure."""
    if isinstance(value, str):
        return repr(value if len(value) <= 40 else value[:40] + "...")
    if value is None or isinstance(value, bool | int | float):
        return repr(value)
    return f"a {type(value).__name__}"
