"""Small setups, layouts and episodes that the tests of the agent share."""

import hashlib
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tangram_agent.base.types import Transitions
from tangram_agent.pretrained import CARD, WEIGHTS
from tangram_agent.runs import beginning
from tangram_core.agent import Weights
from tangram_core.setup import Setup, make_setup
from tangram_core.spec import Episodes, EpisodeSpec

SQUARE = {"shapes": ["square"], "scale": 1.131370849898476}  # side 0.4
PAIR = {"shapes": ["square", "large_triangle"], "scale": 0.8}

PAPER = {
    "kind": "scene",
    "saturation_penalty": 0.0,
    "gamma": 0.99,
    "acting_average": 0.0,
    "lr_final": 1.0,
}
# One relabelled goal, and on pairs one proposal: what most tests need.
PLAIN: dict[str, Any] = {"hindsight": [{"strategy": "final"}]}
PROPOSAL = {"reapply": 0}
SCENE = {"kind": "scene"}
SMALL = {"width": 16, "layers": 2, "feed_forward": 32}


def sections(
    tokens: dict[str, Any] = SQUARE,
    agent: dict[str, Any] | None = None,
    net: dict[str, Any] = SMALL,
    **sim: Any,
) -> dict[str, Any]:
    """A config on the kinematic backend with a small network."""
    kind = (agent or {}).get("kind", "pair")
    usual = {"pair": PLAIN | PROPOSAL, "scene": PLAIN}.get(kind, {})
    return {
        "task": {"kind": "fill" if kind == "outline" else "place"},
        "tokens": tokens,
        "sim": {"backend": "kinematic", **sim},
        "reward": {},
        "agent": {"kind": kind} | usual | (agent or {}),
        "net": net,
    }


def setup(*given: Any, **named: Any) -> Setup:
    """What such a config makes."""
    return make_setup(sections(*given, **named))


def learner_of(made: Setup, seed: int = 0, device: str = "cpu", compiled: bool = False) -> Any:
    """Who learns it."""
    return made.agent.learner(made.task, seed, device, compiled=compiled)


def learn(learner: Any, batch: Transitions, share: float = 0.0, seed: int = 0) -> dict[str, float]:
    """One update on transitions; its numbers."""
    return learner.learn(learner.steps(batch, np.random.default_rng(seed)), share)


def seen_in(batch: Transitions) -> dict[str, Any]:
    """What is observed before the actions."""
    return {"corners": batch.state, "placed": batch.placed, "goals": batch.goal}


class Policy:
    """An actor, asked for corners (B, V, 2), placed (B, K) and goals (B, V, 2)."""

    def __init__(self, made: Setup) -> None:
        self.made, self.actor, self.version = made, made.agent.actor(made.task), -1

    def load(self, tensors: dict[str, Any]) -> None:
        """Take over weights."""
        self.actor.load(tensors)

    def follow(self, weights: Weights) -> None:
        """Take over what a master sends."""
        self.actor.load(weights.tensors)
        self.version = weights.version

    def act(self, corners: Any, placed: Any, goals: Any) -> Any:
        """As well as it can."""
        return self.explore(corners, placed, goals, None)

    def explore(self, corners: Any, placed: Any, goals: Any, generators: Any) -> Any:
        """With exploration."""
        seen = {"corners": corners, "placed": placed, "goals": goals}
        return self.actor.act(seen, beginning(self.made.spec, seen), generators)


def one_tensor(dtype: str, shape: list[int], data: bytes = bytes(4)) -> bytes:
    """A file of safetensors with one, of four bytes that are said to be this."""
    described = {"a": {"dtype": dtype, "shape": shape, "data_offsets": [0, 4]}}
    header = json.dumps(described).encode()
    return len(header).to_bytes(8, "little") + header + data


def with_weights(agent: Path, data: bytes) -> None:
    """Weights that were not the agent's, as its card has it they are."""
    card = json.loads((agent / CARD).read_text()) | {"sha256": hashlib.sha256(data).hexdigest()}
    (agent / CARD).write_text(json.dumps(card))
    (agent / WEIGHTS).write_bytes(data)


BFLOAT = one_tensor("BF16", [2])  # which numpy has not
ZERO = one_tensor("F32", [1])
NAN = one_tensor("F32", [1], b"\xff" * 4)


def random_episodes(made: Setup, count: int, seed: int = 0) -> Episodes:
    """Episodes of random poses and actions; poses do not follow from actions."""
    rng = np.random.default_rng(seed)
    layout, steps = made.task.layout, made.task.spec.horizon
    poses = rng.uniform([-0.7, -0.7, -3], [0.7, 0.7, 3], (count, steps + 2, layout.tokens, 3))
    corners = layout.corners(poses).astype(np.float32)
    actions = rng.uniform(-1, 1, (count, steps, made.task.spec.action_size))
    placed = np.zeros((count, steps + 1, layout.tokens), np.uint8)
    placed[:, -1] = 1
    return Episodes(
        {
            "corners": corners[:, : steps + 1],
            "placed": placed,
            "goals": corners[:, -1],
            "actions": actions.astype(np.float32),
            "rewards": rng.uniform(-1, 1, (count, steps)).astype(np.float32),
            "terminated": placed[:, 1:].all(axis=2).astype(np.uint8),
        }
    )


def with_bound(spec: EpisodeSpec, bound: float) -> EpisodeSpec:
    """The same episodes, with other bounds of what is observed."""
    wide = {field: replace(field, low=-bound, high=bound) for field in spec.fields}
    fields = (wide[field] if field.dtype == "f4" else field for field in spec.fields)
    return replace(spec, fields=tuple(fields))


def random_transitions(made: Setup, count: int, seed: int = 0, done: int | None = 1) -> Transitions:
    """Transitions of random poses, unplaced before and placed after."""
    rng = np.random.default_rng(seed)
    layout = made.task.layout
    poses = rng.uniform([-0.7, -0.7, -3], [0.7, 0.7, 3], (count, 3, layout.tokens, 3))
    corners = layout.corners(poses).astype(np.float32)
    # As a replay gives them: each in rows of its own.
    before, after, goal = (np.ascontiguousarray(corners[:, i]) for i in range(3))
    ends = rng.integers(0, 2, count) if done is None else np.full(count, done)
    return Transitions(
        state=before,
        placed=np.zeros((count, layout.tokens), np.uint8),
        action=rng.uniform(-1, 1, (count, made.task.spec.action_size)).astype(np.float32),
        reward=rng.uniform(-1, 1, count).astype(np.float32),
        next_state=after,
        next_placed=np.repeat(ends[:, None], layout.tokens, axis=1).astype(np.uint8),
        done=ends.astype(np.uint8),
        goal=goal,
    )


def watched_disk(monkeypatch: pytest.MonkeyPatch) -> list[int | str]:
    """What reaches the disk, as it does: inodes that are synced, and "renamed"."""
    events: list[int | str] = []

    def noted(move: Any) -> Any:
        def renamed(own: Path, target: Path) -> Path:
            events.append("renamed")
            return move(own, target)

        return renamed

    monkeypatch.setattr(os, "fsync", lambda handle: events.append(os.fstat(handle).st_ino))
    for name in ("rename", "replace"):
        monkeypatch.setattr(Path, name, noted(getattr(Path, name)))
    return events
