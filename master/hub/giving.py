"""tangram-keys: makes and revokes keys of other users, also while a run is in progress."""

import fcntl
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from master.config import KeysConfig
from master.hub.security import NAME, Given, Keys, holders, make_pair, read_keys, write_keys
from master.record.audit import Audit
from master.record.rundir import RunFolder
from tangram_core.errors import UNREADABLE, ConfigError, RunError
from tangram_core.run.code import argument
from tangram_core.store.files import PRIVATE, private, write_whole
from tangram_core.wire.addresses import TCP
from tangram_core.wire.messages import ROLES

NEEDLESS = "these keys are not needed: the master uses unix sockets, or service.auth=off"
STALE = (
    "service.port is 0, any free port, so this file is stale when the master is started again; "
    "start the master with a fixed port, as with service.port=5577, for files that last"
)


def change_keys(config: KeysConfig) -> list[str]:
    """Make a key, revoke a key, or list the keys, as the config says.

    Returns:
        Lines for the user; the list of keys if nothing was to be changed.

    Raises:
        TangramError: the change is not possible; nothing was changed.
    """
    folder = RunFolder(config.run_dir)
    if not folder.keys.exists():
        raise RunError(_no_keys(folder))
    with _alone(folder):
        keys = read_keys(folder.keys)
        if config.add is not None:
            return _add(config, folder, keys, config.add)
        if config.revoke is not None:
            return [_revoke(folder, keys, config.revoke)]
    own, needless = set(ROLES), "server_key" not in _content(folder.connection, {"server_key": ""})
    listed = [
        f"{one.name}: role={one.role}{', of the run itself' if one.name in own else ''}"
        for one in holders(keys).values()
    ]
    return [*listed, NEEDLESS] if needless else listed


def _no_keys(folder: RunFolder) -> str:
    path = folder.path
    if path.is_file():
        return f"run_dir={path} is a file: run_dir= takes the folder of a run, as in runs/my_run"
    if not folder.config.exists():
        return f"there is no run at {path}: run_dir= takes the folder of a run, as in runs/my_run"
    if folder.result.exists() and not folder.connection.exists():
        return f"run {path.name} has ended, and it had no keys"
    return (
        f"{path} has no keys: they are made when its master first listens on a network address, as "
        "with service.bind=0.0.0.0; unix sockets need no keys"
    )


def _add(config: KeysConfig, folder: RunFolder, keys: Keys, name: str) -> list[str]:
    out = Path(config.out or f"{name}.json").absolute()
    if name in ROLES or name in keys.given:
        raise ConfigError(
            f"{name} has a key already: choose another name, or revoke it first if you made it"
        )
    if not NAME.fullmatch(name):
        raise ConfigError(
            f"add must be a name of at most 64 letters, digits, dots, dashes and underscores, got "
            f"'{name}': set add=alice"
        )
    if out.exists():
        old = _content(out, {}).get("keys")
        given = old.values() if isinstance(old, dict) else []
        publics = {str(one.get("public")) for one in given if isinstance(one, dict)}
        former = publics and not holders(keys).keys() & publics
        remedy = "delete it (its key is not valid in this run any more), or " if former else ""
        raise ConfigError(f"out={out} exists already: {remedy}name another file with out=")
    connection, pair = _connection(folder), make_pair()
    given = {**keys.given, name: Given(config.role, pair.public)}
    mine = connection | {"keys": {config.role: asdict(pair)}}
    write_whole(out, json.dumps(mine, indent=1).encode(), PRIVATE)
    write_keys(folder.keys, replace(keys, given=given))
    Audit(folder.audit).note("key added", key=name, role=config.role)
    line = f"tangram-worker {argument('connect', out.name)} role={config.role}"
    told = [f"{out} lets {name} take part as {config.role} ({line}): send it over a private way"]
    if connection.get("settings", {}).get("service", {}).get("port") == 0:
        told.append(STALE)
    return told


def _revoke(folder: RunFolder, keys: Keys, name: str) -> str:
    if name not in keys.given:
        known = ", ".join(keys.given) or "none"
        raise ConfigError(f"revoke must name a key made by tangram-keys ({known}), got '{name}'")
    given = {one: key for one, key in keys.given.items() if one != name}
    write_keys(folder.keys, replace(keys, given=given))
    Audit(folder.audit).note("key revoked", key=name)
    return f"the key of {name} is revoked"


def _connection(folder: RunFolder) -> dict[str, Any]:
    content = _content(folder.connection, {})
    if str(content.get("endpoint")).startswith(TCP) and "server_key" in content:
        return content
    raise RunError(
        f"no master of {folder.path} listens on a network address with keys: start it, as with "
        "service.bind=0.0.0.0; the connection file needs its address"
    )


def _content(path: Path, otherwise: dict[str, Any]) -> dict[str, Any]:
    """The content of a connection file, `otherwise` if it cannot be read."""
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except UNREADABLE:
        return otherwise


@contextmanager
def _alone(folder: RunFolder) -> Iterator[None]:
    """Lock the keys: two commands at the same time would lose a change."""
    with open(folder.path / ".keys.lock", "ab", opener=private) as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
