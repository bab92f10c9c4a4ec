"""Trials of starts: obstacles that must not stop a run, and the exit status if one does."""

import os
import socket
import subprocess
import time
from functools import partial
from pathlib import Path
from threading import Thread

import numpy as np
import zmq

from master.record.lease import STALE_S
from master.record.rundir import LEASE
from tangram_core.run.code import override
from tangram_core.wire.messages import WORKER_COLUMNS, AskStatus, Refused, RunStatus
from tangram_core.wire.schema import opened
from tangram_lab.benchmarks.trainings import command, result_of, start_training
from tangram_lab.benchmarks.trials.neighbours import ESCAPE
from tangram_lab.benchmarks.trials.target import ENDS_S, HOST, Attack, Seen, one_line

QUICK = ("sim=kinematic", "net.width=16", "net.feed_forward=16", "service.eval_episodes=2")
LINE = b'{"updates": 1, "mean_reward": 0.5}\n'


def two_at_once(folder: Path) -> Seen:
    """Start two trainings with different settings in one new folder; exactly one may run."""
    run = folder / "twice"
    first = start_training(run, "seed=1", "max_updates=200", *QUICK)
    time.sleep(0.7)
    arguments = (override("run_dir", str(run)), "seed=2", "max_updates=200", *QUICK)
    second = subprocess.Popen([*command("train"), *arguments], stderr=subprocess.DEVNULL)
    ended = [first.wait(ENDS_S), second.wait(ENDS_S)]
    seed = f"seed: {1 + ended.index(0)}" if 0 in ended else "none went on"
    held = sorted(ended) == [0, 2] and seed in (run / "config.yaml").read_text()
    return held, f"statuses {ended}, {seed}"


def goes_on(folder: Path, name: str, content: bytes) -> Seen:
    """Extend a finished run after putting the file `name` into its folder; none if empty."""
    run = folder / "extended"
    updates = 0
    if name:
        updates = result_of(run)["updates"]
        path = run / name
        if path.is_dir():
            path.rename(run / "away")
        path.write_bytes(content)
        long_ago = time.time() - 2.0 * STALE_S
        os.utime(path, (long_ago, long_ago))
    bound = f"max_updates={updates + 20}"
    done = subprocess.run(
        [*command("train"), override("run_dir", str(run)), bound, "resume=auto", *QUICK],
        capture_output=True,
        timeout=2.0 * ENDS_S,
        check=False,
    )
    more = result_of(run)["updates"] - updates
    return (done.returncode, more) == (0, 20), f"status {done.returncode}, {more} updates more"


def port_taken(folder: Path) -> Seen:
    """Start a master on a port in use; its status must say: temporary, not wrong input."""
    with socket.create_server((HOST, 0)) as taken:
        port = f"service.port={taken.getsockname()[1]}"
        own = override("run_dir", str(folder / "taken"))
        return one_line(
            "master",
            own,
            "service.bind=127.0.0.1",
            port,
            *QUICK,
            cwd=folder,
            status=os.EX_TEMPFAIL,
        )


def strange_master(folder: Path, name: str) -> Seen:
    """Connect a command to a master whose texts contain terminal escape sequences."""
    refused = Refused(ESCAPE).encode()
    status = RunStatus({}, {"run": ESCAPE}, np.zeros((0, len(WORKER_COLUMNS)))).encode()
    with zmq.Context() as context, context.socket(zmq.ROUTER) as master:
        port = master.bind_to_random_port(f"tcp://{HOST}")

        def answer() -> None:
            while master.poll(5_000):
                identity, *frames = master.recv_multipart()
                asks = opened(frames)["kind"] == AskStatus.kind
                master.send_multipart([identity, *(status if asks else refused)])

        answering = Thread(target=answer)
        answering.start()
        arguments = [*command(name), f"connect={HOST}:{port}"]
        done = subprocess.run(
            arguments, capture_output=True, timeout=ENDS_S, check=False, cwd=folder
        )
        answering.join()
    said = done.stdout + done.stderr
    raw = ESCAPE.encode() in said or b"\x07" in said
    return not raw and b"owned" in said, f"raw: {raw}, {said[-60:]!r}"


# What -> row, amount, name of a file in the run folder and its content.
FILES = {
    "a training that is to be extended": ("17", "20 updates", "", b""),
    "a curve of 12 days": ("17", "100,000 lines", "curve.jsonl", LINE * 100_000),
    "a curve with a broken line": ("17", "1 byte", "curve.jsonl", LINE + b"\xff\n"),
    "a file in the place of TensorBoard's folder": ("17", "1", "tensorboard", b"x"),
    "a lease left by a machine that died": ("21", "1", LEASE, b'{"host": "x", "id": "y"}'),
}
STARTS: list[Attack] = [
    ("16", "two trainings begun on one new folder", ".7 s apart", two_at_once),
    *(
        (row, what, amount, partial(goes_on, name=name, content=content))
        for what, (row, amount, name, content) in FILES.items()
    ),
    ("18", "a port that a neighbour has", "1", port_taken),
    *(
        ("20", f"escapes from a strange master to {who}", "1", partial(strange_master, name=name))
        for who, name in (("a worker", "worker"), ("tangram-status", "status"))
    ),
]
