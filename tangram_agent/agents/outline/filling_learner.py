"""Learning which states can be filled: Q-learning over afterstates, with hindsight (Sec. III-B).

Every action leads to a known state, so the value of an action is that of what is left. A state
that tokens filled has the value 1. One that was played has that of the best it could have gone on
to, by the target network: 1 where that is filled, 0 where nothing fits (Eq. 5, reward at the end).

Legend: n states, M places.
"""

import numpy as np
import torch
from torch import Tensor, nn

from tangram_agent.agents.outline.filling import Rests
from tangram_agent.agents.outline.filling_replay import FILLED, OPEN, FillBatch
from tangram_agent.agents.outline.values import Corners
from tangram_agent.base.adam import Adam
from tangram_agent.learner import Learner, Rates, frozen, polyak_update
from tangram_agent.networks import initialise, outline_network, parameter_count
from tangram_agent.setup import Setup


class FillLearner(Learner):
    """The value of what is left, its target and its optimiser."""

    def __init__(self, setup: Setup, seed: int, device: str = "cpu") -> None:
        self.config, self.device, self.updates = setup.agent, torch.device(device), 0
        self.bootstraps, self.motion, self._fit = setup.bootstraps, None, None
        value = outline_network(setup)
        initialise(value, torch.Generator().manual_seed(seed))
        self.playing: nn.Module = value.to(self.device)
        self.value, self.target, self.acting = value, frozen(value), frozen(value)
        self.parameters = parameter_count(value)
        self.parts = {"value": self.value, "target": self.target, "acting": self.acting}
        self._lists = self.parameter_lists()
        self.optimisers = {"value": Adam(self._lists["value"])}

    def learn(self, batch: FillBatch, progress: float = 0.0) -> dict[str, float]:
        """One step on a batch; see `Learner.update`.

        Returns:
            critic_loss, q (mean value of states that were played) and critic_gradient.
        """
        return self._counted(self._step_value(batch, self.rates(progress)))

    def _step_value(self, batch: FillBatch, rates: Rates) -> dict[str, Tensor]:
        """One step of the network, and its numbers on the device."""
        y = torch.cat([torch.ones(len(batch.filled), device=self.device), self.targets(batch)])
        states = Rests.joined([batch.filled, batch.played])
        logits = self.value(Corners.of(states, self.device))
        loss = nn.functional.binary_cross_entropy_with_logits(logits, y)
        norm = self._step("value", loss, rates.critic)
        polyak_update(self._lists["target"], self._lists["value"], self.config.polyak)
        polyak_update(self._lists["acting"], self._lists["playing"], rates.kept)
        q = logits.detach()[len(batch.filled) :].sigmoid().mean()
        return {"critic_loss": loss.detach(), "q": q, "critic_gradient": norm}

    def targets(self, batch: FillBatch) -> Tensor:
        """(n',) values of states that were played, by what each could have gone on to."""
        best = torch.from_numpy((batch.ends == FILLED).astype(np.float32)).to(self.device)
        rows = np.flatnonzero(batch.ends.ravel() == OPEN)
        if len(rows):
            with torch.no_grad():
                ahead = self.target(Corners.of(batch.places.at(rows), self.device)).sigmoid()
            best.view(-1)[torch.from_numpy(rows).to(self.device)] = ahead
        return best.amax(dim=1)
