"""The replay buffer of agents of tokens: single transitions."""

import numpy as np

from tangram_agent.base.ring import Column, Ring
from tangram_agent.base.types import Transitions
from tangram_core.arrays import Singles
from tangram_tasks.played import Past


class ReplayBuffer(Ring):
    """Keeps the newest `capacity` transitions; sampling is uniform with replacement."""

    def __init__(self, capacity: int, corners: int, tokens: int, action_size: int) -> None:
        """Allocate everything at once.

        Args:
            capacity: transitions kept.
            corners: V.
            tokens: K.
            action_size: A.
        """

        def numbers(*shape: int) -> Column:
            return Column(np.zeros((capacity, *shape), np.float32))

        def flags(*shape: int) -> Column:
            return Column(np.zeros((capacity, *shape), np.uint8), 0, 1)

        super().__init__(
            {
                "state": numbers(corners, 2),
                "placed": flags(tokens),
                "action": numbers(action_size),
                "reward": numbers(),
                "next_state": numbers(corners, 2),
                "next_placed": flags(tokens),
                "done": flags(),
                "goal": numbers(corners, 2),
            }
        )

    def add(self, batch: Transitions) -> None:
        """Append a batch; the oldest transitions make room."""
        self.append(batch.arrays)

    def sample(self, size: int, generator: np.random.Generator) -> Transitions:
        """`size` transitions, drawn uniformly with replacement.

        Raises:
            ValueError: the buffer is empty.
        """
        rows = self.drawn(size, generator)
        return Transitions(**{name: array[rows] for name, array in self.arrays.items()})

    def sample_episodes(
        self, count: int, steps: int, generator: np.random.Generator
    ) -> tuple[Past, Singles]:
        """Episodes of so many steps, drawn uniformly with replacement: their past and their ends.

        Raises:
            ValueError: none is whole.
        """
        # Rows are added episode by episode, so each begins at a multiple of its steps.
        first, end = -(-(self.added - len(self)) // steps), self.added // steps
        if first >= end:
            raise ValueError(f"the replay buffer holds no whole episode of {steps} steps")
        begin = generator.integers(first, end, size=count) * steps
        rows = (begin[:, None] + np.arange(steps)) % self.capacity
        past = Past(self.arrays["state"][rows], self.arrays["action"][rows])
        return past, self.arrays["next_state"][rows[:, -1]]
