"""Declaration of settings: once, beside the code that uses them, with bounds, unit and help.

    @dataclass(frozen=True)
    class NoiseConfig(Settings, section="noise"):
        kind: str = setting("none", "which noise", choices=("none", "gaussian"))
        width: float = setting(0.1, "its deviation", low=0, unit="arena", only={"kind": "gaussian"})

A dataclass of settings checks each value when it is created. `--help` and docs/settings.md are made
from these declarations.
"""

import math
import re
import sys
from collections.abc import Collection, Mapping
from dataclasses import Field, dataclass, field, fields
from numbers import Real
from typing import Any, ClassVar, TypeVar, cast

from tangram_core.errors import ConfigError

Value = TypeVar("Value")
Metadata = Mapping[str, "Declaration"]
KEY = "setting"
# Values of `Declaration.part`.
PLAY, NETWORK, LEARNING = "play", "network", "learning"
MAX_NAME = 255  # bytes, on Linux
MAX_PATH = 3840  # bytes: Linux takes 4096, and paths inside the folder need the rest
MAX_SHOWN = 40
CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]")


@dataclass(frozen=True)
class Declaration:
    """Help, bounds, unit and conditions of a setting.

    Attributes:
        help: one line.
        low, high: bounds of the number, or of each number of a list; low=None: no bounds.
        choices: allowed texts; empty: any text.
        unit: unit of the number, as in docs/settings.md; empty: none.
        only: another setting of the section -> the value, or a tuple of values, that it must have
            for this setting to have an effect. Otherwise only the default is accepted.
        unless: the opposite of `only`: values with which this setting has no effect.
        part: PLAY: may change when a trained run plays; NETWORK: fixed by the trained weights;
            LEARNING: used in training only.
    """

    help: str
    low: float | None = None
    high: float = math.inf
    choices: tuple[str, ...] = ()
    unit: str = ""
    only: dict[str, object] = field(default_factory=dict)
    unless: dict[str, object] = field(default_factory=dict)
    part: str = PLAY


def setting(default: Value, help: str, **more: Any) -> Value:  # noqa: A002
    """A field of a `Settings` dataclass; `more` are attributes of `Declaration`."""
    return field(default=default, metadata=declared(help, **more))


def declared(help: str, **more: Any) -> Metadata:  # noqa: A002
    """The metadata of a setting without a default: `name: str = field(metadata=declared(...))`."""
    return {KEY: Declaration(help, **more)}


class Settings:
    """Base of frozen dataclasses of settings; each value is checked when one is created.

    Attributes:
        section: name of the section in a config; empty: the top level.
    """

    section: ClassVar[str] = ""

    def __init_subclass__(cls, section: str = "") -> None:
        """Set the section of a subclass."""
        cls.section = section

    def __post_init__(self) -> None:
        """Check each setting; ConfigError names the setting, its value and the bound or choices."""
        for own in declared_fields(type(self)):
            _check(setting_name(self, own.name), getattr(self, own.name), own.metadata[KEY])
        for own in declared_fields(type(self)):
            self._check_effect(own)

    def _check_effect(self, own: "Field[Any]") -> None:
        value, what = getattr(self, own.name), own.metadata[KEY]
        if value == own.default:
            return
        given = f"{setting_name(self, own.name)}={told(value)}"
        for name, needed in (what.only | what.unless).items():
            other, values = setting_name(self, name), values_of(needed)
            if (getattr(self, name) in values) == (name in what.unless):
                named = f"set {other}={' or '.join(map(told, values))}"
                left_out = f"leave {other} out" if values == (None,) else named
                remedy = left_out if name in what.only else f"give {other} another value"
                refuse_ignored(given, f"{other}={told(getattr(self, name))}", remedy, own.default)


def refuse_ignored(given: str, because: str, remedy: str, default: object = None) -> None:
    """Raise ConfigError for a setting that has no effect.

    Args:
        given: the setting, as name=value.
        because: the setting that makes `given` useless, as name=value.
        remedy: another remedy besides leaving `given` out.
        default: default of the setting, which a preset may have changed.
    """
    left = "out" if default in (None, "") else f"at {told(default)}"
    raise ConfigError(f"{given} changes nothing with {because}: leave it {left}, or {remedy}")


def declared_fields(kind: type[Any]) -> list["Field[Any]"]:
    """The fields of a dataclass that are declared with `setting` or `declared`."""
    return [own for own in fields(kind) if KEY in own.metadata]


def setting_name(owner: Settings | type[Settings], name: str) -> str:
    """The full name of a setting, as on a command line."""
    return f"{owner.section}.{name}" if owner.section else name


def values_of(needed: object) -> tuple[object, ...]:
    """The values of a condition of `Declaration.only` as a tuple."""
    return needed if isinstance(needed, tuple) else (needed,)


def told(value: object) -> str:
    """A value as text, as on a command line."""
    if value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    if isinstance(value, tuple | list):
        return f"[{','.join(map(told, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _check(name: str, value: object, what: Declaration) -> None:
    if value is None:
        return  # the type says whether None is allowed
    for one in value if isinstance(value, tuple) else (value,):
        if what.choices:
            check_choice(name, cast("str", one), what.choices)
        if what.low is not None:
            check_range(name, cast("float", one), what.low, what.high)


def check_range(name: str, value: Any, low: float, high: float = math.inf) -> None:
    """Raise ConfigError unless value is a finite number and low <= value <= high."""
    # An integer may be too large for a float.
    number = isinstance(value, Real) and not isinstance(value, bool)
    number = number and abs(value) <= sys.float_info.max
    if not (number and low <= value <= high):
        bound = f"at least {low:g}" if math.isinf(high) else f"between {low:g} and {high:g}"
        kind, got = ("", value) if number else ("a finite number, ", told(value))
        raise ConfigError(f"{name} must be {kind}{bound}, got {got}")


def check_folder(name: str, value: str) -> None:
    """Raise ConfigError unless the value can be the path of a folder for files and folders."""
    if not value.strip():
        raise ConfigError(f"{name} must name a folder, got '{value}': set {name}=runs/my_run")
    data = value.encode(errors="surrogateescape")
    if CONTROL.search(value) or len(data) > MAX_PATH or max(map(len, data.split(b"/"))) > MAX_NAME:
        shown = value if len(value) <= MAX_SHOWN else value[:MAX_SHOWN] + "..."
        raise ConfigError(
            f"{name} must be a path of at most {MAX_PATH} bytes, {MAX_NAME} in each name, without "
            f"line breaks and other control characters, got {shown!r}: set {name}=runs/my_run"
        )


def check_choice(name: str, value: str, choices: Collection[str]) -> None:
    """Raise ConfigError unless the value is one of the choices."""
    if value not in choices:
        raise ConfigError(f"{name} must be one of {', '.join(choices)}, got '{value}'")
