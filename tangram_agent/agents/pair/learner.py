"""Learning on pairs of a token and a piece of the target.

With several tokens what an action is worth falls apart into what it covers of each piece, and
hindsight knows the geometry: so a pair's value is known at once, and nothing is bootstrapped.

Legend: M pairs.
"""

from collections.abc import Mapping

import numpy as np

from tangram_agent.agents.pair.actor import critic_plays
from tangram_agent.agents.pair.agent import Pair
from tangram_agent.agents.pair.batch import PairBatch, make_pairs
from tangram_agent.agents.pair.coverage import Lying
from tangram_agent.agents.pair.motion import Fit, MotionModel, motions_of
from tangram_agent.agents.pair.networks import Networks
from tangram_agent.agents.pair.pairs import Pairs
from tangram_agent.base.ddpg import Ddpg, Steps
from tangram_agent.base.types import Transitions
from tangram_agent.nets.weights import under
from tangram_core.agent import Streams, Tensors
from tangram_core.errors import RunError
from tangram_core.spec import Array
from tangram_tasks.place import Place

SEEN_MOTIONS = 256  # transitions of whole episodes that the motion model sees in an update


class PairLearner(Ddpg):
    """Actor, critic, and the model of motion.

    Attributes:
        motion: None where the motion is taken to be exact.
    """

    limit = 1.0  # pre-activations beyond it are clamped

    def __init__(
        self, agent: Pair, task: Place, seed: int, device: str, compiled: bool = False
    ) -> None:
        learned, arena = agent.config.motion == "learned", task.sim.arena
        networks = Networks(task.layout, arena, agent.net, motion=learned)
        every = networks.actor, networks.critic, networks
        self.motion = networks.motion
        others = {} if self.motion is None else {"motion": self.motion}
        super().__init__(task, agent.config, every, seed, device, compiled, others)
        if task.layout.tokens > 1:  # relabelled anew for every update
            self.relabels = ()
        if self.motion is not None:
            self.streams = (*Ddpg.streams, "motion")
            # In pictures of an exact world a motion far beside what is usual is that of a token
            # which met others or was seen wrongly. Elsewhere it may be what that world does.
            seen, several = task.sim.observe == "pictures", task.layout.tokens > 1
            screened = seen and several and not task.sim.inexact
            self.optimisers["motion"] = Fit(self.motion, screened)

    def update(self, share: float, rng: Streams) -> dict[str, float]:
        """As `Ddpg`, and one step of the model of motion.

        Its numbers come with motion_error and motion_noise (shares of full scale).
        """
        told, task, steps = {}, self.task, self.task.horizon
        if self.motion is not None:
            count = max(1, SEEN_MOTIONS // steps)
            past, ends = self.replay.sample_episodes(count, steps, rng["motion"])
            motions = motions_of(past, ends.astype(np.float64), task.layout, task.sim)
            told = self.optimisers["motion"].step(motions.to(self.place))
        return self.learn(self.drawn(rng), share, told)

    def steps(self, batch: Transitions, generator: np.random.Generator) -> Steps:
        """Pairs of a batch."""
        return self.steps_of(make_pairs(batch, self.task.layout, self.config.hindsight, generator))

    def steps_of(self, batch: PairBatch) -> Steps:
        """Pairs as tensors."""
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
        """The pairs (M,) with their tokens where they lay at some time."""
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
        """Not the critic, where it has no say in what is played."""
        every = self.export()
        if critic_plays(self.task):
            return every
        return {name: one for name, one in every.items() if not name.startswith("critic.")}

    def load_networks(self, state: Mapping[str, Array]) -> None:
        """Take over the networks of a state, and nothing else.

        Raises:
            RunError: tensors are missing or have other shapes.
        """
        if self.motion is not None and not under("motion.", state):
            raise RunError(
                "the checkpoint has no model of motion: set agent.motion=exact, as it was trained"
            )
        super().load_networks(state)

    def begin_with(self, state: Mapping[str, Array]) -> None:
        """Take over networks; the motion is learned anew: its world may be another."""
        super().begin_with(state)
        if self.motion is not None:
            for model in (self.motion, self.acting.get_submodule("motion")):
                model.load_state_dict(MotionModel().state_dict())
