"""Arrays in messages: raw little-endian frames for episodes and tables, safetensors for weights.

Array frames have no shape and no dtype: both follow from the number of rows and from the task that
sender and receiver agreed on in HELLO. The receiver checks the exact size of a frame and the bounds
of every value. Decoded arrays are read-only. A large array is cut into several frames; only such an
array is copied when decoded.
"""

import math
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import islice
from typing import Any

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError
from safetensors.numpy import load, save

from tangram_core.arrays import Singles
from tangram_core.errors import ConfigError, WireError
from tangram_core.spec import EpisodeSpec, Field

WeightShapes = Mapping[str, tuple[int, ...]]

MAX_EPISODES = 4096
# The master must hold one frame of this size from anybody who connects, before it checks anything.
MAX_FRAME_BYTES = 32 * 1024
MAX_BATCH_BYTES = 2 * 2**20
MAX_WEIGHTS_BYTES = 64 * 2**20
ROUNDING = 1e-6
_LITTLE = {"f4": "<f4", "u1": "u1"}
LENGTH = struct.Struct("<I")
MAX_FRAMES = MAX_BATCH_BYTES // MAX_FRAME_BYTES + 64  # of arrays: the last of each is not full


@dataclass(frozen=True)
class Column:
    """Declaration of one array in a message.

    Attributes:
        name: name of the array, also in errors.
        dtype: little-endian dtype.
        shape: exact shape.
        low, high: finite bounds of every value.
    """

    name: str
    dtype: str
    shape: tuple[int, ...]
    low: float
    high: float

    @cached_property
    def size(self) -> int:
        """Size in bytes."""
        return math.prod(self.shape) * np.dtype(self.dtype).itemsize

    @cached_property
    def frames(self) -> int:
        """Number of frames for the array."""
        return max(1, math.ceil(self.size / MAX_FRAME_BYTES))

    @cached_property
    def native(self) -> np.dtype[Any]:
        """The dtype in the byte order of this machine."""
        return np.dtype(self.dtype).newbyteorder("=")

    @cached_property
    def bounds(self) -> tuple[float, float]:
        """Low and high rounded to the dtype, as the values are."""
        return float(self.native.type(self.low)), float(self.native.type(self.high))

    def encode(self, array: npt.NDArray[Any]) -> bytes:
        """The array as bytes; WireError for another shape, or a value out of bounds."""
        if array.shape != self.shape:
            raise WireError(f"{self.name} must have the shape {self.shape}, got {array.shape}")
        array = np.ascontiguousarray(array)  # else each step below would copy it
        self._check(array)
        return array.astype(self.dtype, copy=False).tobytes()

    def decode(self, frame: bytes) -> npt.NDArray[Any]:
        """A read-only view of the bytes as array; WireError for a wrong size or value."""
        if len(frame) != self.size:
            raise WireError(
                f"{self.name} must have {self.size} bytes for the shape {self.shape}, "
                f"got {len(frame)}"
            )
        array: npt.NDArray[Any] = np.ndarray(self.shape, self.dtype, frame)
        array = array.astype(self.native, copy=False)
        self._check(array)
        return array

    def _check(self, array: npt.NDArray[Any]) -> None:
        low, high = self.bounds
        # The extremes of an array with a NaN are NaN, and comparisons with NaN are false. For small
        # arrays argmin() and argmax() take a fraction of the time of min() and max().
        if array.size == 0 or (
            array.item(array.argmin()) >= low and array.item(array.argmax()) <= high
        ):
            return
        where = np.argwhere(~((array >= low) & (array <= high)))[0].tolist()
        raise WireError(
            f"{self.name} holds {array[tuple(where)]:g} at {where}, must be finite and between "
            f"{self.low:g} and {self.high:g}"
        )


@lru_cache
def columns(spec: EpisodeSpec, count: int) -> tuple[Column, ...]:
    """The arrays of `count` episodes, in the order of `spec.every`."""
    return tuple(_column(field, (count, *field.rows(spec.horizon))) for field in spec.every)


def _column(field: Field, shape: tuple[int, ...]) -> Column:
    # Rounding a float64 value to float32 may pass its bounds.
    room = 0.0 if field.dtype == "u1" else ROUNDING
    low, high = field.low - room * abs(field.low), field.high + room * abs(field.high)
    return Column(field.name, _LITTLE[field.dtype], shape, low, high)


def most_episodes(spec: EpisodeSpec) -> int:
    """Largest number of episodes in one message, which has a bound in bytes, too."""
    return min(MAX_EPISODES, MAX_BATCH_BYTES // _bytes(spec))


def _bytes(spec: EpisodeSpec) -> int:
    """Size of one episode in bytes."""
    return sum(column.size for column in columns(spec, 1))


def check_batch_size(spec: EpisodeSpec, count: int = 1) -> None:
    """Raise ConfigError if `count` episodes are too many for one message."""
    if count > most_episodes(spec):
        raise ConfigError(
            f"{count} episodes of {spec.horizon} steps, {_bytes(spec):,} bytes each, are too many "
            f"for one message, at most {most_episodes(spec)}: lower service.envs, or shorten the "
            "episodes"
        )


def encode_columns(
    arrays: Mapping[str, npt.NDArray[Any]], columns: Sequence[Column]
) -> list[bytes]:
    """Raw frames of arrays, large ones cut; WireError if an array breaks its column."""
    whole = [column.encode(arrays[column.name]) for column in columns]
    if all(column.frames == 1 for column in columns):
        return whole
    return [
        data[i * MAX_FRAME_BYTES : (i + 1) * MAX_FRAME_BYTES]
        for data, column in zip(whole, columns, strict=True)
        for i in range(column.frames)
    ]


def decode_columns(
    frames: Sequence[bytes], columns: Sequence[Column]
) -> dict[str, npt.NDArray[Any]]:
    """Arrays by name; WireError for a wrong number of frames, or if one breaks its column."""
    count = sum(column.frames for column in columns)
    if len(frames) != count:
        raise WireError(f"there must be {count} array frames, got {len(frames)}")
    if count > len(columns):
        rest = iter(frames)
        frames = [b"".join(islice(rest, column.frames)) for column in columns]
    return {c.name: c.decode(f) for c, f in zip(columns, frames, strict=True)}


def encode_tensors(tensors: Mapping[str, Singles]) -> bytes:
    """Weights as one safetensors frame; WireError if they are not finite, or too large."""
    plain = {name: np.array(t, np.float32, order="C") for name, t in tensors.items()}
    _check_finite(plain)
    data = save(plain)
    if len(data) > MAX_WEIGHTS_BYTES:
        raise WireError(
            f"weights: {len(data)} bytes, at most {MAX_WEIGHTS_BYTES}: choose a smaller net"
        )
    return data


def decode_tensors(frame: bytes, shapes: WeightShapes | None) -> dict[str, Singles]:
    """The tensors in a frame of `encode_tensors`.

    Args:
        frame: the frame.
        shapes: tensor name -> shape that it must have; None: any tensors.

    Raises:
        WireError: names the tensor and the fault.
    """
    if len(frame) > MAX_WEIGHTS_BYTES:
        raise WireError(f"weights: {len(frame)} bytes, at most {MAX_WEIGHTS_BYTES}")
    tensors = load_tensors(frame, "weights")
    for name, tensor in tensors.items():
        if tensor.dtype != np.float32:
            raise WireError(f"weights: {name!r} must be float32, got {tensor.dtype}")
    if shapes is not None:
        found = {name: tensor.shape for name, tensor in tensors.items()}
        for name in sorted(found.keys() | shapes.keys()):
            wanted, got = shapes.get(name, "no such tensor"), found.get(name, "none")
            if wanted != got:
                raise WireError(f"weights: {name[:80]!r} must be {wanted}, got {got}")
    _check_finite(tensors)
    return tensors


def load_tensors(data: bytes, name: str) -> dict[str, npt.NDArray[Any]]:
    """The tensors in safetensors data; WireError, which begins with `name`, for other data."""
    try:
        return load(data)
    # KeyError: a dtype unknown to numpy; ValueError: a shape beyond numpy's limits.
    except (SafetensorError, KeyError, ValueError) as error:
        raise WireError(f"{name}: not safetensors: {error}") from None


def _check_finite(tensors: dict[str, npt.NDArray[Any]]) -> None:
    for name, tensor in tensors.items():
        if not np.isfinite(tensor).all():
            raise WireError(f"weights: {name!r} is not finite")


def join_frames(frames: Iterable[bytes]) -> bytes:
    """Join frames into one; in front of each is its length (u32)."""
    return b"".join(part for frame in frames for part in (LENGTH.pack(len(frame)), frame))


def split_frames(data: bytes) -> list[bytes]:
    """Split the result of `join_frames`; WireError if a frame is incomplete, or for too many."""
    frames, start = list[bytes](), 0
    while start < len(data):
        if len(frames) > MAX_FRAMES:  # and a header
            raise WireError(f"there may be {MAX_FRAMES + 1} joined frames, got more")
        begin = start + LENGTH.size
        size = LENGTH.unpack_from(data, start)[0] if begin <= len(data) else 0
        start = begin + size
        if start > len(data):
            raise WireError(f"frame {len(frames) + 1} of joined frames is cut short")
        frames.append(data[begin:start])
    return frames
