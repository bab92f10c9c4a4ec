"""Clients that the tests drive against a staged hub."""

import json
import socket
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from tangram_agent.messages import EpisodeBatch, ToMaster
from tests.master.dealers import Stage
from tests.worker.standin import make_client
from worker.client import Client

Result = TypeVar("Result")


def served(stage: Stage, call: Callable[[], Result]) -> Result:
    """What a call that waits returns, while the hub is served."""
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(call)
        stage.until(future.done)
        return future.result()


@contextmanager
def joined(stage: Stage, **more: Any) -> Iterator[Client]:
    with make_client(stage.hub.endpoint, **more) as client:
        assert served(stage, client.join)
        yield client


def both(stage: Stage, client: Client, done: Callable[[], Any]) -> None:
    """Serve the hub and let the client work until something holds."""

    def step() -> Any:
        client.poll()
        return done()

    stage.until(step)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


def write_connection(folder: Path, endpoint: str, run_id: str = "run") -> None:
    aside = folder / "aside"
    aside.write_text(json.dumps({"endpoint": endpoint, "run_id": run_id}))
    aside.replace(folder / "connection.json")


def numbers(heard: list[ToMaster]) -> list[int]:
    return [message.sequence for message in heard if isinstance(message, EpisodeBatch)]
