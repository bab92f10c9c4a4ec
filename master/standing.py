"""How the run stands, as numbers for tangram-status, Prometheus and health checks."""

import time
from collections.abc import Mapping

import numpy as np

from master.parts import Parts
from master.peers import Peer
from master.status import Status
from tangram_agent.messages import WORKER_COLUMNS, RunStatus
from tangram_sim.arrays import Floats

UNKNOWN = -1.0


def run_status(status: Status, parts: Parts, more: Mapping[str, float]) -> RunStatus:
    """What the status says, and the state of the parts.

    Args:
        status: as it is shown on the terminal.
        parts: of the run.
        more: what only the loop knows.
    """
    trainer = parts.trainer
    numbers = {
        "episodes": status.episodes,
        "transitions": status.transitions,
        "updates": status.updates,
        "elapsed_s": status.elapsed_s,
        "share": UNKNOWN if status.share is None else status.share,
        "left_s": UNKNOWN if status.left_s is None else status.left_s,
        "transitions_per_s": status.transitions_per_s,
        "updates_per_s": status.updates_per_s,
        "players": status.players,
        "evaluators": status.evaluators,
        "lag_updates": trainer.rate_limiter.lag,
        "replay": len(trainer.replay),
        "replay_capacity": trainer.replay.capacity,
        "undone_updates": parts.guard.undone,
        **more,
        **{f"hub/{name}": count for name, count in sorted(parts.hub.counters.items())},
    }
    known = ("mean_reward", "raw_overlap", "angle_error_deg_median", "position_error_median")
    numbers |= {f"test/{name}": status.scores[name] for name in known if name in status.scores}
    texts = {
        "run": parts.folder.path.name,
        "run_id": parts.record.run_id,
        "activity": status.activity,
    }
    return RunStatus(numbers, texts, _workers(parts.hub.peers, trainer.updates))


def _workers(peers: list[Peer], updates: int) -> Floats:
    rows = [_row(peer, time.monotonic(), updates) for peer in peers]
    return np.array(rows, np.float64).reshape(-1, len(WORKER_COLUMNS))


def _row(peer: Peer, now: float, updates: int) -> list[float]:
    played = peer.weights_version
    return [
        peer.role == "evaluator",
        peer.index,
        peer.incarnation,
        max(0.0, now - peer.last_seen),
        UNKNOWN if played < 0 else max(0, updates - played),
        peer.batches,
        peer.episodes,
        peer.transitions,
        len(peer.ledger.held),
    ]
