"""Keys of a run: made once, kept for the user alone, checked when read."""

import json
import stat
from dataclasses import asdict
from pathlib import Path

import pytest

from master.security import Keys, is_loopback, make_keys, needs_keys, run_keys
from tangram_sim.errors import RunError

pytestmark = pytest.mark.fast


def test_a_run_keeps_its_keys_and_only_the_user_reads_them(tmp_path: Path) -> None:
    path = tmp_path / "keys.json"
    made = run_keys(path)
    assert run_keys(path) == made
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert run_keys(tmp_path / "other.json") != made
    assert len(set(asdict(made).values())) == 4


@pytest.mark.parametrize(
    "change",
    [
        {"more": 1},
        {"server_secret": "x" * 40},
        {"worker_secret": "short"},
        {"worker_public": make_keys().worker_public},
        {"server_public": 7},
        "",
        "[" * 100_000,
        "[]",
        "{}",
    ],
)
def test_a_file_that_holds_something_else_is_refused(tmp_path: Path, change: object) -> None:
    path = tmp_path / "keys.json"
    whole = isinstance(change, str)
    path.write_text(str(change) if whole else json.dumps(asdict(make_keys()) | dict(change)))
    with pytest.raises(RunError, match=r"keys\.json does not hold the run's keys .*: delete it"):
        run_keys(path)


LOOPBACK = ("127.0.0.1", "127.9.9.9", "localhost", "::1")
REACHABLE = ("0.0.0.0", "10.0.0.1", "::", "*", "eth0", "node7.cluster")  # noqa: S104


@pytest.mark.parametrize("bind", [*LOOPBACK, *REACHABLE])
def test_everything_but_loopback_is_encrypted_unless_it_is_asked_for_by_name(bind: str) -> None:
    assert is_loopback(bind) is (bind in LOOPBACK)
    assert needs_keys(bind, "auto") is (bind in REACHABLE)
    assert needs_keys(bind, "curve") is True
    assert needs_keys(bind, "plain") is False


def test_secrets_are_not_shown() -> None:
    keys = Keys("a", "SECRET", "b", "SECRET")
    assert "SECRET" not in repr(keys)
