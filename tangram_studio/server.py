"""The web server of the page: on this machine alone, and only for browsers with its token."""

import asyncio
import logging
import os
import secrets
import socket
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, suppress
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import Headers, QueryParams
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol

from tangram_core.errors import ConfigError, TangramError
from tangram_studio.config import StudioConfig
from tangram_studio.filling import fill_file, tans
from tangram_studio.jobs import Jobs
from tangram_studio.messages import MAX_BYTES, write
from tangram_studio.playing import finger, player
from tangram_studio.session import LOST, Session, plain

HOST = "127.0.0.1"
PAGES = 64  # open pages, at most
BACKLOG = 128
COUNT_S = 0.2  # time to tell all pages how many are open
MAX_UPLOAD = 10 * 10**6  # bytes
STATIC = files("tangram_studio") / "static"
TYPES = {
    ".html": "text/html",
    ".js": "text/javascript",
    ".css": "text/css",
    ".svg": "image/svg+xml",
}
# A page loads nothing from other hosts, and cannot be embedded in their pages.
GUARDS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' data: blob:; connect-src 'self'; form-action 'none'; base-uri 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
NOT_LET_IN = (
    "This page needs its token: open the address that tangram-studio printed in its terminal, with "
    "?token=... at its end. Each start of tangram-studio has a new one.\n"
)
WRONG_HOST = (
    "The studio answers only under this machine's own names: open the address that it printed.\n"
)
FULL = 4429  # close codes of a socket
SHUT = 4403
NO_BYTES = 1003
UPLOADS = 8  # at once
UPLOAD_S = 60.0  # time limit of an upload
OPEN = 512  # connections at once
HEAD_S = 10.0  # time limit for the head of a request

log = logging.getLogger(__name__)


class Door:
    """ASGI app that refuses requests without the token, and those from pages of other sites."""

    def __init__(self, app: ASGIApp, token: str, port: int) -> None:
        """Guard an app."""
        self._app, self._token, self._cookie = app, token, f"tangram_studio_{port}"
        self._hosts = {f"{name}:{port}" for name in (HOST, "localhost")}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on to the app, or refuse it."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        answer = self._checked(scope)
        if answer is None:
            await self._app(scope, receive, partial(_guarded, send))
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": SHUT})
        else:
            await answer(scope, receive, partial(_guarded, send))

    def _checked(self, scope: Scope) -> Response | None:
        """The answer in place of the app's; None if the request may pass."""
        headers = Headers(scope=scope)
        if headers.get("host") not in self._hosts:
            return PlainTextResponse(WRONG_HOST, 403)
        origin = headers.get("origin")
        if origin is not None and origin != f"http://{headers['host']}":
            return PlainTextResponse(WRONG_HOST, 403)
        given = QueryParams(scope["query_string"]).get("token")
        if given is not None and self._is_token(given) and scope["type"] == "http":
            # Remove the token from the address, so that nobody reads it there or in the history.
            inside = RedirectResponse("/", 303)
            inside.set_cookie(self._cookie, self._token, httponly=True, samesite="strict")
            return inside
        if not any(map(self._is_token, _cookies(headers, self._cookie))):
            return PlainTextResponse(NOT_LET_IN, 403)
        return None

    def _is_token(self, given: str) -> bool:
        return secrets.compare_digest(given.encode(), self._token.encode())


async def _guarded(send: Send, message: Message) -> None:
    if message["type"] == "http.response.start":
        own = [(name.lower().encode(), value.encode()) for name, value in GUARDS.items()]
        message = {**message, "headers": [*message["headers"], *own]}
    await send(message)


def _cookies(headers: Headers, name: str) -> Iterator[str]:
    """The values of a cookie; other programs of this machine set cookies, too, in any form."""
    for one in ";".join(headers.getlist("cookie")).split(";"):
        key, _, value = one.partition("=")
        if key.strip() == name:
            yield value.strip()


class Prompt(H11Protocol):
    """HTTP protocol that closes a connection if the head of a request takes too long."""

    _waits: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the timer for the first request."""
        super().connection_made(transport)
        self._wait()

    def on_response_complete(self) -> None:
        """Start the timer for the next request."""
        super().on_response_complete()
        self._wait()

    def handle_websocket_upgrade(self, event: Any) -> None:
        """Stop the timer, as a page's socket may be silent."""
        self._wait(0.0)
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timer."""
        self._wait(0.0)
        super().connection_lost(exc)

    def _wait(self, seconds: float = HEAD_S) -> None:
        if self._waits is not None:
            self._waits.cancel()
        self._waits = self.loop.call_later(seconds, self._close) if seconds else None

    def _close(self) -> None:
        cycle: Any = self.cycle  # None before the first request
        if cycle is None or cycle.response_complete:
            self.transport.close()


class Studio:
    """The handlers of requests, and what all pages share."""

    def __init__(self) -> None:
        """Start two pools, for slow work and for moves, each with half of the machine's cores."""
        many = max(1, (os.cpu_count() or 2) // 2)
        self.fills, self.moves = Jobs(many, warm), Jobs(many, warm)
        self._pages: set[WebSocket] = set()
        self._uploads = 0
        self._tans: dict[str, object] | None = None

    @asynccontextmanager
    async def lifespan(self, _: Starlette) -> AsyncIterator[None]:
        """Keep the processes running as long as the server runs."""
        first = [asyncio.create_task(jobs.ready()) for jobs in (self.fills, self.moves)]
        try:
            yield
        finally:
            for task in first:
                task.cancel()
            self.fills.close()
            self.moves.close()

    async def play(self, socket: WebSocket) -> None:
        """Serve the socket of one page."""
        await socket.accept()
        if len(self._pages) >= PAGES:
            await socket.close(FULL)
            return
        self._pages.add(socket)
        session = Session(socket.send_text, socket.send_bytes, self.fills, self.moves)
        try:
            await self._count()
            while True:
                message = await socket.receive()
                if message["type"] == "websocket.disconnect":
                    break
                if message.get("text") is None:  # no page sends bytes
                    await socket.close(NO_BYTES)
                    break
                await session.hear(message["text"])
        except (WebSocketDisconnect, RuntimeError):  # the page is leaving
            pass
        finally:
            self._pages.discard(socket)
            await session.end()
            await self._count()

    async def _count(self) -> None:
        """Tell all pages how many are open; a page that does not listen delays no other."""
        text = write("pages", count=len(self._pages))
        telling = {asyncio.create_task(_told(page, text)) for page in self._pages}
        if telling:
            await asyncio.wait(telling, timeout=COUNT_S)
        for task in telling:
            task.cancel()

    async def figures(self, _: Request) -> Response:
        """Answer with the tokens and the library."""
        if self._tans is None:
            try:
                self._tans = await self.fills.do(tans)
            except TangramError as error:
                return _refused(str(error), 503)
        return JSONResponse(self._tans)

    async def drop(self, request: Request) -> Response:
        """Fill a file that was dropped on the page."""
        size = request.headers.get("content-length", "")
        chunked = "transfer-encoding" in request.headers  # of any size, whatever is declared
        if chunked or not size.isdecimal() or int(size) > MAX_UPLOAD:
            limit = MAX_UPLOAD // 10**6
            return _refused(f"the file is larger than {limit} MB: make it smaller", 413)
        if self._uploads >= UPLOADS:
            return _refused("too many files are waiting: drop it again in a moment", 429)
        self._uploads += 1
        try:
            async with asyncio.timeout(UPLOAD_S):
                data = await request.body()
            return await self._seen(request, data)
        except TimeoutError:
            return _refused(f"the file did not arrive within {UPLOAD_S:g} s: drop it again", 408)
        except ClientDisconnect:
            return Response(status_code=400)  # nobody reads it
        except Exception:  # a page must learn of every failure
            log.exception("filling a dropped file failed")
            return _refused(LOST, 500)
        finally:
            self._uploads -= 1

    async def _seen(self, request: Request, data: bytes) -> Response:
        """Fill a file, and give up if its sender leaves."""
        name = request.query_params.get("name", "")
        looks = asyncio.create_task(self.fills.do(fill_file, name, data))
        leaves = asyncio.create_task(_left(request))
        await asyncio.wait((looks, leaves), return_when=asyncio.FIRST_COMPLETED)
        leaves.cancel()
        if not looks.done():
            looks.cancel()
            raise ClientDisconnect
        try:
            return JSONResponse(plain(looks.result()))
        except TangramError as error:
            return _refused(str(error), 400)


async def _left(request: Request) -> None:
    """Return when the sender of a request has left."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


def warm() -> None:
    """Load the agents, which every process needs."""
    player()
    finger()


async def _told(page: WebSocket, text: str) -> None:
    with suppress(WebSocketDisconnect, RuntimeError):  # the page is leaving
        await page.send_text(text)


async def _file(request: Request) -> Response:
    name = request.path_params.get("name", "index.html")
    known = {one.name: one for one in STATIC.iterdir()}
    if name not in known:
        return PlainTextResponse(f"there is no {name} here: open /\n", 404)
    return Response(known[name].read_bytes(), media_type=TYPES[Path(name).suffix])


def _refused(why: str, status: int) -> Response:
    return JSONResponse({"error": why}, status)


def make_app(token: str, port: int) -> ASGIApp:
    """The ASGI app of a studio, guarded by its token."""
    studio = Studio()
    routes = [
        Route("/", _file),
        Route("/api/figures", studio.figures),
        Route("/api/drop", studio.drop, methods=["POST"]),
        WebSocketRoute("/api/play", studio.play),
        Route("/{name}", _file),
    ]
    return Door(Starlette(routes=routes, lifespan=studio.lifespan), token, port)


def serve(config: StudioConfig) -> int:
    """Serve the page until Ctrl-C.

    Returns:
        Exit status 0.

    Raises:
        ConfigError: the port cannot be used.
    """
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((HOST, config.port))
        listener.listen(BACKLOG)  # from now on pages wait until the server has started
    except OSError as error:
        listener.close()
        raise ConfigError(
            f"cannot listen on {HOST}, port {config.port} ({error.strerror}): choose another with "
            "port=8766, or any free one with port=0"
        ) from None
    port = listener.getsockname()[1]
    token = secrets.token_urlsafe(24)
    address = f"http://{HOST}:{port}/?token={token}"
    print(f"tangram-studio is at {address}", flush=True)  # noqa: T201
    print(  # noqa: T201
        f"Only this machine can open it. On another one: ssh -L {port}:{HOST}:{port} THIS_MACHINE, "
        "then open the same address there. Ctrl-C ends tangram-studio.",
        flush=True,
    )
    logging.basicConfig(format="%(asctime)s tangram-studio: %(message)s", datefmt="%H:%M:%S")
    server = uvicorn.Server(
        uvicorn.Config(
            make_app(token, port),
            log_level="warning",
            access_log=False,
            ws_max_size=MAX_BYTES,
            http=Prompt,
            ws="websockets-sansio",
            timeout_graceful_shutdown=2,
            server_header=False,
            limit_concurrency=OPEN,
        )
    )
    with suppress(KeyboardInterrupt):  # Ctrl-C is how it ends
        server.run(sockets=[listener])
    return 0
