"""Updates: against a plain per-head attention, and against Stable-Baselines3's on the same MLP."""

import copy
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from tangram_agent.attention import EncoderLayer
from tangram_agent.learner import Learner, critic_target
from tangram_agent.motion import Motions
from tangram_agent.setup import Setup
from tangram_agent.steps import Steps
from tangram_lab.benchmarks.measure import Bound, Row, Work, compare, compared, rates
from tangram_lab.benchmarks.peers import compare_updates
from tangram_lab.benchmarks.replay import random_transitions
from tangram_lab.benchmarks.setups import preset, several, with_agent
from tangram_sim.errors import ConfigError

BATCHES = (64, 256)


def measure_learner(runs: int) -> list[Row]:
    """Updates per second on one core."""
    rows = _compiled(runs)
    bound = Bound(least=3.0)
    for name, setup in (("paper's MHA", preset("paper")), ("ours", preset()), ("7", several(7))):
        for size in BATCHES if name != "7" else BATCHES[:1]:
            case = f"{name if name != '7' else 'ours, 7 tokens'}, batch {size}"
            rows.append(_against_plain(case, with_agent(setup, batch_size=size), runs, bound))
    return rows + compare_updates("learner", runs)


def _compiled(runs: int) -> list[Row]:
    """`service.compile=true` against single operations, which compute the same."""
    cases = [("perceptron [64, 64]", preset("mlp"), 256, 2.3)]
    cases += [("ours", preset(), size, 1.5) for size in BATCHES]
    cases += [("ours, 7 tokens", several(7), BATCHES[0], 1.5)]
    rows = []
    for name, setup, size, least in cases:
        made = with_agent(setup, batch_size=size)
        whole = updates(made, Learner(made, 0, compiled=True))
        given = ("learner", f"{name}, batch {size}, compiled", "updates/s"), whole
        rows.append(compare(*given, ("single operations", updates(made)), runs, Bound(least)))
    return rows


def measure_gpu(runs: int) -> list[Row]:
    """Updates per second on a GPU, against single operations there and one core, compiled.

    Raises:
        ConfigError: there is no GPU.
    """
    if not torch.cuda.is_available():
        raise ConfigError("gpu needs a GPU, and none is visible: see tangram-bench learner")
    rows = []
    for name, made in gpu_cases().items():
        ways = {
            "ours": updates(made, Learner(made, 0, "cuda", compiled=True)),
            "single operations on it": updates(made, Learner(made, 0, "cuda")),
            "one core, compiled": updates(made, Learner(made, 0, compiled=True)),
        }
        found, labels = rates(ways, runs), ("gpu", f"{name}, compiled", "updates/s")
        for against, bound in zip([*ways][1:], (Bound(5.0), None), strict=True):
            rows.append(compared(labels, found["ours"], against, found[against], bound))
    return rows


def gpu_cases() -> dict[str, Setup]:
    """What is measured on a GPU, from small to large."""
    named = [("perceptron [64, 64]", preset("mlp"), 256), ("paper's MHA", preset("paper"), 64)]
    named += [("ours, 7 tokens", several(7), BATCHES[0])]
    named += [("ours", preset(), size) for size in (*BATCHES, 2048)]
    return {
        f"{name}, batch {size}": with_agent(made, batch_size=size) for name, made, size in named
    }


def _against_plain(case: str, setup: Setup, runs: int, bound: Bound) -> Row:
    theirs = ("a plain per-head attention", updates(setup, PlainLearner(setup, 0)))
    return compare(("learner", case, "updates/s"), updates(setup), theirs, runs, bound)


def updates(setup: Setup, learner: Learner | None = None) -> Work:
    """Updates on one batch; of the project's own learner if none is given."""
    learner = learner or Learner(setup, 0)
    transitions = random_transitions(setup, setup.agent.batch_size)
    batch = learner.prepared(transitions, np.random.default_rng(0))

    def work() -> int:
        learner.update(batch)
        return 1

    return work


# A plain per-head attention, and a learner with it


GAMMA = 0.99


class HeadByHead(nn.Module):
    """Eqs. 9-12, one small matrix for each head's keys, queries and values."""

    def __init__(self, width: int, heads: int, scale: float) -> None:
        super().__init__()
        key_width = width // heads
        self.scale = scale
        self.query, self.key, self.value = (
            nn.ModuleList(nn.Linear(width, key_width, bias=False) for _ in range(heads))
            for _ in range(3)
        )
        self.combine = nn.ModuleList(nn.Linear(key_width, width, bias=False) for _ in range(heads))

    def forward(self, nodes: Tensor, edges: Tensor) -> Tensor:
        """Messages (B, N, W) from nodes (B, N, W) along edges (N, N)."""
        message = torch.zeros_like(nodes)
        every: Any = zip(self.query, self.key, self.value, self.combine, strict=True)
        for query, key, value, combine in every:
            scores = query(nodes) @ key(nodes).transpose(1, 2) * self.scale
            weights = torch.softmax(scores.masked_fill(~edges, -math.inf), dim=-1)
            message = message + combine(weights @ value(nodes))
        return message


class PlainLearner(Learner):
    """Head by head, with both target networks asked and moved in every update."""

    def __init__(self, setup: Setup, seed: int) -> None:
        super().__init__(setup, seed)
        for part in (self.actor, self.critic, self.acting):
            for layer in part.modules():
                if isinstance(layer, EncoderLayer):
                    _take_apart(layer)
        self.target_actor, self.target_critic = map(copy.deepcopy, (self.actor, self.critic))
        self._lists = self.parameter_lists()
        rates = {"actor": self.config.actor_lr, "critic": self.config.critic_lr}
        self._plain = {
            part: torch.optim.Adam(getattr(self, part).parameters(), lr=rate, foreach=False)
            for part, rate in rates.items()
        }

    def update(
        self, batch: Any, progress: float = 0.0, motions: Motions | None = None
    ) -> dict[str, float]:
        """See `Learner`; the targets follow parameter by parameter."""
        losses = super().update(batch, progress, motions)
        pairs = ((self.target_actor, self.actor), (self.target_critic, self.critic))
        with torch.no_grad():
            for target, source in pairs:
                for old, new in zip(target.parameters(), source.parameters(), strict=True):
                    old.mul_(self.config.polyak).add_(new, alpha=1.0 - self.config.polyak)
        return losses

    def _step(self, part: str, loss: Tensor, _: float | Tensor) -> Tensor:
        optimiser = self._plain[part]
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        norm = nn.utils.clip_grad_norm_(getattr(self, part).parameters(), math.inf)
        optimiser.step()
        return norm

    def _target(self, steps: Steps) -> Tensor:
        follow = steps.follow or steps.view
        velocity, _ = self.target_actor(follow)
        value = self.target_critic(follow, velocity)
        return critic_target(steps.reward, steps.done, value, GAMMA)


def _take_apart(layer: EncoderLayer) -> None:
    joint = layer.attention
    width = joint.combine.in_features
    apart: Any = HeadByHead(width, joint.heads, joint.scale)
    layer.attention = apart
