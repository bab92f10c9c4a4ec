"""Learning on pairs of a token and a piece of the target.

With several tokens the value of an action is the sum of what it covers of each piece. The geometry
gives these values for any goal at once, so nothing is bootstrapped.

Legend: M pairs.
"""

import numpy as np

from tangram_agent.agents.pair.actor import critic_plays
from tangram_agent.agents.pair.agent import Pair
from tangram_agent.agents.pair.batch import PairBatch, make_pairs
from tangram_agent.agents.pair.coverage import Lying
from tangram_agent.agents.pair.networks import Networks
from tangram_agent.agents.pair.pairs import Pairs
from tangram_agent.base.ddpg import Ddpg, Steps
from tangram_agent.base.types import Transitions
from tangram_core.agent import Tensors
from tangram_tasks.place import Place


class PairLearner(Ddpg):
    """DDPG learner of the actor and the critic of pairs."""

    limit = 1.0  # pre-activations beyond it are clamped

    def __init__(
        self, agent: Pair, task: Place, seed: int, device: str, compiled: bool = False
    ) -> None:
        networks = Networks(task.layout, task.sim.arena, agent.net)
        every = networks.actor, networks.critic, networks
        super().__init__(task, agent.config, every, seed, device, compiled)
        if task.layout.tokens > 1:  # each update draws new hindsight goals
            self.relabels = ()

    def steps(self, batch: Transitions, generator: np.random.Generator) -> Steps:
        """The batch as pairs, with new hindsight goals for several tokens."""
        return self.steps_of(make_pairs(batch, self.task.layout, self.config.hindsight, generator))

    def steps_of(self, batch: PairBatch) -> Steps:
        """The pairs as tensors for the losses."""
        after = self._pairs(batch, batch.after)
        return Steps(
            view=self._pairs(batch, batch.before),
            velocity=self.tensor(batch.velocity),
            reward=self.tensor(batch.reward),
            done=self.tensor(batch.done),
            start=self._pairs(batch, batch.start),
            follow=self.if_any_follows(batch.done, after),
            seen_after=after,
        )

    def _pairs(self, batch: PairBatch, token: Lying) -> Pairs:
        """The pairs (M,) with their tokens at the given poses."""
        piece = batch.piece
        return Pairs(
            pose=self.tensor(token.pose),
            flipped=self.tensor(token.flipped),
            token=self.tensor(token.index, np.int64),
            goal=self.tensor(piece.pose),
            goal_flipped=self.tensor(piece.flipped),
            piece=self.tensor(piece.index, np.int64),
            covered=self.tensor(batch.covered),
        )

    def broadcast(self) -> Tensors:
        """The averaged weights, without the critic if it takes no part in acting."""
        every = self.export()
        if critic_plays(self.task):
            return every
        return {name: one for name, one in every.items() if not name.startswith("critic.")}
