"""The learner on whole scenes, as in the paper."""

import numpy as np
from torch import Tensor

from tangram_agent.agents.scene.agent import Scene
from tangram_agent.agents.scene.networks import ActorNet
from tangram_agent.agents.scene.scenes import Scenes, next_token
from tangram_agent.base.ddpg import Ddpg, Steps
from tangram_agent.base.types import Transitions
from tangram_agent.nets.networks import VELOCITY
from tangram_sim.motion.actions import chosen_tokens
from tangram_tasks.place import Place


class SceneLearner(Ddpg):
    """DDPG learner of the paper's actor and critic."""

    actor: ActorNet

    def __init__(
        self, agent: Scene, task: Place, seed: int, device: str, compiled: bool = False
    ) -> None:
        actor, critic = agent.networks(task.layout)
        self.delay = agent.config.actor_delay
        super().__init__(task, agent.config, (actor, critic, actor), seed, device, compiled)

    def steps(self, batch: Transitions, generator: np.random.Generator) -> Steps:  # noqa: ARG002
        """The batch as whole scenes."""
        tokens = self.task.layout.tokens
        state, placed = self.tensor(batch.state), self.tensor(batch.placed)
        goal, action = self.tensor(batch.goal), self.tensor(batch.action)
        moved = self.tensor(chosen_tokens(batch.action.astype(np.float64), tokens), np.int64)
        taken = Scenes(state, placed, goal, moved)
        start = taken if tokens == 1 else Scenes(state, placed, goal, next_token(placed))
        following, flags = self.tensor(batch.next_state), self.tensor(batch.next_placed)
        follow = Scenes(following, flags, goal, next_token(flags))
        return Steps(
            view=taken,
            velocity=action[:, -VELOCITY:],
            reward=self.tensor(batch.reward),
            done=self.tensor(batch.done),
            start=start,
            follow=self.if_any_follows(batch.done, follow),
            acts=self.updates % self.delay == self.delay - 1,
        )

    def features(self, steps: Steps) -> Tensor | None:
        """Node features that actor and critic share, if they see the same scenes."""
        return self.actor.head.see(steps.view) if steps.start is steps.view else None
