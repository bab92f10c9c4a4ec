"""Learning which states can be filled: Q-learning over afterstates, with hindsight (Sec. III-B).

Every action leads to a known state, so its value is the value of that state. A state that tokens
filled has the value 1. A played state has the value of the best state that could have followed, by
the target network: 1 if that one is filled, 0 if no token fits (Eq. 5, reward at the end).

Legend: n states, M places.
"""

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor, nn

from tangram_agent.agents.outline.agent import Outline
from tangram_agent.agents.outline.filling import Filling, Rests
from tangram_agent.agents.outline.filling_replay import FILLED, OPEN, FillBatch, FillReplay
from tangram_agent.agents.outline.values import Corners, OutlineValue
from tangram_agent.base.learning import Loss, TokenLearner
from tangram_agent.base.relabelling import learnable
from tangram_core.agent import Streams
from tangram_core.spec import Episodes
from tangram_tasks.fill import Fill


class FillLearner(TokenLearner):
    """Learner of the value of states, with a target network."""

    compiles = False
    replay: FillReplay
    batch: FillBatch | None

    def __init__(self, agent: Outline, task: Fill, seed: int, device: str, _: bool = False) -> None:
        self.config = config = agent.config
        self.polyak = config.polyak
        self.value = OutlineValue(Filling(task.layout).shapes, agent.net)
        learned = {"critic": self.value}
        super().__init__(config, learned, self.value, seed, device, targets=learned)
        self.replay = FillReplay(task.layout, config.replay_capacity, config.copies)

    def insert(self, episodes: Episodes, rng: Streams) -> int:
        """Add played states and hindsight states to the replay buffer."""
        self.put_back()
        return self.replay.insert(learnable(episodes), rng["hindsight"])

    def drawn(self, rng: Streams) -> FillBatch:
        """Draw a batch of states from the replay buffer."""
        self.batch = drawn = self.replay.sample(self.config.batch_size, rng["replay"])
        return drawn

    def losses(self, seen: FillBatch) -> Iterator[Loss]:
        """Yield the cross-entropy of the value; q is the mean value of played states."""
        y = torch.cat([torch.ones(len(seen.filled), device=self.place), self.values(seen)])
        states = Rests.joined([seen.filled, seen.played])
        logits = self.value(Corners.of(states, self.place))
        loss = nn.functional.binary_cross_entropy_with_logits(logits, y)
        q = logits.detach()[len(seen.filled) :].sigmoid().mean()
        yield Loss("critic", loss, {"q": q})

    def values(self, batch: FillBatch) -> Tensor:
        """Target values (n',) of played states, by the best state that could have followed."""
        best = self.tensor(batch.ends == FILLED)
        rows = np.flatnonzero(batch.ends.ravel() == OPEN)
        if len(rows):
            with torch.no_grad():
                ahead = self.targets["critic"](Corners.of(batch.places.at(rows), self.place))
            best.view(-1)[self.tensor(rows, np.int64)] = ahead.sigmoid()
        return best.amax(dim=1)
