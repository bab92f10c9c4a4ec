"""The link's parts without sockets: where the master is, what is on its way, the newest weights."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tangram_agent.messages import encode_weights
from tangram_agent.types import Weights
from tangram_sim.errors import RunError, WireError
from tests.agent.messages import SHAPES, weights
from worker.connection import Connection, await_connection, find_connection
from worker.inbox import Inbox
from worker.spool import Spool

pytestmark = pytest.mark.fast

REMEDY = (
    "connect=... takes tcp://host:port, a run folder, or the connection.json that tangram-master "
    "writes into it"
)


def test_an_address_is_taken_as_it_is() -> None:
    for address in ("tcp://127.0.0.1:5555", "tcp://learner.lan:1", "tcp://[::1]:65535"):
        assert find_connection(address) == Connection(address, "")


@pytest.mark.parametrize(
    "address",
    ["udp://h:1", "tcp://h", "tcp://:1", "tcp://h:0", "tcp://h:65536", "tcp://h:x", "tcp://"],
)
def test_a_wrong_address_is_refused(address: str) -> None:
    with pytest.raises(RunError) as caught:
        find_connection(address)
    assert str(caught.value) == (
        f"'{address}' (from {address}) is no address: it must be tcp://host:port"
    )


def test_a_file_and_its_folder_are_found(tmp_path: Path) -> None:
    path = tmp_path / "connection.json"
    assert find_connection(str(path)) is None
    assert find_connection(str(tmp_path)) is None
    content = {"endpoint": "tcp://h:1", "weights_endpoint": "tcp://h:2", "run_id": "r", "more": 1}
    path.write_text(json.dumps(content))
    assert find_connection(str(path)) == Connection("tcp://h:1", "r")
    assert find_connection(str(tmp_path)) == Connection("tcp://h:1", "r")


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("", "JSONDecodeError"),
        ("{", "JSONDecodeError"),
        ("[]", "TypeError"),
        ("{}", "KeyError('endpoint')"),
        ('{"endpoint": "tcp://h:1"}', "KeyError('run_id')"),
        ("\x00", "JSONDecodeError"),
        (
            '{"endpoint": "tcp://h:1", "run_id": "r", "server_key": "short"}',
            "ValueError('server_key,",
        ),
    ],
)
def test_a_file_that_is_no_connection_file(tmp_path: Path, content: str, reason: str) -> None:
    path = tmp_path / "c.json"
    path.write_text(content)
    with pytest.raises(RunError) as caught:
        find_connection(str(path))
    assert str(caught.value).startswith(f"{path} is no connection file ({reason}")
    assert str(caught.value).endswith(REMEDY)


def test_the_settings_of_the_run_stand_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    content = {"endpoint": "tcp://h:1", "run_id": "r", "settings": {"net": {"width": 3}}}
    path.write_text(json.dumps(content))
    found = await_connection(str(path), pytest.fail)
    assert found.settings == {"net": {"width": 3}}
    assert found == Connection("tcp://h:1", "r")  # a master that moved is one with another address
    path.write_text(json.dumps(content | {"settings": 3}))
    with pytest.raises(RunError, match=r"settings must be a map"):
        find_connection(str(path))


def test_a_file_that_comes_late_is_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    told: list[str] = []

    def tell(line: str) -> None:
        told.append(line)
        path.write_text(json.dumps({"endpoint": "tcp://h:1", "run_id": "r"}))

    assert await_connection(str(path), tell, 60.0) == Connection("tcp://h:1", "r")
    assert told == [f"waits for the connection file {path}"]
    path.unlink()
    with pytest.raises(RunError, match=r"no connection file is at .*c.json after 0.1 s"):
        await_connection(str(path), lambda _: None, 0.1)


def test_an_address_in_a_file_is_checked(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    path.write_text('{"endpoint": "ipc://x", "run_id": "r"}')
    with pytest.raises(RunError, match=r"'ipc://x' \(from .*c.json\) is no address"):
        find_connection(str(path))


@given(st.lists(st.one_of(st.none(), st.integers(1, 12)), max_size=40))
def test_the_spool_against_a_list(steps: list[int | None]) -> None:
    """None adds if there is room, a number removes."""
    spool, kept, count = Spool(window=3), [], 0
    for step in steps:
        if step is None and spool.free:
            count += 1
            spool.add([bytes([count])])
            kept.append(count)
        elif step is not None:
            assert spool.remove(step) == (step in kept)
            kept = [number for number in kept if number != step]
        assert len(spool) == len(kept) <= 3
        assert spool.free == 3 - len(kept)
        assert spool.messages == [[bytes([number])] for number in kept]
        assert (spool.first, spool.next) == (kept[0] if kept else count + 1, count + 1)


def test_a_window_may_shrink_below_what_is_kept() -> None:
    spool = Spool(window=3)
    for _ in range(3):
        spool.add([b""])
    spool.window = 1
    assert spool.free == 0


def test_the_inbox_keeps_the_newest_of_the_present_life() -> None:
    inbox = Inbox(SHAPES)
    inbox.begin("a")
    assert inbox.take() is None
    for version in (3, 5, 4):
        inbox.offer("a", Weights(version, {}))
    inbox.offer("b", Weights(9, {}))
    newest = inbox.take()
    assert newest is not None
    assert (newest.version, inbox.version, inbox.take()) == (5, 5, None)
    inbox.offer("a", Weights(5, {}))
    assert inbox.take() is None
    # The same life again changes nothing, another one begins with its own versions.
    inbox.begin("a")
    assert inbox.version == 5
    inbox.begin("b")
    assert inbox.version == -1
    inbox.offer("b", Weights(1, {}))
    inbox.begin("c")
    assert inbox.take() is None


def test_the_inbox_takes_only_weights_that_fit() -> None:
    inbox = Inbox({"other": (1,)})
    inbox.begin("a")
    with pytest.raises(WireError, match=r"'actor.bias' must be no such tensor, got"):
        inbox.offer_frame(encode_weights("a", weights()))
    assert inbox.take() is None
