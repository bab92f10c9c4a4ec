"""Messages to a master from an intruder: another user of the machine, or one without a key."""

import multiprocessing
import os
from collections.abc import Sequence
from multiprocessing.process import BaseProcess

import zmq

NOBODY = 65534
PATIENCE_MS = 2000


def knock(endpoint: str, messages: Sequence[Sequence[bytes]], user: int = NOBODY) -> BaseProcess:
    """Start a process that sends messages to a master; as another user if this process is root.

    Args:
        endpoint: address of the master.
        messages: frames of each message.
        user: id of that other user.

    Returns:
        The process; its exit code is the number of answers it received.
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
    os._exit(answers)  # skip the cleanup of objects that the fork shares with its parent
