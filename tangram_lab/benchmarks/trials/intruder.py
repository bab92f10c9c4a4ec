"""What an intruder tries on a master: another user of its machine, or one without a key."""

import multiprocessing
import os
from collections.abc import Sequence
from multiprocessing.process import BaseProcess

import zmq

NOBODY = 65534
PATIENCE_MS = 2000


def knock(endpoint: str, messages: Sequence[Sequence[bytes]], user: int = NOBODY) -> BaseProcess:
    """A process of another user, where we are root, that says something to a master.

    Args:
        endpoint: of the master.
        messages: one after the other.
        user: that it becomes.

    Returns:
        The process; its exit code is the number of answers that it got.
    """
    child = multiprocessing.get_context("fork").Process(
        target=_knock, args=(endpoint, messages, user), daemon=True
    )
    child.start()
    return child


def _knock(endpoint: str, messages: Sequence[Sequence[bytes]], user: int) -> None:
    if os.geteuid() == 0:
        os.setgroups([])
        os.setgid(user)
        os.setuid(user)
    answers = 0
    context = zmq.Context[zmq.Socket[bytes]]()
    with context.socket(zmq.DEALER) as stranger:
        stranger.setsockopt(zmq.LINGER, 0)
        stranger.connect(endpoint)
        for frames in messages:
            stranger.send_multipart(frames)
        while answers < len(messages) and stranger.poll(PATIENCE_MS):
            stranger.recv_multipart()
            answers += 1
    os._exit(answers)  # what was forked with it is not ours to end
