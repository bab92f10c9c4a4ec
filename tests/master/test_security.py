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
    "content",
    [
        "",
        "[]",
        "{}",
        json.dumps(asdict(make_keys()) | {"more": 1}),
        json.dumps(asdict(make_keys()) | {"server_secret": "x" * 40}),
        json.dumps(asdict(make_keys()) | {"worker_secret": "short"}),
        json.dumps(asdict(make_keys()) | {"worker_public": make_keys().worker_public}),
        json.dumps(asdict(make_keys()) | {"server_public": 7}),
    ],
)
def test_a_file_that_holds_something_else_is_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "keys.json"
    path.write_text(content)
    with pytest.raises(RunError, match=r"keys\.json does not hold the run's keys .*: delete it"):
        run_keys(path)


@pytest.mark.parametrize(
    ("bind", "loopback"),
    [
        ("127.0.0.1", True),
        ("127.9.9.9", True),
        ("localhost", True),
        ("::1", True),
        ("0.0.0.0", False),  # noqa: S104
        ("10.0.0.1", False),
        ("::", False),
        ("*", False),
        ("eth0", False),
        ("node7.cluster", False),
    ],
)
def test_everything_but_loopback_is_encrypted_unless_it_is_asked_for_by_name(
    bind: str, loopback: bool
) -> None:
    assert is_loopback(bind) is loopback
    assert needs_keys(bind, "auto") is not loopback
    assert needs_keys(bind, "curve") is True
    assert needs_keys(bind, "plain") is False


def test_secrets_are_not_shown() -> None:
    keys = Keys("a", "SECRET", "b", "SECRET")
    assert "SECRET" not in repr(keys)
