"""A fixed set of test episodes, played with exploration off."""

from collections.abc import Callable

from tangram_core.seeding import episode_generator
from tangram_core.task import Chooser, Played, Task
from worker.play.rollout import play


class FixedTests:
    """A fixed set of test episodes, the same for every policy, played `at_once` at a time.

    A smaller set is the beginning of a larger one. `role` and `seed` select the set; the default is
    the one that evaluators use in every run.

    Attributes:
        task: the task of the episodes.
        env: the environments.
    """

    def __init__(
        self, task: Task, episodes: int, at_once: int, role: str = "evaluation", seed: int = 0
    ) -> None:
        self.task, self._episodes = task, episodes
        self._set = (seed, role, 0, 0)
        self.env = task.make(min(at_once, episodes), "test")

    def play(self, choose: Chooser, go_on: Callable[[], bool] = lambda: True) -> Played:
        """Play all episodes with the policy `choose`; `go_on` as in `rollout.play`."""
        return play(
            self.env,
            self.task.spec,
            choose,
            lambda number: episode_generator(*self._set, number),
            self._episodes,
            facts=True,
            go_on=go_on,
        )

    def close(self) -> None:
        """Close the environments."""
        self.env.close()
