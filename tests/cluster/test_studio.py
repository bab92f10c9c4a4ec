"""tangram-studio as a process: who gets in, what is refused, and what ends with it."""

import asyncio
import http.client
import json
import os
import re
import select
import signal
import socket
import struct
import subprocess
import time
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import psutil
import pytest
from PIL import Image, ImageDraw
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from tangram_sim.errors import TangramError
from tangram_studio.jobs import Jobs
from tangram_studio.server import HEAD_S, MAX_UPLOAD, OPEN, PAGES
from tests.cluster.processes import BIN, refused

pytestmark = [pytest.mark.cluster, pytest.mark.xdist_group("studio")]

ROOT = Path(__file__).parents[2]
STATIC = ROOT / "tangram_studio" / "static"
WAIT_S = 120.0


class Running(NamedTuple):
    process: subprocess.Popen[str]
    port: int
    token: str

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/?token={self.token}"

    @property
    def cookie(self) -> str:
        return f"tangram_studio_{self.port}={self.token}"

    def get(
        self,
        path: str,
        cookie: str | None = None,
        method: str = "GET",
        body: Any = None,
        **headers: str,
    ) -> tuple[int, dict[str, str], bytes]:
        """Status, headers and body."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=WAIT_S)
        given = {"Cookie": self.cookie if cookie is None else cookie} | headers
        try:
            connection.request(method, path, body, given)
            answer = connection.getresponse()
            return answer.status, dict(answer.getheaders()), answer.read()
        finally:
            connection.close()

    def drop(self, name: str, data: bytes) -> tuple[int, dict[str, Any]]:
        """What is answered to a file."""
        path = f"/api/drop?name={name}&who=together"
        status, _, body = self.get(path, method="POST", body=data)
        return status, json.loads(body)

    def page(self, **headers: str) -> ClientConnection:
        """A socket as a page opens it."""
        given = {"Cookie": self.cookie} | headers
        return connect(
            f"ws://127.0.0.1:{self.port}/api/play", additional_headers=given, max_queue=None
        )


@contextmanager
def studio(folder: Path, *arguments: str) -> Iterator[Running]:
    command = [BIN / "tangram-studio", *(arguments or ("port=0",))]
    with subprocess.Popen(command, cwd=folder, stdout=-1, stderr=-1, text=True) as process:
        try:
            assert process.stdout is not None
            assert select.select([process.stdout], [], [], WAIT_S)[0]
            line = process.stdout.readline()
            found = re.search(r"http://127\.0\.0\.1:(\d+)/\?token=(\S+)", line)
            assert found, line
            yield Running(process, int(found[1]), found[2])
        finally:
            process.kill()


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with studio(tmp_path_factory.mktemp("studio")) as found:
        yield found


def told(page: ClientConnection, kind: str) -> dict[str, Any]:
    """The next thing of a kind that a page is told."""
    while True:
        content = page.recv(timeout=WAIT_S)
        assert isinstance(content, str)
        message: dict[str, Any] = json.loads(content)
        if message["told"] == kind:
            return message
        assert message["told"] in ("pages", "wait"), message


def ask(page: ClientConnection, ask: str, **content: Any) -> None:
    page.send(json.dumps({"ask": ask, **content}))


# Who gets in

PATHS = ("/", "/app.js", "/api/figures")


@pytest.mark.parametrize("path", [*PATHS, "/nothing", "/api/play", "/?token=wrong", "/?token="])
def test_without_the_token_nothing_is_served(running: Running, path: str) -> None:
    for cookie in ("", f"tangram_studio_{running.port}=wrong", "broken;=;"):
        status, headers, body = running.get(path, cookie)
        assert status == 403
        assert body.startswith(b"This page needs its token: open the address that tangram-studio")
        assert "set-cookie" not in headers
        assert running.token.encode() not in body


def test_a_file_without_the_token_is_not_read(running: Running) -> None:
    assert running.get("/api/drop?name=a.png&who=agent", "", "POST", b"x" * 100)[0] == 403


@pytest.mark.parametrize(
    "headers",
    [
        {"Cookie": ""},
        {"Cookie": "tangram_studio_1=x"},
        {"Origin": "http://evil.example"},
        {"Origin": "http://["},
        {"Origin": "null"},
        {"Host": "evil.example"},
    ],
)
def test_a_socket_without_the_token_or_of_another_site_is_refused(
    running: Running, headers: dict[str, str]
) -> None:
    key = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
    key["Sec-WebSocket-Key"] = "dGhlIHNhbXBsZSBub25jZQ=="
    connection = http.client.HTTPConnection("127.0.0.1", running.port, timeout=WAIT_S)
    connection.request("GET", "/api/play", headers={"Cookie": running.cookie} | key | headers)
    assert connection.getresponse().status == 403
    connection.close()


@pytest.mark.parametrize(
    "headers", [{"Host": "evil.example"}, {"Origin": "http://evil.example"}, {"Origin": "http://["}]
)
def test_another_host_or_site_is_refused_even_with_the_token(
    running: Running, headers: dict[str, str]
) -> None:
    status, _, body = running.get("/", **headers)
    assert (status, b"this machine's own names" in body) == (403, True)


def test_the_token_becomes_a_cookie_and_leaves_the_address(running: Running) -> None:
    status, headers, _ = running.get(f"/?token={running.token}", "")
    assert (status, headers["location"]) == (303, "/")
    kept = headers["set-cookie"]
    assert kept.startswith(f"{running.cookie};")
    assert "HttpOnly" in kept
    assert "SameSite=strict" in kept


@pytest.mark.parametrize(
    "other", ['a={"x":"y"}', "a b=c@d", "a[0]=1", "a,b=1", "expires", "\xe9=1"]
)
def test_cookies_of_other_programs_lock_nobody_out(running: Running, other: str) -> None:
    assert running.get("/", f"{other}; {running.cookie}")[0] == 200
    assert running.get("/", f"tangram_studio_{running.port}=old; {running.cookie}")[0] == 200
    assert running.get("/", other)[0] == 403


def test_it_listens_on_this_machine_alone(running: Running) -> None:
    listening = [
        one.laddr.ip
        for one in psutil.Process(running.process.pid).net_connections()
        if one.status == psutil.CONN_LISTEN
    ]
    assert listening == ["127.0.0.1"]


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
    status, _, body = running.get("/api/figures")
    content = json.loads(body)
    assert (status, len(content["tokens"]), len(content["figures"])) == (200, 7, 49)


@pytest.mark.parametrize("path", ["/../pyproject.toml", "/%2e%2e/config.py", "/static", "/x.js"])
def test_no_other_file_is_served(running: Running, path: str) -> None:
    assert running.get(path)[0] == 404


# Files


def png(width: int, height: int, *chunks: tuple[bytes, bytes]) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + b"".join(chunk(*one) for one in chunks)


BOMB = png(60_000, 60_000, (b"IDAT", zlib.compress(b"\0" * 10_000)), (b"IEND", b""))
SVG = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 9 9">{}</svg>'
ENTITY = '<!DOCTYPE svg [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]>' + SVG.format("&b;")
HOSTILE = [
    ("a.exe", b"MZ", "cannot be read: drop one of .png"),
    ("a", b"", "cannot be read"),
    ("a.png", b"", "no PNG or JPEG"),
    ("a.png", b"\x89PNG\r\n\x1a\n" + b"\0" * 1000, "no PNG or JPEG"),
    ("a.png", BOMB, "million pixels"),
    ("a.png", png(4, 4, (b"IDAT", zlib.compress(b"\0" * 20)), (b"IEND", b"")), "4 x 4 pixels"),
    ("a.jpg", b"\xff\xd8\xff" * 200, "no PNG or JPEG"),
    ("a.png", b"GIF89a" + b"\0" * 100, "no PNG or JPEG"),
    ("a.svg", b"", "not XML"),
    ("a.svg", b"\xff\xfe" * 50, "not UTF-8"),
    ("a.svg", ENTITY.encode(), "ENTITY"),
    ("a.svg", SVG.format("<g>" * 40_000).encode(), "tags"),
    ("a.svg", SVG.format("<script>alert(1)</script>").encode(), "draws no polygon"),
    ("a.svg", SVG.format('<polygon points="0,0 1e999,0 0,1"/>').encode(), "SVG"),
    ("a.svg", SVG.format('<polygon points="0,0 1,0 2,0"/>').encode(), "draws no polygon"),
    ("a.json", b"{" * 100_000, "not JSON"),
    ("a.json", b'{"format": "tangram-outlines"}', "must be a mapping"),
]


@pytest.mark.parametrize(("name", "data", "why"), HOSTILE, ids=range(len(HOSTILE)))
def test_a_hostile_file_is_refused_in_one_line(
    running: Running, name: str, data: bytes, why: str
) -> None:
    status, content = running.drop(name, data)
    assert (status, list(content)) == (400, ["error"])
    assert why in content["error"]
    assert "\n" not in content["error"]
    assert "/tmp" not in content["error"]


def test_a_file_that_is_too_large_is_refused_before_it_is_read(running: Running) -> None:
    with socket.create_connection(("127.0.0.1", running.port), timeout=WAIT_S) as raw:
        head = (
            f"POST /api/drop?name=a.png&who=agent HTTP/1.1\r\nHost: 127.0.0.1:{running.port}\r\n"
            f"Cookie: {running.cookie}\r\nContent-Length: {MAX_UPLOAD + 1}\r\n\r\n"
        )
        raw.sendall(head.encode())  # and not a byte of it
        answer = raw.recv(4096).decode()
    assert answer.startswith("HTTP/1.1 413")
    status, _, body = running.get(
        "/api/drop?name=a.png&who=agent", method="POST", body=iter([b"x"])
    )
    assert (status, b"larger than 10 MB" in body) == (413, True)  # of a length that is not told


BEGUN = (  # requests that stop: a head, and what follows a whole one that was refused
    (b"GET / HTTP/1.1\r\nHost: ", b""),
    (b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", b"G"),
    (b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 999\r\n\r\n", b"x"),
)


def test_silent_connections_lock_nobody_out_and_slow_ones_live(running: Running) -> None:
    """Else those who have no token could hold all connections that there may be."""
    here, picture = ("127.0.0.1", running.port), (ROOT / "docs/images/silhouette.png").read_bytes()
    with ExitStack() as stack, running.page() as page:
        upload = stack.enter_context(socket.create_connection(here, timeout=WAIT_S))
        head = (
            f"POST /api/drop?name=a.png&who=together HTTP/1.1\r\nHost: 127.0.0.1:{running.port}\r\n"
            f"Cookie: {running.cookie}\r\nContent-Length: {len(picture)}\r\n\r\n"
        )
        upload.sendall(head.encode() + picture[:100])
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
        assert upload.recv(4096).startswith(b"HTTP/1.1 200")
        ask(page, "fill", number=1, puzzle="swan")
        assert told(page, "filled")["number"] == 1
        upload.sendall(b"G")  # another request, that stops
        upload.settimeout(HEAD_S + 10)
        while upload.recv(4096):
            pass


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


def test_a_picture_is_filled(running: Running) -> None:
    status, content = running.drop("s.png", (ROOT / "docs/images/silhouette.png").read_bytes())
    assert (status, content["exact"]) == (200, True)
    assert content["iou"] > 0.95
    assert content["seen"].startswith("data:image/png;base64,")
    assert len(content["pieces"]) == 7


# Pages


def test_two_pages_play_beside_each_other(running: Running) -> None:
    with running.page() as one, running.page() as other:
        for page, name in ((one, "cat"), (other, "swan")):
            ask(page, "fill", number=1, puzzle=name)
        goals = [told(page, "filled")["goal"] for page in (one, other)]
        assert goals[0] != goals[1]
        both = {one: 0, other: 0}
        for page, goal in zip(both, goals, strict=True):
            ask(page, "play", number=2, goal=goal)
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


@pytest.mark.parametrize("content", ["{", "x" * 300_000])
def test_a_page_that_talks_nonsense_harms_no_other(running: Running, content: str) -> None:
    with running.page() as good:
        with running.page() as bad:
            bad.send(content)
            with suppress(TimeoutError, ConnectionClosed):
                bad.recv(timeout=0.5)
        ask(good, "fill", number=1, puzzle="cat")
        assert told(good, "filled")["exact"]


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


def children(process: subprocess.Popen[str]) -> list[psutil.Process]:
    return [
        one
        for one in psutil.Process(process.pid).children(recursive=True)
        if "spawn_main" in " ".join(one.cmdline())
    ]


def test_processes_that_are_killed_are_replaced_and_nobody_hears_of_it(running: Running) -> None:
    with running.page() as page:
        ask(page, "fill", number=1, puzzle="cat")
        told(page, "filled")
        for child in children(running.process):
            child.kill()
        ask(page, "fill", number=2, puzzle="swan")
        found = told(page, "filled")
        assert (found["number"], found["exact"]) == (2, True)
        ask(page, "play", number=3, goal=found["goal"])
        assert told(page, "move")["number"] == 3


def test_bytes_are_no_message(running: Running) -> None:
    with running.page() as page:
        told(page, "pages")
        page.send(b"\0")
        with pytest.raises(ConnectionClosed) as closed:
            told(page, "nothing")
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1003


# How it starts and ends


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_nothing_is_left_when_it_ends(
    running: Running, tmp_path: Path, end: signal.Signals
) -> None:
    """Each start has a token of its own, too."""
    with studio(tmp_path) as one:
        assert len(one.token) >= 32
        assert one.token != running.token
        assert one.get("/", f"tangram_studio_{one.port}={running.token}")[0] == 403
        with one.page() as page:
            ask(page, "fill", number=1, puzzle="cat")
            told(page, "filled")
            left = [psutil.Process(child.pid) for child in children(one.process)]
            assert left
            os.kill(one.process.pid, end)
            assert one.process.wait(WAIT_S) in ({-end} if end == signal.SIGKILL else {0, 130, -end})
            assert not psutil.wait_procs(left, timeout=WAIT_S)[1]
        assert one.process.stderr is not None
        assert "Traceback" not in one.process.stderr.read()


def test_a_port_that_is_taken_is_told(running: Running, tmp_path: Path) -> None:
    line = refused("tangram-studio", f"port={running.port}", cwd=tmp_path)
    assert line == (
        f"tangram-studio: cannot listen on 127.0.0.1, port {running.port} (Address already in "
        "use): choose another with port=8766, or any free one with port=0"
    )


# Processes that do the work


def nothing() -> None:
    pass


def test_a_task_that_takes_too_long_is_ended_and_the_next_is_done(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def work() -> None:
        jobs = Jobs(1, nothing)
        try:
            await jobs.ready()
            monkeypatch.setattr("tangram_studio.jobs.LIMIT_S", 0.5)
            with pytest.raises(TangramError, match="it took more than 0.5 s: make it simpler"):
                await jobs.do(time.sleep, 60)
            monkeypatch.setattr("tangram_studio.jobs.LIMIT_S", WAIT_S)
            assert await jobs.do(os.getpid) != os.getpid()
            with pytest.raises(TangramError, match="the process that worked on it ended: make"):
                await jobs.do(os._exit, 3)
            assert await jobs.do(abs, -2) == 2
            assert jobs.started == 4  # the second time, too
        finally:
            jobs.close()

    asyncio.run(work())


def test_who_comes_later_is_told_how_many_come_first() -> None:
    async def work() -> None:
        jobs, heard = Jobs(1, nothing), dict[int, list[int]]()

        def waits(number: int) -> Any:
            async def wait(ahead: int) -> None:
                heard.setdefault(number, []).append(ahead)

            return wait

        try:
            await jobs.ready()
            asked = list[asyncio.Task[None]]()
            for number in range(4):
                asked.append(asyncio.create_task(jobs.do(time.sleep, 1.0, waits=waits(number))))
                await asyncio.sleep(0.02)
            await asyncio.gather(*asked)
            # Those who come earlier and what is being done, and again when it is less.
            assert heard == {1: [1], 2: [2, 1], 3: [3, 2, 1]}
        finally:
            jobs.close()

    asyncio.run(work())


def slowly(end: Path) -> None:
    time.sleep(1.2)
    end.touch()


def test_who_leaves_takes_no_turn_along_and_leaves_none_behind(tmp_path: Path) -> None:
    async def work() -> None:
        jobs = Jobs(1, nothing)
        try:
            await jobs.ready()
            ends = [tmp_path / str(number) for number in range(4)]
            asked = [asyncio.create_task(jobs.do(slowly, end)) for end in ends]
            await asyncio.sleep(0.6)  # longer than the wait that is not worth a word
            for task in asked:  # what has begun goes on, the rest never begins
                task.cancel()
            await asyncio.gather(*asked, return_exceptions=True)
            pids = await asyncio.gather(*(jobs.do(os.getpid) for _ in range(3)))
            assert len(set(pids)) == 1
            assert [end.exists() for end in ends] == [True, False, False, False]
            assert jobs._turns._value == 1
        finally:
            jobs.close()

    asyncio.run(work())
