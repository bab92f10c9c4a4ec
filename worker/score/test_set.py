"""A fixed set of test episodes, played with exploration off."""

from collections.abc import Callable

from tangram_core.seeding import episode_generator
from tangram_core.task import Chooser, Played, Task
from worker.play.rollout import play


class FixedTests:
    """Test episodes that are the same whoever plays them, `at_once` of them at a time.

    The first ones of a larger set are those of a smaller one. `role` and `seed` name the set; by
    default it is the fixed one, the same in every run.

    Attributes:
        task: what is played.
        env: where they are played.
    """

    def __init__(
        self, task: Task, episodes: int, at_once: int, role: str = "evaluation", seed: int = 0
    ) -> None:
        self.task, self._episodes = task, episodes
        self._set = (seed, role, 0, 0)
        self.env = task.make(min(at_once, episodes), "test")

    def play(self, choose: Chooser, go_on: Callable[[], bool] = lambda: True) -> Played:
        """All episodes, fewer if `go_on` says so; see `rollout.play`."""
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
