"""Keys of a run: made once, kept for the user alone, checked when read."""

import json
import os
import re
import stat
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from master.config import KeysConfig
from master.hub.giving import NEEDLESS, STALE, change_keys
from master.hub.security import (
    Given,
    Pair,
    listening_place,
    make_keys,
    make_pair,
    needs_keys,
    run_keys,
)
from master.record.audit import Audit
from master.record.rundir import RunFolder
from tangram_core.errors import ConfigError, RunError
from tangram_core.run.service import ServiceConfig

pytestmark = pytest.mark.fast


def test_a_run_keeps_its_keys_and_only_the_user_reads_them(tmp_path: Path) -> None:
    path = tmp_path / "keys.json"
    made = run_keys(path)
    assert run_keys(path) == made
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert run_keys(tmp_path / "other.json") != made
    pairs = (made.server, *made.own().values())
    assert len({key for pair in pairs for key in asdict(pair).values()}) == 6


@pytest.mark.parametrize(
    "change",
    [
        {"more": 1},
        {"server": asdict(make_pair()) | {"secret": "x" * 40}},
        {"player": asdict(make_pair()) | {"secret": "short"}},
        {"evaluator": asdict(make_pair()) | {"public": make_pair().public}},
        {"given": {"alice": {"role": "master", "public": make_pair().public}}},
        {"given": {"player": {"role": "player", "public": make_pair().public}}},
        {"given": {"a/b": {"role": "player", "public": make_pair().public}}},
        {"given": {"alice": {"role": "player", "public": make_pair().public[:-5]}}},
        "",
        "[" * 100_000,
        "[]",
        "{}",
    ],
)
def test_a_file_that_holds_something_else_is_refused(tmp_path: Path, change: object) -> None:
    path = tmp_path / "keys.json"
    whole = isinstance(change, str)
    path.write_text(str(change) if whole else json.dumps(make_keys().content() | dict(change)))
    with pytest.raises(
        RunError, match=r"keys\.json does not hold the run's keys .*: put a copy back, or delete"
    ):
        run_keys(path)


@pytest.mark.parametrize("bind", ["127.0.0.1", "localhost", "::1", "0.0.0.0", "node7"])  # noqa: S104
def test_every_address_takes_keys_unless_it_is_opened_by_name(bind: str) -> None:
    assert needs_keys(ServiceConfig(bind=bind))
    assert not needs_keys(ServiceConfig(bind=bind, auth="off"))
    assert not needs_keys(ServiceConfig())


def test_a_network_without_encryption_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zmq.has", lambda _: False)
    with pytest.raises(ConfigError, match="built without CURVE: .* leave service.bind at local"):
        needs_keys(ServiceConfig(bind="0.0.0.0"))  # noqa: S104
    assert not needs_keys(ServiceConfig(bind="0.0.0.0", auth="off"))  # noqa: S104


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda path: path.mkdir(mode=0o750), "it is drwxr-x--- of user {uid}: remove it, or set"),
        (lambda path: path.write_text(""), "it is -rw"),
        (lambda path: path.symlink_to("/"), "it is lrwxrwxrwx of user"),
        (lambda path: (path.mkdir(mode=0o700), os.chown(path, 7, 7)), "drwx------ of user 7: rem"),
        (lambda path: path.parent.rmdir(), "cannot be made (No such file or directory): set TMPD"),
    ],
)
def test_a_folder_of_sockets_that_others_may_change_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Callable[[Path], object], reason: str
) -> None:
    if "user 7" in reason and os.geteuid():
        pytest.skip("only root can give a folder away")
    folder = tmp_path / "t" / f"tangram-{os.geteuid()}"
    folder.parent.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder.parent))
    make(folder)
    with pytest.raises(RunError, match=re.escape(reason.format(uid=os.geteuid()))):
        listening_place("local", tmp_path)


def test_a_folder_too_deep_for_sockets_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    deep = tmp_path / ("x" * 80)
    deep.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(deep))
    with pytest.raises(ConfigError, match=r"at most 107 bytes: set TMPDIR to a shorter path"):
        listening_place("local", tmp_path)


def test_a_folder_whose_name_is_no_text_is_refused_before_anything_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    odd = tmp_path / "a\udcff"  # as Python has the byte 255
    odd.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(odd))
    with pytest.raises(
        ConfigError, match=r"a\\xff/tangram-.*' cannot hold sockets, as their .*: set TM"
    ):
        listening_place("local", tmp_path)
    assert list(odd.iterdir()) == []


def test_secrets_are_not_shown() -> None:
    assert "SECRET" not in repr(Pair("a", "SECRET"))


# tangram-keys


def keys_of(folder: Path, **settings: Any) -> list[str]:
    return change_keys(KeysConfig(str(folder), **settings))


def test_a_run_without_keys_says_why(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    folder.path.mkdir()

    def told(given: Path) -> str:
        with pytest.raises(RunError) as caught:
            keys_of(given)
        return str(caught.value)

    where = "run_dir= takes the folder of a run, as in runs/my_run"
    assert told(folder.path) == f"there is no run at {folder.path}: {where}"
    folder.config.touch()
    assert told(folder.config) == f"run_dir={folder.config} is a file: {where}"
    assert "has no keys: they are made when its master first listens" in told(folder.path)
    folder.result.touch()
    assert told(folder.path) == "run run has ended, and it had no keys"


def test_keys_are_given_listed_and_taken_back(tmp_path: Path) -> None:
    out, file = tmp_path / "alice.json", tmp_path / "keys.json"
    own = ["player: role=player, of the run itself", "evaluator: role=evaluator, of the run itself"]
    made = run_keys(file)
    assert keys_of(tmp_path) == own
    with pytest.raises(RunError, match=r"no master of .* on a network address with keys: start"):
        keys_of(tmp_path, add="alice")
    where = {"endpoint": "tcp://h:1", "run_id": "r", "server_key": made.server.public}
    connection = where | {"keys": {"player": asdict(made.player)}, "settings": {}}
    (tmp_path / "connection.json").write_text(json.dumps(connection))
    line = "tangram-worker connect=alice.json role=evaluator"
    told = f"{out} lets alice take part as evaluator ({line}): send it over a private way"
    assert keys_of(tmp_path, add="alice", role="evaluator", out=str(out)) == [told]
    assert keys_of(tmp_path) == [*own, "alice: role=evaluator"]
    content = json.loads(out.read_text())
    assert stat.S_IMODE(out.stat().st_mode) == 0o600
    assert made.player.secret not in out.read_text()
    assert content["keys"]["evaluator"]["secret"] not in file.read_text()
    public = content["keys"]["evaluator"]["public"]
    assert run_keys(file).given == {"alice": Given("evaluator", public)}
    for settings, reason in (
        ({"add": "alice"}, "alice has a key already: choose another name, or revoke it"),
        ({"add": "player"}, "player has a key already: choose another"),
        ({"add": "a/b"}, "add must be a name of at most 64 letters, .* got 'a/b': set add=alice"),
        ({"add": "bob", "out": str(out)}, "alice.json exists already: name another file"),
        ({"revoke": "bob"}, r"revoke must name a key made by tangram-keys \(alice\), got 'bob'"),
        ({"revoke": "alice", "add": "bob"}, "add=bob changes nothing with revoke=alice: leave it"),
        ({"out": "x"}, "out=x changes nothing with add=null: leave it out"),
        ({"role": "evaluator"}, "role=evaluator changes nothing with add=null"),
    ):
        with pytest.raises(ConfigError, match=reason):
            keys_of(tmp_path, **settings)
    (tmp_path / "audit.jsonl").rename(tmp_path / "aside")
    (tmp_path / "audit.jsonl").mkdir()  # what cannot be written there is no reason to refuse
    keys_of(tmp_path, add="bob", out=str(tmp_path / "bob.json"))
    keys_of(tmp_path, revoke="bob")
    (tmp_path / "audit.jsonl").rmdir()
    (tmp_path / "aside").rename(tmp_path / "audit.jsonl")
    assert keys_of(tmp_path, revoke="alice") == ["the key of alice is revoked"]
    assert run_keys(file) == made
    log = [json.loads(line) for line in (tmp_path / "audit.jsonl").read_text().splitlines()]
    assert [(line["event"], line["key"]) for line in log] == [
        ("key added", "alice"),
        ("key revoked", "alice"),
    ]


def test_keys_that_are_needless_or_will_be_stale_are_told(tmp_path: Path) -> None:
    made, out = run_keys(tmp_path / "keys.json"), tmp_path / "a.json"
    file = tmp_path / "connection.json"
    plain = {"endpoint": "tcp://h:1", "run_id": "r", "settings": {"service": {"port": 0}}}
    file.write_text(json.dumps(plain))
    assert keys_of(tmp_path)[-1] == NEEDLESS
    file.write_text(json.dumps(plain | {"server_key": made.server.public}))
    assert NEEDLESS not in keys_of(tmp_path)
    assert keys_of(tmp_path, add="alice", out=str(out))[1:] == [STALE]
    keys_of(tmp_path, revoke="alice")
    with pytest.raises(ConfigError, match=r"exists already: delete it \(its key is not valid in"):
        keys_of(tmp_path, add="alice", out=str(out))


def test_the_audit_is_bounded_and_counts_what_it_leaves_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("master.record.audit.BURST", {"refused": 2})
    log = Audit(tmp_path / "audit.jsonl")
    for number in range(5):
        log.note("refused", reason="x" * 1000, number=number)
    log.note("joined")
    monkeypatch.setattr("master.record.audit.REFILL_S", {"refused": 1e-9})
    monkeypatch.setattr("master.record.audit.MAX_BYTES", 10)
    log.note("refused")
    old = (tmp_path / "audit.jsonl.old").read_text().splitlines()
    assert [json.loads(line)["event"] for line in old] == ["refused", "refused", "joined"]
    assert max(map(len, old)) < 400
    [last] = (tmp_path / "audit.jsonl").read_text().splitlines()
    assert json.loads(last)["left_out"] == 3
    lost = Audit(tmp_path / "nowhere" / "audit.jsonl")
    for _ in range(2):
        lost.note("joined")
    assert len(caplog.messages) == 1
    assert "a line of the audit is missing" in caplog.text


def test_a_line_of_which_half_was_written_harms_no_other(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    path.write_text('{"time": "20')  # the disk was full
    for event in ("joined", "left"):
        Audit(path).note(event)
    half, *lines = path.read_text().splitlines()
    assert half == '{"time": "20'
    assert [json.loads(line)["event"] for line in lines] == ["joined", "left"]
