"""Code of the user's own: which settings name it, and how it is read from a file.

Settings may come from anybody: from a run's folder or a master. So what they name is loaded only
where a command line, or a program, names it itself.
"""

import hashlib
import re
import shlex
import sys
import traceback
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any

from tangram_core.errors import ConfigError, OwnCodeError

IMPORTS = "imports"  # setting of any section: modules to import
KIND = "kind"  # setting of a section that names what it is of: task.kind is given as task
KNOWN = ("gymnasium_robotics", "panda_gym")  # modules of the extra `robotics`
_ESCAPED = re.compile(r"(\\*)('|\$\{|$)")
PLAIN = re.compile(r"[\w.]+=[\w./:-]+", re.ASCII)

_named = set[str]()  # modules
_files = set[Path]()  # that were loaded


def own_code(name: str) -> tuple[Path, str] | None:
    """File and name of what is in it, where a setting is code of the user's own."""
    path, _, what = name.rpartition(":")
    if not (path.endswith(".py") and what.isidentifier()):
        return None
    with suppress(RuntimeError):  # there is no such user
        return Path(path).expanduser(), what
    return Path(path), what


def override(name: str, value: str) -> str:
    """A setting whose value may hold anything, such as a path with blanks or `=`, for hydra."""
    if names_modules(name):  # a list, and it stays one
        return f"{name}={value}"
    # Backslashes escape only a quote and ${, which would be looked up.
    return f"{name}='{re.sub(_ESCAPED, _escaped, value)}'"


def _escaped(found: re.Match[str]) -> str:
    return found[1] * 2 + (found[2] and f"\\{found[2]}")


def argument(name: str, value: object) -> str:
    """A setting to be pasted into a shell; quoted for it and for hydra where it must be."""
    plain = f"{name}={value}"
    return plain if PLAIN.fullmatch(plain) else shlex.quote(override(name, str(value)))


def unquoted(value: str) -> str:
    """A value as it was before it was quoted, or its signs escaped, for a command line."""
    quoted = len(value) > 1 and value[0] == value[-1] == "'"
    return re.sub(r"\\(.)", r"\1", value[1:-1] if quoted else value)


def code_of(resolved: Mapping[str, Any]) -> dict[str, str]:
    """The settings of a run that are code, which each of its commands must name itself.

    These are the values path/to/file.py:Name, and lists of modules.
    """
    found = dict[str, str]()
    for section, content in resolved.items():
        for key, value in content.items() if isinstance(content, Mapping) else ():
            name = section if key == KIND else f"{section}.{key}"
            if isinstance(value, str) and own_code(value) is not None:
                found[name] = value
            elif names_modules(name) and isinstance(value, list | tuple) and {*value} - {*KNOWN}:
                found[name] = f"[{','.join(map(str, value))}]"
    return found


def names_modules(name: str) -> bool:
    """Whether a setting is a list of modules to import."""
    return name.endswith(f".{IMPORTS}")


def name_modules(modules: str) -> None:
    """Let modules be imported that a command line names, as [one,other]."""
    _named.update(one.strip() for one in modules.strip("[]").split(","))


def check_module(setting: str, module: str) -> None:
    """Refuse a module that a setting names, and nobody named here or has imported.

    Raises:
        ConfigError: says what to add.
    """
    if module not in {*KNOWN, *_named, *sys.modules}:
        raise ConfigError(
            f"the settings of the run name code, the module {module}, which is not imported unless "
            f"you name it: add {setting}=[{module}] if you trust it"
        )


def read_code(setting: str, given: str, path: Path, sha256: str | None = None) -> tuple[bytes, str]:
    """Content of a user's file, and its digest.

    Args:
        setting: that names it, for errors.
        given: its value.
        path: of the file.
        sha256: that it must have; None: any.

    Raises:
        ConfigError: it cannot be read, or has another content.
    """
    try:
        if path.exists() and not path.is_file():
            raise OSError(0, "it is no file")  # a pipe would be waited for
        source = path.read_bytes()
    except OSError as error:
        raise ConfigError(
            f"{setting}={given}: cannot read '{path}' on this machine "
            f"({error.strerror or error}): put a copy there, or say where it lies with "
            f"{setting}=path/to/file.py:{given.rpartition(':')[2]}"
        ) from None
    found = hashlib.sha256(source).hexdigest()
    if sha256 not in (None, found):
        raise ConfigError(
            f"{setting}={given}: '{path}' has sha256 {found}, and the settings of the run want "
            f"{sha256}: name the file that it began with, or begin a new run"
        )
    return source, found


def load_code(setting: str, given: str, path: Path, name: str, source: bytes) -> Any:
    """What a user's file has under a name.

    Raises:
        ConfigError: it cannot be loaded, or has none.
    """
    # Registered as an import would, since dataclasses look their module up. A user's file is not
    # found by this name; two files with one name do not meet, and a task knows its own agent.
    full = f"_tangram_own_{hashlib.sha256(source).hexdigest()[:16]}"
    module = sys.modules.get(full)
    _files.add(path)
    try:
        if module is None:
            sys.modules[full] = module = ModuleType(full)
            module.__file__ = str(path)
            try:
                exec(compile(source, path, "exec"), module.__dict__)  # noqa: S102
            except BaseException:
                del sys.modules[full]
                raise
    except ImportError as error:
        raise ConfigError(
            f"{setting}={given}: cannot load '{path}' ({type(error).__name__}: {error}): it must "
            "be one file that needs nothing but installed packages"
        ) from error
    except (Exception, SystemExit) as error:  # it is the user's code: anything may go wrong
        raise OwnCodeError(f"{setting}={given}: cannot load '{path}': {where(error)}") from error
    if not hasattr(module, name):
        raise ConfigError(f"{setting}={given}: '{path}' has no '{name}'")
    return getattr(module, name)


def where(error: BaseException) -> str:
    """An exception of a user's code in one line, with the place in it, where it passed there."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [one for one in frames if Path(one.filename) in _files] or frames
    line = " ".join(f"{type(error).__name__}: {error}".split())
    if isinstance(error, SyntaxError):  # it names the place itself
        return line
    place = f"{own[-1].filename}, line {own[-1].lineno}, in {own[-1].name}"
    return f"{line} ({place})"
