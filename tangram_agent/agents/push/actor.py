"""Acting in workers: the push of the best value.

Legend: B environments, K tokens.
"""

import numpy as np
import torch
from torch import nn

from tangram_agent.agents.push.agent import PushingConfig
from tangram_agent.agents.push.choosing import best
from tangram_agent.agents.push.networks import Table, Twins
from tangram_agent.agents.push.scenes import PUSHES, Tokens
from tangram_agent.base.acting import NetworkActor
from tangram_core.arrays import Ints, Singles
from tangram_core.spec import Arrays
from tangram_core.task import Generators, History
from tangram_tasks.push.task import Push

CPU = torch.device("cpu")
_SURE = 4  # times as many pushes are looked at where nothing is tried out


class Played(nn.Module):
    """What a broadcast brings."""

    def __init__(self, task: Push, width: int) -> None:
        super().__init__()
        corners = task.layout.padded_corners.shape[1]
        self.critic, self.table = Twins(corners, width), Table(task.layout.tokens)


class PushActor(NetworkActor):
    """Plays the push that the critics value most."""

    network: Played

    def __init__(self, task: Push, config: PushingConfig) -> None:
        super().__init__(Played(task, config.width))
        self._task, self._config, self._tokens = task, config, Tokens(task, CPU)

    def act(self, seen: Arrays, past: History, explore: Generators | None = None) -> Singles:  # noqa: ARG002
        """(B, 4) of corners and goals (B, V, 2).

        Where it explores, other pushes are drawn each time, and some are any.
        """
        tokens = self._tokens
        corners, goals = seen["corners"], seen["goals"]
        scene = tokens.scene(corners, goals)
        drawn, any_push = self._drawn(len(corners), explore)
        with torch.no_grad():
            times = 1 if explore is not None else _SURE
            looked_at = min(times * self._config.looked_at, PUSHES)
            moved = self.network.table.moved
            slots = torch.arange(self._task.count).expand(len(corners), -1)
            found = best(self.network.critic, moved, tokens, scene, slots, drawn, looked_at)
        chosen, pushes = (one.numpy().copy() for one in found[1:])
        if explore is not None:
            other = any_push[:, 0] < self._config.uniform_share
            count = scene.present.sum(1).numpy()
            chosen = np.where(other, (any_push[:, 1] * count).astype(np.int64), chosen)
            pushes = np.where(other, (any_push[:, 2] * PUSHES).astype(np.int64), pushes)
        which = scene.which.numpy()[np.arange(len(chosen)), chosen]
        actions: Singles = tokens.actions[which, pushes].astype(np.float32)
        return actions

    def _drawn(self, count: int, explore: Generators | None) -> tuple[torch.Tensor, Singles]:
        """(B * K, P) pushes to look at, and three numbers (B, 3) in [0, 1) for each environment."""
        each = self._task.count
        if explore is None:  # all of them, always in the same order
            whole: Ints = np.tile(np.arange(PUSHES), (count * each, 1))
            return torch.from_numpy(whole), np.ones((count, 3), np.float32)
        size = (each, 2 * self._config.looked_at)
        drawn = [(one.integers(PUSHES, size=size), one.random(3)) for one in explore]
        pushes, numbers = (np.stack(part) for part in zip(*drawn, strict=True))
        return torch.from_numpy(pushes.reshape(count * each, -1)), numbers.astype(np.float32)
