"""tangram-studio as a process: who gets in, what is refused, and what ends with it."""

import json
import os
import re
import signal
import socket
import time
from contextlib import ExitStack, suppress
from io import BytesIO
from pathlib import Path

import psutil
import pytest
from PIL import Image, ImageDraw
from websockets.exceptions import ConnectionClosed

from tangram_studio.server import MAX_UPLOAD, OPEN, PAGES
from tests.cluster.processes import refused
from tests.cluster.studios import WAIT_S, Running, ask, fill, studio, told

pytestmark = [pytest.mark.cluster, pytest.mark.xdist_group("studio")]

ROOT = Path(__file__).parents[2]
STATIC = ROOT / "tangram_studio" / "static"
PICTURE = ROOT / "docs/images/silhouette.png"
SOCKET = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
SOCKET |= {"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ=="}

# Who gets in


@pytest.mark.parametrize(
    "path", ["/", "/app.js", "/api/figures", "/nothing", "/api/play", "/?token=wrong", "/?token="]
)
def test_strangers_are_served_nothing(running: Running, path: str) -> None:
    """Without the token, from another site, or by another name of this machine."""
    key = SOCKET if path == "/api/play" else {}
    other = f"tangram_studio_{running.port}=wrong"
    for given in (
        *({"Cookie": one} for one in ("", other, "broken;=;", "tangram_studio_1=x", 'a={"x":1}')),
        *({"Origin": one} for one in ("http://evil.example", "http://[", "null")),
        {"Host": "evil.example"},
    ):
        status, headers, body = running.get(path, **key, **given)
        assert status == 403
        told = b"its token: open the address that" if "Cookie" in given else b"machine's own names"
        assert key or told in body  # a socket is told the status alone
        assert "set-cookie" not in headers
        assert running.token.encode() not in body
    assert running.get("/api/drop?name=a.png", "POST", b"x" * 100, Cookie="")[0] == 403


def test_the_token_becomes_a_cookie_and_leaves_the_address(running: Running) -> None:
    status, headers, _ = running.get(f"/?token={running.token}", Cookie="")
    assert (status, headers["location"]) == (303, "/")
    kept = headers["set-cookie"]
    assert kept.startswith(f"{running.cookie};")
    assert "HttpOnly" in kept
    assert "SameSite=strict" in kept


@pytest.mark.parametrize(
    "other", ['a={"x":"y"}', "a b=c@d", "a[0]=1", "a,b=1", "expires", "\xe9=1"]
)
def test_cookies_of_other_programs_lock_nobody_out(running: Running, other: str) -> None:
    for one in (other, f"tangram_studio_{running.port}=old"):
        assert running.get("/", Cookie=f"{one}; {running.cookie}")[0] == 200


# What is served


def test_the_page_is_small_and_of_no_other_host(running: Running) -> None:
    size = 0
    for one in STATIC.iterdir():
        status, headers, body = running.get(f"/{one.name}")
        assert (status, body) == (200, one.read_bytes())
        assert "default-src 'none'" in headers["content-security-policy"]
        assert not re.findall(rb"https?://(?!www\.w3\.org/)", body), one.name
        size += len(body)
    assert size <= 300_000
    assert running.get("/")[2] == (STATIC / "index.html").read_bytes()
    while (answer := running.get("/api/figures"))[0] == 503:  # a busy machine takes its time
        pass
    status, _, body = answer
    content = json.loads(body)
    assert (status, len(content["tokens"]), len(content["figures"])) == (200, 7, 49)
    for path in ("/../pyproject.toml", "/%2e%2e/config.py", "/static", "/x.js"):
        assert running.get(path)[0] == 404


# Files

SVG = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 9 9">{}</svg>'


def test_a_file_that_is_not_filled_is_refused_in_one_line(running: Running) -> None:
    """What each reader refuses is told by its own tests."""
    for name, data, why in (
        ("a.exe", b"MZ", "cannot be read: drop one of .png"),
        ("a", b"", "cannot be read"),
        ("a.png", b"", "no PNG"),
        ("a.svg", SVG.format("<script>alert(1)</script>").encode(), "draws nothing"),
        ("a.json", b"{" * 100_000, "not JSON"),
    ):
        status, content = running.drop(name, data)
        assert (status, list(content)) == (400, ["error"])
        assert why in content["error"]
        assert "\n" not in content["error"]
        assert "/tmp" not in content["error"]


def head_of(running: Running, length: int) -> bytes:
    """The head of an upload of so many bytes."""
    return (
        f"POST /api/drop?name=a.png HTTP/1.1\r\nHost: 127.0.0.1:{running.port}\r\n"
        f"Cookie: {running.cookie}\r\nContent-Length: {length}\r\n\r\n"
    ).encode()


def test_a_file_that_is_too_large_is_refused_before_it_is_read(running: Running) -> None:
    with socket.create_connection(("127.0.0.1", running.port), timeout=WAIT_S) as raw:
        raw.sendall(head_of(running, MAX_UPLOAD + 1))  # and not a byte of it
        assert raw.recv(4096).startswith(b"HTTP/1.1 413")
    path = "/api/drop?name=a.png"
    for sizes in ({}, {"Content-Length": "1", "Transfer-Encoding": "chunked"}):
        status, _, body = running.get(path, "POST", iter([b"x"]), **sizes)
        assert (status, b"larger than 10 MB" in body) == (413, True)  # of a length that is not told


BEGUN = (  # requests that stop: a head, and what follows a whole one that was refused
    (b"GET / HTTP/1.1\r\nHost: ", b""),
    (b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", b"G"),
    (b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 999\r\n\r\n", b"x"),
)


def test_silent_connections_lock_nobody_out_and_slow_ones_live(running: Running) -> None:
    """Else those who have no token could hold all connections that there may be."""
    here, picture = ("127.0.0.1", running.port), PICTURE.read_bytes()
    with ExitStack() as stack, running.page() as page:
        upload = stack.enter_context(socket.create_connection(here, timeout=WAIT_S))
        upload.sendall(head_of(running, len(picture)) + picture[:100])
        raw = [stack.enter_context(socket.create_connection(here, WAIT_S)) for _ in BEGUN]
        for one, (first, second) in zip(raw, BEGUN, strict=True):
            one.sendall(first)
            assert not second or one.recv(4096).startswith(b"HTTP/1.1 403")
            one.sendall(second)
        raw += [stack.enter_context(socket.create_connection(here, WAIT_S)) for _ in range(OPEN)]
        assert running.get("/")[0] == 503
        for one in raw:
            with suppress(ConnectionResetError):
                while one.recv(4096):
                    pass
        assert running.get("/")[0] == 200
        upload.sendall(picture[100:])
        heard = b""
        while b'"seen"' not in heard:
            heard += upload.recv(65536)
        assert heard.startswith(b"HTTP/1.1 200")
        assert b'"exact":true' in heard
        fill(page, "swan")


@pytest.mark.check
def test_thin_rings_get_the_nearest_figure(running: Running) -> None:
    rings = Image.new("L", (2000, 2000), 255)
    for reach in range(4, 990, 4):
        box = (1000 - reach, 1000 - reach, 1000 + reach, 1000 + reach)
        ImageDraw.Draw(rings).ellipse(box, outline=0)
    data = BytesIO()
    rings.save(data, "PNG")
    status, content = running.drop("rings.png", data.getvalue())
    assert (status, content["exact"]) == (200, False)
    assert content["iou"] > 0.5


# Pages


def test_two_pages_play_beside_each_other_and_one_that_talks_nonsense_harms_none(
    running: Running,
) -> None:
    with running.page() as one, running.page() as other:
        goals = [fill(one, "cat")["goal"], fill(other, "swan")["goal"]]
        assert goals[0] != goals[1]
        both = {one: 0, other: 0}
        for page, goal in zip(both, goals, strict=True):
            ask(page, "play", number=2, goal=goal)
        for content in ("{", "x" * 300_000):
            with running.page() as bad:
                bad.send(content)
                with suppress(TimeoutError, ConnectionClosed):
                    bad.recv(timeout=0.5)
        left = set(both)
        while left:  # a move of each in turn
            for page in tuple(left):
                move = told(page, "move")
                if move["over"]:
                    assert move["iou"] > 0.98
                    left.remove(page)
                else:
                    both[page] += 1
                    ask(page, "next")
        assert all(7 <= count <= 10 for count in both.values())
        one.send(b"\0")  # bytes are no message
        with pytest.raises(ConnectionClosed) as closed:
            told(one, "nothing")
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1003


def test_there_is_room_for_so_many_pages(running: Running) -> None:
    with ExitStack() as stack:
        *_, last = [stack.enter_context(running.page()) for _ in range(PAGES)]
        with running.page() as more, pytest.raises(ConnectionClosed) as closed:
            more.recv(timeout=WAIT_S)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 4429
        last.close()
        until = time.monotonic() + WAIT_S
        while time.monotonic() < until:
            with running.page() as again, suppress(ConnectionClosed):
                told(again, "pages")  # else the server has not seen yet that one has gone
                return
    pytest.fail("no room after a page has gone")


def test_processes_that_are_killed_are_replaced_and_nobody_hears_of_it(running: Running) -> None:
    with running.page() as page:
        fill(page, "cat")
        for child in running.children():
            child.kill()
        ask(page, "play", number=3, goal=fill(page, "swan", 2)["goal"])
        assert told(page, "move")["number"] == 3


# How it starts and ends


def test_nothing_is_left_when_it_is_killed(running: Running, tmp_path: Path) -> None:
    """Each start has a token of its own, too, and is heard on this machine alone."""
    with studio(tmp_path) as one:
        assert len(one.token) >= 32
        assert one.token != running.token
        assert one.get("/", Cookie=f"tangram_studio_{one.port}={running.token}")[0] == 403
        every = psutil.Process(one.process.pid).net_connections()
        heard = [found.laddr.ip for found in every if found.status == psutil.CONN_LISTEN]
        assert heard == ["127.0.0.1"]
        line = refused("tangram-studio", f"port={one.port}", cwd=tmp_path, wanted=75)
        assert line == (
            f"tangram-studio: cannot listen on 127.0.0.1, port {one.port} (Address already in "
            "use): choose another with port=8766, or any free one with port=0"
        )
        with one.page() as page:
            fill(page, "cat")
            left = one.children()
            assert left
            os.kill(one.process.pid, signal.SIGKILL)
            assert one.process.wait(WAIT_S) == -signal.SIGKILL
            assert not psutil.wait_procs(left, timeout=WAIT_S)[1]
