"""Where the master is: an address, or the file that it writes."""

import errno
import json
import re
import socket
from pathlib import Path
from threading import Event
from typing import Any

import pytest

from tangram_core.errors import RunError, UnavailableError
from tangram_core.wire.addresses import dns_error
from worker.talk.discovery import MasterAddress, await_master, find_master, host_error

pytestmark = pytest.mark.fast

REMEDY = (
    "set connect=... to host:port, a run folder, or the connection.json that tangram-master "
    "writes into it"
)


KEY = "k" * 40


def written(**more: Any) -> str:
    """A connection file."""
    return json.dumps({"endpoint": "tcp://h:1", "run_id": "r"} | more)


def test_an_address_is_taken_as_it_is() -> None:
    for address in ("127.0.0.1:5555", "learner.lan:1", "[::1]:65535", "a-b_c:7"):
        for given in (address, f"tcp://{address}"):
            assert find_master(given) == MasterAddress(f"tcp://{address}", "")


def test_a_file_that_is_called_like_an_address_is_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("run:1").write_text(json.dumps({"endpoint": "tcp://h:1", "run_id": "r"}))
    assert find_master("run:1") == MasterAddress("tcp://h:1", "r")
    assert find_master("run:2") == MasterAddress("tcp://run:2", "")


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "[::1]"])
def test_a_host_with_an_address_is_nothing_to_tell(host: str) -> None:
    assert dns_error(f"tcp://{host}:5555") == ""


@pytest.mark.parametrize("answer", ["no", "never"])
def test_a_host_that_dns_does_not_know_is_told(
    answer: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = Event()

    def resolve(host: str, _port: None) -> None:
        assert host == "learner.lan"
        if answer == "no":
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
        asked.wait(60.0)

    monkeypatch.setattr(socket, "getaddrinfo", resolve)
    said = {"no": "Name or service not known", "never": "no answer in 0.1 s"}[answer]
    error = dns_error("tcp://learner.lan:5555", patience_s=60.0 if answer == "no" else 0.1)
    asked.set()
    assert error == f"DNS knows no host 'learner.lan' ({said})"


def test_a_host_that_is_unknown_says_where_its_name_comes_from(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("worker.talk.discovery.dns_error", lambda _: "no such host")
    endpoint = "tcp://learner.lan:1"
    assert host_error(endpoint, "learner.lan:1") == "no such host: check the name in connect="
    assert host_error(endpoint, "runs/zz").startswith(
        "no such host: runs/zz has this name from its master; start it with service.host= a name"
    )


@pytest.mark.parametrize(
    "address",
    [
        "udp://h:1",
        "tcp://h",
        "tcp://h:65536",
        pytest.param(f"tcp://h:{'1' * 5000}", id="more digits than Python reads"),
        "tcp://h:x",
        "tcp://",
        "tcp://a b:1",
        "tcp://h:١٢",
        "tcp://a\udcff:1",
    ],
)
def test_a_wrong_address_is_refused(address: str) -> None:
    with pytest.raises(RunError) as caught:
        find_master(address)
    assert str(caught.value) == (
        f"'{address}' (from {address}) is no address: it must be tcp://host:port, with a port "
        "from 1 to 65535"
    )


def test_a_file_and_its_folder_are_found(tmp_path: Path) -> None:
    path = tmp_path / "connection.json"
    assert find_master(str(path)) is None
    assert find_master(str(tmp_path)) is None
    content = {"endpoint": "tcp://h:1", "weights_endpoint": "tcp://h:2", "run_id": "r", "more": 1}
    path.write_text(json.dumps(content))
    assert find_master(str(path)) == MasterAddress("tcp://h:1", "r")
    assert find_master(str(tmp_path)) == MasterAddress("tcp://h:1", "r")


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("", "it is not JSON)"),
        ("[]", "its values have the wrong types)"),
        ("{}", "it has no endpoint)"),
        ('{"endpoint": "tcp://h:1"}', "it has no run_id)"),
        ("[" * 100_000, "it is nested too deeply)"),
        (written(server_key="short"), "server_key must be a key, 40 characters of Z85)"),
        (written(server_key=KEY), "it has a server_key but no keys)"),
        (written(keys={"player": {"public": KEY, "secret": KEY}}), "server_key must be a key,"),
        (written(keys=[]), "its values have the wrong types"),
        (written(keys={"player": {}}), "it has no public)"),
        *(
            (
                written(server_key=KEY, keys={"player": {"public": KEY, "secret": KEY} | wrong}),
                f"keys.player.{next(iter(wrong))} must be a key, 40 characters of Z85)",
            )
            for wrong in (
                {"public": "%" * 40},  # characters of Z85, of more than 32 bits
                {"secret": "~" * 40},
                {"secret": "ä" * 40},
                {"secret": KEY[5:]},
                {"secret": KEY + "\n"},
                {"secret": 7},
            )
        ),
        (written(endpoint="ipc:///tmp/\udcff/x"), "'utf-8' codec can't encode"),
        (written(run_id="\udcff"), "'utf-8' codec can't encode"),
    ],
)
def test_a_file_that_is_no_connection_file(tmp_path: Path, content: str, reason: str) -> None:
    path = tmp_path / "c.json"
    path.write_text(content)
    with pytest.raises(RunError) as caught:
        find_master(str(path))
    assert str(caught.value).startswith(f"{path} is no connection file ({reason}")
    assert str(caught.value).endswith(REMEDY)


def test_the_settings_of_the_run_stand_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    content = {"endpoint": "tcp://h:1", "run_id": "r", "settings": {"net": {"width": 3}}}
    path.write_text(json.dumps(content))
    found = await_master(str(path), pytest.fail)
    assert found.settings == {"net": {"width": 3}}
    assert found == MasterAddress("tcp://h:1", "r")
    path.write_text(json.dumps(content | {"settings": 3}))
    with pytest.raises(RunError, match=r"settings must be a map"):
        find_master(str(path))


def test_a_disk_that_fails_is_told_as_a_file_that_cannot_be_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(_: Path) -> bool:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(Path, "is_dir", fails)
    with pytest.raises(RunError, match=r"is no connection file \(Input/output error"):
        find_master(str(tmp_path))


def test_a_file_that_comes_late_is_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    told: list[str] = []

    def tell(line: str) -> None:
        told.append(line)
        path.write_text(json.dumps({"endpoint": "tcp://h:1", "run_id": "r"}))

    assert await_master(str(path), tell, 60.0) == MasterAddress("tcp://h:1", "r")
    assert told == [f"waits at most 60 s for the connection file {path}"]
    path.unlink()
    with pytest.raises(UnavailableError, match=r"no connection file is at .*c.json after 0.1 s"):
        await_master(str(path), lambda _: None, 0.1)


def test_a_run_that_has_ended_is_told_before_it_is_waited_for(tmp_path: Path) -> None:
    (tmp_path / "result.json").touch()
    told: list[str] = []
    with pytest.raises(UnavailableError, match="no connection file is at"):
        await_master(str(tmp_path), told.append, 0.1)
    assert told == [
        f"run {tmp_path.name} has ended, unless its master resumes it: waits at most 0.1 s for the "
        f"connection file {tmp_path}"
    ]


def test_an_address_in_a_file_is_checked(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    path.write_text('{"endpoint": "ipc://x", "run_id": "r"}')
    with pytest.raises(RunError, match=r"'ipc://x' \(from .*c.json\) is no address"):
        find_master(str(path))


@pytest.mark.parametrize("place", ["t/../x/y", "x/y"])
def test_who_reads_a_file_makes_no_folder(tmp_path: Path, place: str) -> None:
    """Where the folder of the sockets is missing, the master is waited for as without its file."""
    (tmp_path / "t").mkdir(mode=0o700)
    path, endpoint = tmp_path / "c.json", f"ipc://{tmp_path}/{place}"
    path.write_text(written(endpoint=endpoint, machine=socket.gethostname()))
    if ".." in place:
        reason = f"{path} is no connection file (its endpoint '{endpoint}' must be a path without "
        with pytest.raises(RunError, match=re.escape(f"{reason}'..')")):
            find_master(str(path))
    else:
        assert find_master(str(path)) is None
        with pytest.raises(
            UnavailableError, match="or its sockets do not exist: is tangram-master"
        ):
            await_master(str(path), lambda _: None, 0.1)
    assert not (tmp_path / "x").exists()
