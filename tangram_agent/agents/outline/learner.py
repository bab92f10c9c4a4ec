"""Learning which states can be filled: Q-learning over afterstates, with hindsight (Sec. III-B).

Every action leads to a known state, so the value of an action is that of what is left. A state
that tokens filled has the value 1. One that was played has that of the best it could have gone on
to, by the target network: 1 where that is filled, 0 where nothing fits (Eq. 5, reward at the end).

Legend: n states, M places.
"""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor, nn

from tangram_agent.agents.outline.config import OutlineConfig
from tangram_agent.agents.outline.filling import Filling, Rests
from tangram_agent.agents.outline.filling_replay import FILLED, OPEN, FillBatch, FillReplay
from tangram_agent.agents.outline.values import Corners, OutlineValue
from tangram_agent.base.config import NetConfig
from tangram_agent.base.learning import NetworkLearner, Rates, frozen, polyak_update
from tangram_agent.base.relabelling import learnable
from tangram_core.agent import Streams
from tangram_core.spec import Array, Arrays, Episodes
from tangram_tasks.fill import Fill


class FillLearner(NetworkLearner):
    """The value of what is left, its target and its optimiser."""

    def __init__(
        self, task: Fill, config: OutlineConfig, net: NetConfig, seed: int, device: str = "cpu"
    ) -> None:
        self.config, layout = config, task.layout
        self.value = OutlineValue(Filling(layout).shapes, net)
        super().__init__(config, {"value": self.value}, self.value, seed, device)
        self.replay = FillReplay(layout, config.replay_capacity, config.copies)
        self.capacity = config.replay_capacity
        self.batch: FillBatch | None = None

    def _more_parts(self) -> dict[str, nn.Module]:
        self.target = frozen(self.value)
        return {"target": self.target}

    def insert(self, episodes: Episodes, rng: Streams) -> int:
        """Keep states that were played, and those that tokens came to fill."""
        return self.replay.insert(learnable(episodes), rng["hindsight"])

    @property
    def kept(self) -> int:
        """States of each kind."""
        return len(self.replay)

    def memory(self) -> dict[str, Array]:
        """The replay."""
        return self.replay.state()

    def load_memory(self, memory: Mapping[str, Array]) -> None:
        """Take over a replay."""
        self.replay.load_state(memory)

    def update(self, share: float, rng: Streams) -> dict[str, float]:
        """See `Learner.update`; its numbers are those of `learn`."""
        self.batch = self.replay.sample(self.config.batch_size, rng["replay"])
        return self.learn(self.batch, share)

    def evidence(self) -> Arrays:
        """The batch of the last update."""
        return {} if self.batch is None else self.batch.arrays

    def learn(self, batch: FillBatch, share: float = 0.0) -> dict[str, float]:
        """One step on a batch; see `Ddpg.learn`.

        Returns:
            critic_loss, q (mean value of states that were played) and critic_gradient.
        """
        return self._counted(self._step_value(batch, self.rates(share)))

    def _step_value(self, batch: FillBatch, rates: Rates) -> dict[str, Tensor]:
        """One step of the network, and its numbers on the device."""
        y = torch.cat([torch.ones(len(batch.filled), device=self.place), self.targets(batch)])
        states = Rests.joined([batch.filled, batch.played])
        logits = self.value(Corners.of(states, self.place))
        loss = nn.functional.binary_cross_entropy_with_logits(logits, y)
        norm = self._step("value", loss, rates.critic)
        polyak_update(self._lists["target"], self._lists["value"], self.config.polyak)
        polyak_update(self._lists["acting"], self._lists["playing"], rates.kept)
        q = logits.detach()[len(batch.filled) :].sigmoid().mean()
        return {"critic_loss": loss.detach(), "q": q, "critic_gradient": norm}

    def targets(self, batch: FillBatch) -> Tensor:
        """(n',) values of states that were played, by what each could have gone on to."""
        best = torch.from_numpy((batch.ends == FILLED).astype(np.float32)).to(self.place)
        rows = np.flatnonzero(batch.ends.ravel() == OPEN)
        if len(rows):
            with torch.no_grad():
                ahead = self.target(Corners.of(batch.places.at(rows), self.place)).sigmoid()
            best.view(-1)[torch.from_numpy(rows).to(self.place)] = ahead
        return best.amax(dim=1)
