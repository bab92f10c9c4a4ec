"""The replay buffer of agents of tokens: single transitions."""

import numpy as np

from tangram_agent.base.ring import Column, Ring
from tangram_agent.base.types import Transitions


class ReplayBuffer(Ring):
    """Keeps the newest `capacity` transitions; sampling is uniform with replacement."""

    def __init__(self, capacity: int, corners: int, tokens: int, action_size: int) -> None:
        """Allocate all arrays at once.

        Args:
            capacity: most transitions kept.
            corners: V, corners of all tokens together.
            tokens: K, number of tokens.
            action_size: A, entries of an action.
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
        """Append a batch and drop the oldest transitions beyond the capacity."""
        self.append(batch.arrays)

    def sample(self, size: int, generator: np.random.Generator) -> Transitions:
        """`size` transitions, drawn uniformly with replacement.

        Raises:
            ValueError: the buffer is empty.
        """
        rows = self.drawn(size, generator)
        return Transitions(**{name: array[rows] for name, array in self.arrays.items()})
