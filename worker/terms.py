"""What a worker tells of itself when it joins, and how long it waits for answers."""

from collections.abc import Mapping
from dataclasses import dataclass

from worker.connection import PATIENCE_S


@dataclass(frozen=True)
class Timing:
    """Patience, in seconds.

    Attributes:
        join_s: to find the master at the start.
        retry_s: between two HELLOs, and before a resend that the master asked for.
        heartbeat_s: between two signs of life.
        resend_s: without an acknowledgement before all is sent again.
        silence_s: without an answer before the connection is made anew.
        lost_s: without an answer, over all connections, before giving up.
    """

    join_s: float = PATIENCE_S
    retry_s: float = 1.0
    heartbeat_s: float = 2.0
    resend_s: float = 10.0
    silence_s: float = 30.0
    lost_s: float = 600.0


@dataclass(frozen=True)
class Introduction:
    """Who wants to take part in what.

    Attributes:
        connect: where the master is, see `connection.find_connection`.
        role: player or evaluator.
        index: wanted within the role, -1 for any.
        fingerprints: section of the settings -> digest.
    """

    connect: str
    role: str
    index: int
    fingerprints: Mapping[str, str]
