"""The user's own code: which settings name it, and how it is loaded from a file.

Settings may come from a stranger, in a run's folder or from a master. So the code that they name is
loaded only if the command line, or the calling program, names it, too.
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
KIND = "kind"  # setting that names the class of a section: task.kind is given as task
KNOWN = ("gymnasium_robotics", "panda_gym")  # modules of the extra `robotics`
_ESCAPED = re.compile(r"(\\*)('|\$\{|$)")
PLAIN = re.compile(r"[\w.]+=[\w./:-]+", re.ASCII)

_named = set[str]()  # modules that may be imported
_files = set[Path]()  # files that were loaded


def own_code(name: str) -> tuple[Path, str] | None:
    """File and class of a value path/to/file.py:Name; None for any other value."""
    path, _, what = name.rpartition(":")
    if not (path.endswith(".py") and what.isidentifier()):
        return None
    with suppress(RuntimeError):  # ~name of an unknown user
        return Path(path).expanduser(), what
    return Path(path), what


def override(name: str, value: str) -> str:
    """A setting as name='value' for hydra; the value may hold blanks, `=` and quotes."""
    if names_modules(name):  # a list stays a list
        return f"{name}={value}"
    # Hydra takes backslashes as escapes only before a quote and ${.
    return f"{name}='{re.sub(_ESCAPED, _escaped, value)}'"


def _escaped(found: re.Match[str]) -> str:
    return found[1] * 2 + (found[2] and f"\\{found[2]}")


def argument(name: str, value: object) -> str:
    """A setting as name=value for a shell, quoted for the shell and for hydra if needed."""
    plain = f"{name}={value}"
    return plain if PLAIN.fullmatch(plain) else shlex.quote(override(name, str(value)))


def unquoted(value: str) -> str:
    """The value without the quotes and escapes that `override` adds."""
    quoted = len(value) > 1 and value[0] == value[-1] == "'"
    return re.sub(r"\\(.)", r"\1", value[1:-1] if quoted else value)


def code_of(resolved: Mapping[str, Any]) -> dict[str, str]:
    """The settings of a run that name code, as setting -> value for a command line.

    These are values path/to/file.py:Name and lists of modules. Each command must name them again.
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
    """Allow the import of modules from a command line, given as [one,other]."""
    _named.update(one.strip() for one in modules.strip("[]").split(","))


def check_module(setting: str, module: str) -> None:
    """Refuse a module in the settings that was neither named on the command line nor imported.

    Raises:
        ConfigError: names the argument to add.
    """
    if module not in {*KNOWN, *_named, *sys.modules}:
        raise ConfigError(
            f"the settings of the run name code, the module {module}, which is not imported unless "
            f"you name it: add {setting}=[{module}] if you trust it"
        )


def read_code(setting: str, given: str, path: Path, sha256: str | None = None) -> tuple[bytes, str]:
    """Read a user's file.

    Args:
        setting: name of the setting that names the file, for errors.
        given: value of the setting.
        path: path of the file.
        sha256: digest that the file must have; None: any.

    Returns:
        Content and sha256 digest.

    Raises:
        ConfigError: the file cannot be read, or has another digest.
    """
    try:
        if path.exists() and not path.is_file():
            raise OSError(0, "it is no file")  # reading a pipe would block
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
            f"{sha256}: name the copy in the run's folder, or begin a new run"
        )
    return source, found


def load_code(setting: str, given: str, path: Path, name: str, source: bytes) -> Any:
    """The object `name` of a user's file; the file is executed at the first call.

    Raises:
        ConfigError: the file cannot be loaded, or has no such name.
    """
    # Registered like an import, since dataclasses look up their module. The name comes from the
    # content, so two files of one name do not collide, and a file is executed once.
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
    except (Exception, SystemExit) as error:  # the user's code may raise anything
        raise OwnCodeError(f"{setting}={given}: cannot load '{path}': {where(error)}") from error
    if not hasattr(module, name):
        raise ConfigError(f"{setting}={given}: '{path}' has no '{name}'")
    return getattr(module, name)


def where(error: BaseException) -> str:
    """An exception in one line, with the last place in the user's code, if it passed there."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [one for one in frames if Path(one.filename) in _files] or frames
    line = " ".join(f"{type(error).__name__}: {error}".split())
    if isinstance(error, SyntaxError):  # its text names the place
        return line
    place = f"{own[-1].filename}, line {own[-1].lineno}, in {own[-1].name}"
    return f"{line} ({place})"
