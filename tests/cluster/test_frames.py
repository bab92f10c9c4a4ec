"""What must not come over a wire, between real masters and workers that must not mind."""

import json
import os
from pathlib import Path

import pytest
import zmq

from tests.cluster.mangler import KINDS, Mangler
from tests.cluster.players import (
    assert_exactly_once,
    finish,
    master,
    more_acknowledged,
    players,
    setup_of,
    until,
)
from worker.status import ask_status

pytestmark = pytest.mark.cluster


def endpoint_of(folder: Path) -> str:
    return str(json.loads((folder / "connection.json").read_text())["endpoint"])


def numbers(folder: Path) -> dict[str, float]:
    with zmq.Context() as context:
        return ask_status(str(folder), context).numbers


# TANGRAM_MANGLE_SEEDS=1-200 runs the test below once for each of these seeds.
FIRST, LAST = map(int, os.environ.get("TANGRAM_MANGLE_SEEDS", "1-1").split("-"))


@pytest.mark.parametrize("seed", range(FIRST, LAST + 1), ids="seed={}".format)
def test_repeated_swapped_and_damaged_messages_change_nothing(folder: Path, seed: int) -> None:
    """One player behind the relay, one beside it, who must not notice."""
    print(f"seed of the mangler: {seed}")
    with (
        master(folder) as process,
        Mangler(endpoint_of(folder), seed) as mangler,
        players(setup_of(folder), f"tcp://127.0.0.1:{mangler.port}", beside=folder) as made,
    ):
        wanted = {(kind, way) for kind in KINDS for way in ("up", "down")}
        wanted -= {("a bit of an array", "down")}  # nobody asked for weights
        until(made, lambda: wanted <= mangler.done.keys())
        more_acknowledged(made, 10)
        told = {"hub/malformed", "hub/damaged", "hub/duplicates"}
        until(made, lambda: told <= numbers(folder).keys())
        assert "hub/rejected" not in numbers(folder)  # nothing of it was taken for a batch
        _, beside = made
        assert beside.client.counters.keys().isdisjoint({"reconnects", "malformed", "rejected"})
        finish(made, process)
    assert_exactly_once(folder, made)
