"""Declaration, checksum and reading of messages; the messages themselves are in `messages`.

A message is a frozen dataclass. Each field's annotation has the bound of the field. Fields are
checked before sending and after receiving, in both directions, by the same code.

A message is sent as a list of frames: first the header, a small msgpack map {v, kind, fields...,
crc}, then raw arrays (`arrays`). `crc` is the CRC-32 of all frames without the last four bytes of
the header, which hold it. It is checked before anything is decoded, in every message: a damaged
acknowledgement would lose a batch just like a damaged batch. The version is always the first key
of the header, so that another version of the protocol is not mistaken for damage.
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
MAX_TEXTS = 8 * 1024  # bytes of all texts in a lenient map
MAX_ENTRIES = 64
MAX_COUNT = 2**53  # a float64 holds every integer up to this
MAX_NUMBER = 1e18
NAME = re.compile(r"[a-z0-9_./]{1,64}")
CHECKSUM = 4  # bytes at the end of a header
MARK = b"\xa3crc\xce"  # bytes before the checksum: the key, and msgpack's type byte for 32 bits


class ProtocolError(WireError):
    """The peer uses another version of the protocol."""


class DamagedError(WireError):
    """The checksum does not match the message: no field of it can be used."""


# Bounds of fields


class Bound:
    """Base of the bounds of a field."""

    def check(self, where: str, value: Any) -> Any:
        """The checked value; WireError, which begins with `where`, if it is out of bounds."""
        raise NotImplementedError

    def fit(self, value: Any) -> Any:
        """The value clipped or cut to the bounds if that hides no mistake; else unchanged."""
        return value


@dataclass(frozen=True)
class Between(Bound):
    """An integer from low to high."""

    low: int
    high: int = MAX_COUNT

    def check(self, where: str, value: Any) -> int:
        """The checked integer; a bool is refused."""
        if type(value) is not int or not self.low <= value <= self.high:
            raise _wrong(where, f"an integer between {self.low} and {self.high}", value)
        return value


@dataclass(frozen=True)
class Flag(Bound):
    """A bool."""

    def check(self, where: str, value: Any) -> bool:
        """The checked bool; 0 and 1 are refused."""
        if not isinstance(value, bool):
            raise _wrong(where, "true or false", value)
        return value


def plain(text: str) -> str:
    """The text of a peer with control characters escaped, as they could change a terminal."""
    if text.isprintable():
        return text
    return "".join(
        one if one.isprintable() else one.encode("unicode_escape").decode() for one in text
    )


@dataclass(frozen=True)
class Text(Bound):
    """A text of limited length; control characters are escaped by `plain`.

    Attributes:
        longest: most characters.
        choices: allowed texts; empty: any text.
        needed: whether an empty text is refused.
        cut: whether `fit` cuts the text to `longest` bytes and replaces invalid characters.
    """

    longest: int = MAX_TEXT
    choices: Collection[str] = ()
    needed: bool = False
    cut: bool = False

    def check(self, where: str, value: Any) -> str:
        """The checked text, made `plain`."""
        if not isinstance(value, str) or len(value) > self.longest:
            raise _wrong(where, f"a text of at most {self.longest} characters", value)
        if self.choices and value not in self.choices:
            raise _wrong(where, f"one of {', '.join(self.choices)}", value)
        if self.needed and not value:
            raise WireError(f"{where} must not be empty")
        return plain(value)

    def fit(self, value: Any) -> Any:
        """The text, cut if `cut` is set."""
        return _cut(value, self.longest) if self.cut else value


@dataclass(frozen=True)
class Numbers(Bound):
    """A map from names to finite numbers.

    Attributes:
        lenient: whether `fit` clips numbers and leaves out other entries. These numbers are only
            shown to people, so a wrong one must not stop the process.
    """

    lenient: bool = False

    def check(self, where: str, value: Any) -> dict[str, float]:
        """The checked map, all numbers as floats."""
        for key, number in _entries(where, value):
            known = isinstance(number, int | float) and not isinstance(number, bool)
            if not (known and -MAX_NUMBER <= number <= MAX_NUMBER):  # false for NaN
                raise _wrong(f"{where}.{key}", "a finite number", number)
        return {key: float(number) for key, number in value.items()}

    def fit(self, value: Any) -> Any:
        """The map with all numbers as floats; if lenient, clipped and without other entries."""
        if not self.lenient:
            return {key: float(number) for key, number in value.items()}
        known: dict[str, Any] = {
            k: v for k, v in value.items() if _is_name(k) and isinstance(v, Real)
        }
        # An integer may be too large for a float; min and max keep NaN.
        near = {k: float(min(max(v, -MAX_NUMBER), MAX_NUMBER)) for k, v in known.items()}
        fitted = [(k, v) for k, v in near.items() if not math.isnan(v)]
        return dict(fitted[:MAX_ENTRIES])


@dataclass(frozen=True)
class Texts(Bound):
    """A map from names to texts of at most `longest` characters; `lenient` as in Numbers."""

    longest: int
    lenient: bool = False

    def check(self, where: str, value: Any) -> dict[str, str]:
        """The checked map as a dict."""
        text = Text(self.longest)
        return {key: text.check(f"{where}.{key}", one) for key, one in _entries(where, value)}

    def fit(self, value: Any) -> Any:
        """The map; if lenient, texts are cut to the limits and other entries left out."""
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
    """Base of messages: fields with bounds, and optional arrays.

    `agreed` is what both sides know of the arrays: the spec of the task or the weight shapes.
    """

    kind: ClassVar[str]
    bounds: ClassVar[Mapping[str, Bound]]  # field -> bound, in the order of the fields
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
        """Bounds of the header fields that describe the arrays."""
        return {}

    @classmethod
    def refused(cls, _header: Mapping[str, Any], error: WireError) -> WireError:
        """The error to raise for an undamaged message with wrong content."""
        return error

    def pack(self, _agreed: Any) -> tuple[Mapping[str, int], list[bytes]]:
        """Header fields that describe the arrays, and the frames of the arrays."""
        return {}, []

    @classmethod
    def unpack(cls, values: dict[str, Any], frames: Sequence[bytes], _agreed: Any) -> Self:
        """Make the message from checked fields and the frames after the header."""
        check_frames(cls.kind, frames, 0)
        return cls(**values)

    def encode(self, agreed: Any = None) -> list[bytes]:
        """The frames of the message; WireError if a value is out of bounds."""
        more, arrays = self.pack(agreed)
        values = {name: getattr(self, name) for name in self.bounds}
        return seal(self.kind, _checked(type(self), {**values, **more}, agreed), arrays)


class Table(Message):
    """Base of messages with arrays that all have the same number of rows."""

    @classmethod
    def rows(cls, agreed: Any) -> Between:
        """Bounds of the number of rows."""
        raise NotImplementedError

    @classmethod
    def columns(cls, agreed: Any, count: int) -> Sequence[Column]:
        """The columns of arrays with `count` rows."""
        raise NotImplementedError

    def arrays(self) -> Mapping[str, Any]:
        """Arrays by the names of their columns."""
        return vars(self)

    @classmethod
    def described(cls, agreed: Any) -> Mapping[str, Bound]:
        """The bounds of `count`, the number of rows."""
        return {"count": cls.rows(agreed)}

    def pack(self, agreed: Any) -> tuple[Mapping[str, int], list[bytes]]:
        """The number of rows, and the raw frames of the columns."""
        arrays = self.arrays()
        count = len(arrays[self.columns(agreed, 1)[0].name])
        return {"count": count}, encode_columns(arrays, self.columns(agreed, count))

    @classmethod
    def unpack(cls, values: dict[str, Any], frames: Sequence[bytes], agreed: Any) -> Self:
        """The message with its arrays, as views of the frames if possible."""
        count = values.pop("count")
        return cls.filled(values, decode_columns(frames, cls.columns(agreed, count)))

    @classmethod
    def filled(cls, values: dict[str, Any], arrays: dict[str, Any]) -> Self:
        """Make the message from header fields and arrays."""
        return cls(**values, **arrays)


def by_kind(union: Any) -> dict[str, type[Message]]:
    """Kind -> class of the messages in a union."""
    return {cls.kind: cls for cls in get_args(union)}


def read(
    cls: type[Kind], header: Mapping[str, Any], frames: Sequence[bytes] = (), agreed: Any = None
) -> Kind:
    """Make a message from a header of `opened` and its frames; WireError names a wrong field."""
    if header["kind"] != cls.kind:
        raise WireError(f"expected {cls.kind}, got a message of kind {header['kind']!r}")
    values = {name: value for name, value in header.items() if name != "kind"}
    return cls.unpack(_checked(cls, values, agreed), frames, agreed)


def received(frames: Sequence[bytes], kinds: Mapping[str, type[Message]], agreed: Any) -> Message:
    """Read a message of one of these kinds; errors as in `opened` and `read`."""
    header = opened(frames)
    cls = kinds.get(header["kind"])
    if cls is None:
        raise WireError(f"unknown kind of message {header['kind']!r}")
    try:
        return read(cls, header, frames[1:], agreed)
    except WireError as error:
        raise cls.refused(header, error) from None


def check_frames(kind: str, frames: Sequence[bytes], count: int) -> None:
    """Raise WireError unless `count` frames follow the header."""
    if len(frames) != count:
        many = "1 frame" if not count else f"{1 + count} frames"
        raise WireError(f"{kind}: there must be {many}, got {1 + len(frames)}")


def _checked(cls: type[Message], values: dict[str, Any], agreed: Any) -> dict[str, Any]:
    """The checked header fields; missing and unknown ones are refused."""
    bounds = {**cls.bounds, **cls.described(agreed)}
    if values.keys() != bounds.keys():
        for name in bounds:
            _require(cls.kind, values, name)
        raise WireError(f"{cls.kind}: unknown field {_shown(min(values.keys() - bounds.keys()))}")
    return {n: bound.check(f"{cls.kind}: {n}", values[n]) for n, bound in bounds.items()}


# Headers


def seal(kind: str, fields: Mapping[str, object], frames: Sequence[bytes]) -> list[bytes]:
    """Put the header {v, kind, fields..., crc} before frames; WireError if it is too large."""
    largest = 2**32 - 1  # packed in 32 bits, which the checksum replaces
    header: bytes = msgpack.packb({"v": PROTOCOL, "kind": kind, **fields, "crc": largest})
    if len(header) > MAX_HEADER:
        raise WireError(f"{kind}: the header has {len(header)} bytes, at most {MAX_HEADER}")
    body = header[:-CHECKSUM]
    return [body + checksum(body, frames).to_bytes(CHECKSUM, "big"), *frames]


def opened(frames: Sequence[bytes]) -> dict[str, Any]:
    """The header of a message after its checksum is verified; the fields are not checked yet.

    Raises:
        ProtocolError: the peer uses another version of the protocol.
        DamagedError: the checksum does not match the message.
        WireError: the header is too large, or no header.
    """
    if not frames:
        raise WireError("the message is empty")
    header = frames[0]
    if len(header) > MAX_HEADER:
        raise WireError(f"the header has {len(header)} bytes, at most {MAX_HEADER}")
    body, sent = header[:-CHECKSUM], header[-CHECKSUM:]
    if not body.endswith(MARK):
        # A message of another version, or one with a damaged header.
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
    """CRC-32 of a header without its checksum, and of the frames after it."""
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
    """The text cut to at most `size` bytes of UTF-8."""
    return text.encode(errors="replace")[:size].decode(errors="ignore")


def _wrong(where: str, wanted: str, value: object) -> WireError:
    return WireError(f"{where} must be {wanted}, got {_shown(value)}")


def _shown(value: object) -> str:
    """A short form that is safe in a log: quoted text, and only the type of a structure."""
    if isinstance(value, str):
        return repr(value if len(value) <= 40 else value[:40] + "...")
    if value is None or isinstance(value, bool | int | float):
        return repr(value)
    return f"a {type(value).__name__}"
