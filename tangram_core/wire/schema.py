"""How messages are declared, sealed with a checksum, and read; the messages are in `messages`.

A message is a frozen dataclass. Each field's annotation carries its bound, by which it is checked
before it is sent and when it is read, in either direction, by the one reader here.

On the wire a message is a list of frames: a small msgpack map {v, kind, fields..., crc}, then raw
arrays (`arrays`). `crc` is the CRC-32 of the map without its last four bytes, which hold it, and of
all frames after it. It is checked before anything is decoded, in every message: a damaged
acknowledgement would lose a batch just as a damaged batch would. It stands in the map, whose first
key stays the version, so that another version of the protocol is told from damage.
"""

import math
import re
import zlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any, ClassVar, Self, TypeVar, get_args, get_type_hints

import msgpack

from tangram_core.errors import WireError
from tangram_core.wire.arrays import Column, decode_columns, encode_columns

PROTOCOL = 9
MAX_HEADER = 16 * 1024
MAX_KIND = 32
MAX_TEXT = 1024
MAX_TEXTS = 8 * 1024  # bytes of all texts of a lenient map
MAX_ENTRIES = 64
MAX_COUNT = 2**53  # up to here a float64 holds every integer
MAX_NUMBER = 1e18
NAME = re.compile(r"[a-z0-9_./]{1,64}")
CHECKSUM = 4  # bytes at the end of a header
MARK = b"\xa3crc\xce"  # before them: the key, and msgpack's sign for 32 bits


class ProtocolError(WireError):
    """The other side speaks another version of the protocol."""


class DamagedError(WireError):
    """The checksum is not that of the message: nothing in it, not even its number, is believed."""


# Bounds of fields


class Bound:
    """What a field may hold."""

    def check(self, where: str, value: Any) -> Any:
        """The value as a message holds it; WireError if it must not be sent or taken."""
        raise NotImplementedError

    def fit(self, value: Any) -> Any:
        """The value brought within bounds, where that hides no mistake."""
        return value


@dataclass(frozen=True)
class Between(Bound):
    """An integer."""

    low: int
    high: int = MAX_COUNT

    def check(self, where: str, value: Any) -> int:
        """An int, and no bool."""
        if type(value) is not int or not self.low <= value <= self.high:
            raise _wrong(where, f"an integer between {self.low} and {self.high}", value)
        return value


@dataclass(frozen=True)
class Flag(Bound):
    """True or false."""

    def check(self, where: str, value: Any) -> bool:
        """A bool, and no 0 or 1."""
        if not isinstance(value, bool):
            raise _wrong(where, "true or false", value)
        return value


def plain(text: str) -> str:
    """A text from a peer, with what a terminal would obey written out: an escape as `x1b`."""
    if text.isprintable():
        return text
    return "".join(
        one if one.isprintable() else one.encode("unicode_escape").decode() for one in text
    )


@dataclass(frozen=True)
class Text(Bound):
    """A text of at most so many characters, one of the choices if there are any; it comes `plain`.

    Attributes:
        longest: most characters.
        needed: it must not be empty.
        cut: longer ones are cut to so many bytes, and what UTF-8 has not is replaced.
    """

    longest: int = MAX_TEXT
    choices: Collection[str] = ()
    needed: bool = False
    cut: bool = False

    def check(self, where: str, value: Any) -> str:
        """A text within the bounds."""
        if not isinstance(value, str) or len(value) > self.longest:
            raise _wrong(where, f"a text of at most {self.longest} characters", value)
        if self.choices and value not in self.choices:
            raise _wrong(where, f"one of {', '.join(self.choices)}", value)
        if self.needed and not value:
            raise WireError(f"{where} must not be empty")
        return plain(value)

    def fit(self, value: Any) -> Any:
        """The text, cut if it may be."""
        return _cut(value, self.longest) if self.cut else value


@dataclass(frozen=True)
class Numbers(Bound):
    """A map from names to finite numbers.

    Attributes:
        lenient: what does not fit is left out or brought to the nearest bound: these numbers are
            for people to look at, and must not end the loop that tells them.
    """

    lenient: bool = False

    def check(self, where: str, value: Any) -> dict[str, float]:
        """All as floats."""
        for key, number in _entries(where, value):
            known = isinstance(number, int | float) and not isinstance(number, bool)
            if not (known and -MAX_NUMBER <= number <= MAX_NUMBER):  # nor NaN
                raise _wrong(f"{where}.{key}", "a finite number", number)
        return {key: float(number) for key, number in value.items()}

    def fit(self, value: Any) -> Any:
        """All as floats, in a lenient map those that fit."""
        if not self.lenient:
            return {key: float(number) for key, number in value.items()}
        known: dict[str, Any] = {
            k: v for k, v in value.items() if _is_name(k) and isinstance(v, Real)
        }
        # An integer may be too large for a float; NaN stays what it is between any two bounds.
        near = {k: float(min(max(v, -MAX_NUMBER), MAX_NUMBER)) for k, v in known.items()}
        fitted = [(k, v) for k, v in near.items() if not math.isnan(v)]
        return dict(fitted[:MAX_ENTRIES])


@dataclass(frozen=True)
class Texts(Bound):
    """A map from names to texts of at most so many characters; `lenient` as in Numbers."""

    longest: int
    lenient: bool = False

    def check(self, where: str, value: Any) -> dict[str, str]:
        """A plain dict."""
        text = Text(self.longest)
        return {key: text.check(f"{where}.{key}", one) for key, one in _entries(where, value)}

    def fit(self, value: Any) -> Any:
        """In a lenient map as many as there is room for, cut."""
        if not self.lenient:
            return value
        fitted, room = dict[str, str](), MAX_TEXTS
        for key, text in value.items():
            short = _cut(text, min(self.longest, room))
            if _is_name(key) and len(fitted) < MAX_ENTRIES and short:
                fitted[key] = short
                room -= len(short.encode())
        return fitted


# Declarations


Kind = TypeVar("Kind", bound="Message")


class Message:
    """What all messages share: fields with bounds, and perhaps arrays after them."""

    kind: ClassVar[str]
    bounds: ClassVar[Mapping[str, Bound]]  # of the fields that carry one, in their order
    _fitted: ClassVar[Mapping[str, Bound]]

    def __init_subclass__(cls) -> None:
        hints = get_type_hints(cls, include_extras=True)
        found = {name: getattr(hint, "__metadata__", (None,))[0] for name, hint in hints.items()}
        cls.bounds = {name: bound for name, bound in found.items() if bound is not None}
        cls._fitted = {n: b for n, b in cls.bounds.items() if type(b).fit is not Bound.fit}

    def __post_init__(self) -> None:
        for name, bound in self._fitted.items():
            object.__setattr__(self, name, bound.fit(getattr(self, name)))

    @classmethod
    def described(cls, _agreed: Any) -> Mapping[str, Bound]:
        """Header fields that describe the arrays, for a receiver that agreed on a task."""
        return {}

    @classmethod
    def refused(cls, _header: Mapping[str, Any], error: WireError) -> WireError:
        """What is raised for an intact message whose content is wrong."""
        return error

    def pack(self, _agreed: Any) -> tuple[Mapping[str, int], list[bytes]]:
        """What describes the arrays, and their frames."""
        return {}, []

    @classmethod
    def unpack(cls, values: dict[str, Any], frames: Sequence[bytes], _agreed: Any) -> Self:
        """The message of checked fields and of the frames after the header."""
        check_frames(cls.kind, frames, 0)
        return cls(**values)

    def encode(self, agreed: Any = None) -> list[bytes]:
        """The message's frames, of arrays as agreed on; WireError for what would be refused."""
        more, arrays = self.pack(agreed)
        values = {name: getattr(self, name) for name in self.bounds}
        return seal(self.kind, _checked(type(self), {**values, **more}, agreed), arrays)


class Table(Message):
    """A message with arrays of so many rows, named by their columns."""

    @classmethod
    def rows(cls, agreed: Any) -> Between:
        """How many there may be."""
        raise NotImplementedError

    @classmethod
    def columns(cls, agreed: Any, count: int) -> Sequence[Column]:
        """What the frames of so many rows must hold."""
        raise NotImplementedError

    def arrays(self) -> Mapping[str, Any]:
        """Arrays by the names of their columns."""
        return vars(self)

    @classmethod
    def described(cls, agreed: Any) -> Mapping[str, Bound]:
        """Their number."""
        return {"count": cls.rows(agreed)}

    def pack(self, agreed: Any) -> tuple[Mapping[str, int], list[bytes]]:
        """One raw frame per column."""
        arrays = self.arrays()
        count = len(arrays[self.columns(agreed, 1)[0].name])
        return {"count": count}, encode_columns(arrays, self.columns(agreed, count))

    @classmethod
    def unpack(cls, values: dict[str, Any], frames: Sequence[bytes], agreed: Any) -> Self:
        """The message with its arrays, which are views of the frames."""
        count = values.pop("count")
        return cls.filled(values, decode_columns(frames, cls.columns(agreed, count)))

    @classmethod
    def filled(cls, values: dict[str, Any], arrays: dict[str, Any]) -> Self:
        """The message of its header fields and its arrays."""
        return cls(**values, **arrays)


def by_kind(union: Any) -> dict[str, type[Message]]:
    """Kind -> class of the messages in a union."""
    return {cls.kind: cls for cls in get_args(union)}


def read(
    cls: type[Kind], header: Mapping[str, Any], frames: Sequence[bytes] = (), agreed: Any = None
) -> Kind:
    """The message of an opened header and the frames after it; WireError names the wrong field."""
    if header["kind"] != cls.kind:
        raise WireError(f"expected {cls.kind}, got a message of kind {header['kind']!r}")
    values = {name: value for name, value in header.items() if name != "kind"}
    return cls.unpack(_checked(cls, values, agreed), frames, agreed)


def received(frames: Sequence[bytes], kinds: Mapping[str, type[Message]], agreed: Any) -> Message:
    """The message in these frames, of one of these kinds; errors as in `opened` and `read`."""
    header = opened(frames)
    cls = kinds.get(header["kind"])
    if cls is None:
        raise WireError(f"unknown kind of message {header['kind']!r}")
    try:
        return read(cls, header, frames[1:], agreed)
    except WireError as error:
        raise cls.refused(header, error) from None


def check_frames(kind: str, frames: Sequence[bytes], count: int) -> None:
    """Raise WireError unless there are so many frames after the header."""
    if len(frames) != count:
        many = "1 frame" if not count else f"{1 + count} frames"
        raise WireError(f"{kind}: there must be {many}, got {1 + len(frames)}")


def _checked(cls: type[Message], values: dict[str, Any], agreed: Any) -> dict[str, Any]:
    """All header fields and no others, each within its bound."""
    bounds = {**cls.bounds, **cls.described(agreed)}
    if values.keys() != bounds.keys():
        for name in bounds:
            _require(cls.kind, values, name)
        raise WireError(f"{cls.kind}: unknown field {_shown(min(values.keys() - bounds.keys()))}")
    return {n: bound.check(f"{cls.kind}: {n}", values[n]) for n, bound in bounds.items()}


# Headers


def seal(kind: str, fields: Mapping[str, object], frames: Sequence[bytes]) -> list[bytes]:
    """The header {v, kind, fields..., crc} and the frames; WireError if it is too large."""
    largest = 2**32 - 1  # packed at the length of every checksum above 2^16
    header: bytes = msgpack.packb({"v": PROTOCOL, "kind": kind, **fields, "crc": largest})
    if len(header) > MAX_HEADER:
        raise WireError(f"{kind}: the header has {len(header)} bytes, at most {MAX_HEADER}")
    body = header[:-CHECKSUM]
    return [body + checksum(body, frames).to_bytes(CHECKSUM, "big"), *frames]


def opened(frames: Sequence[bytes]) -> dict[str, Any]:
    """The kind and the fields of a header whose checksum holds, each still to be checked.

    Raises:
        ProtocolError: another version.
        DamagedError: the checksum is not that of the message.
        WireError: too large, or not a header.
    """
    if not frames:
        raise WireError("the message is empty")
    header = frames[0]
    if len(header) > MAX_HEADER:
        raise WireError(f"the header has {len(header)} bytes, at most {MAX_HEADER}")
    body, sent = header[:-CHECKSUM], header[-CHECKSUM:]
    if not body.endswith(MARK):
        # Neither a message of this version nor one that was damaged behind its header.
        _check_version(_unpacked(header))
        raise DamagedError("the message is damaged: it has no checksum")
    found = checksum(body, frames[1:])
    if found != int.from_bytes(sent, "big"):
        raise DamagedError(
            f"the message is damaged: its checksum is {found:08x}, sent was {sent.hex()}"
        )
    fields = _unpacked(header)
    _check_version(fields)
    Text(MAX_KIND).check("header: kind", _require("header", fields, "kind"))
    return {name: value for name, value in fields.items() if name not in ("v", "crc")}


def checksum(body: bytes, frames: Sequence[bytes]) -> int:
    """CRC-32 of a header without its own checksum, and of the frames after it."""
    found = zlib.crc32(body)
    for frame in frames:
        found = zlib.crc32(frame, found)
    return found


def _unpacked(header: bytes) -> dict[str, Any]:
    try:
        values = msgpack.unpackb(
            header,
            raw=False,
            strict_map_key=True,
            max_str_len=MAX_TEXT,
            max_bin_len=0,
            max_array_len=0,
            max_map_len=MAX_ENTRIES,
            max_ext_len=0,
        )
    except (ValueError, msgpack.UnpackException) as error:
        deep = isinstance(error, msgpack.StackError)
        why = str(error) or ("it is nested too deeply" if deep else "a byte begins no value")
        raise WireError(f"the header is not msgpack within the limits: {why}") from None
    if not isinstance(values, dict):
        raise WireError(f"the header must be a map, got {_shown(values)}")
    return values


def _check_version(fields: dict[str, Any]) -> None:
    version = Between(0).check("header: v", _require("header", fields, "v"))
    if version != PROTOCOL:
        raise ProtocolError(
            f"the other side speaks protocol {version}, this one {PROTOCOL}: "
            "install the same version of tangram on both"
        )


def _require(kind: str, values: Mapping[str, Any], name: str) -> Any:
    if name not in values:
        raise WireError(f"{kind}: the field {name} is missing")
    return values[name]


def _entries(where: str, values: Any) -> Collection[tuple[str, Any]]:
    if not isinstance(values, Mapping):
        raise _wrong(where, "a map", values)
    if len(values) > MAX_ENTRIES:
        raise WireError(f"{where} may have {MAX_ENTRIES} entries, got {len(values)}")
    for key in values:
        if not _is_name(key):
            raise WireError(
                f"{where}: a name is 1 to 64 characters of a-z, 0-9, _, . and /, got {_shown(key)}"
            )
    return values.items()


def _is_name(key: Any) -> bool:
    return isinstance(key, str) and NAME.fullmatch(key) is not None


def _cut(text: str, size: int) -> str:
    """At most so many bytes of UTF-8."""
    return text.encode(errors="replace")[:size].decode(errors="ignore")


def _wrong(where: str, wanted: str, value: object) -> WireError:
    return WireError(f"{where} must be {wanted}, got {_shown(value)}")


def _shown(value: object) -> str:
    """A short form that is safe in a log: quoted, and never a nested structure."""
    if isinstance(value, str):
        return repr(value if len(value) <= 40 else value[:40] + "...")
    if value is None or isinstance(value, bool | int | float):
        return repr(value)
    return f"a {type(value).__name__}"
