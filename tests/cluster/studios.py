"""A studio as a process, and a page that talks with it."""

import http.client
import json
import re
import select
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import psutil
from websockets.sync.client import ClientConnection, connect

from tests.cluster.processes import BIN

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
        self, path: str, method: str = "GET", body: Any = None, **headers: str
    ) -> tuple[int, dict[str, str], bytes]:
        """Status, headers and body, of one who has the token unless another cookie is given."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=WAIT_S)
        try:
            connection.request(method, path, body, {"Cookie": self.cookie} | headers)
            answer = connection.getresponse()
            return answer.status, dict(answer.getheaders()), answer.read()
        finally:
            connection.close()

    def drop(self, name: str, data: bytes) -> tuple[int, dict[str, Any]]:
        """What is answered to a file."""
        path = f"/api/drop?name={name}"
        status, _, body = self.get(path, "POST", data)
        return status, json.loads(body)

    def page(self) -> ClientConnection:
        """A socket as a page opens it."""
        given = {"Cookie": self.cookie}
        return connect(
            f"ws://127.0.0.1:{self.port}/api/play", additional_headers=given, max_queue=None
        )

    def children(self) -> list[psutil.Process]:
        """Those that work for it."""
        every = psutil.Process(self.process.pid).children(recursive=True)
        return [one for one in every if "spawn_main" in " ".join(one.cmdline())]


@contextmanager
def studio(folder: Path, *arguments: str) -> Iterator[Running]:
    """One that Ctrl-C ends in the end, while a page is open: nothing is left of it."""
    command = [BIN / "tangram-studio", *(arguments or ("port=0",))]
    with subprocess.Popen(command, cwd=folder, stdout=-1, stderr=-1, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stderr is not None
            assert select.select([process.stdout], [], [], WAIT_S)[0]
            line = process.stdout.readline()
            found = re.search(r"http://127\.0\.0\.1:(\d+)/\?token=(\S+)", line)
            assert found, line
            one = Running(process, int(found[1]), found[2])
            yield one
            if process.poll() is None:
                with one.page() as page:
                    fill(page, "cat")
                    left = one.children()
                    process.send_signal(signal.SIGINT)
                    assert process.wait(WAIT_S) in {0, 130, -signal.SIGINT}
                    assert left
                    assert not psutil.wait_procs(left, timeout=WAIT_S)[1]
                assert "Traceback" not in process.stderr.read()
        finally:
            process.kill()


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


def fill(page: ClientConnection, puzzle: str, number: int = 1) -> dict[str, Any]:
    """Ask for a figure; what is told of it."""
    ask(page, "fill", number=number, puzzle=puzzle)
    found = told(page, "filled")
    assert (found["number"], found["exact"]) == (number, True)
    return found
