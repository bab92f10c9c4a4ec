"""A batch that is drawn while a GPU is at work: nothing differs from drawing it in its turn."""

from collections.abc import Callable
from contextlib import closing
from typing import Any

import numpy as np
import pytest
import torch

from tangram_agent.agents.push.agent import Pushing, PushingConfig
from tangram_core.agent import NotFiniteError
from tangram_core.conformance import play
from tangram_core.spec import Episodes
from tests.agent.agents.goal.test_learner import TASK, Broken, learner
from tests.agent.agents.outline.test_filling_learning import FAR, MADE, episode, other_half
from tests.agent.agents.push.test_pushing import SQUARE, generators
from tests.agent.builders import learner_of, random_episodes, setup

pytestmark = pytest.mark.fast


def of_goals() -> tuple[Any, list[Episodes]]:
    """Every second update moves the actor."""
    rng, found = np.random.default_rng(1), [TASK.spec.empty(2), TASK.spec.empty(2)]
    for episodes in found:
        for name in ("place", "goal", "actions"):
            episodes[name][:] = rng.uniform(-1, 1, episodes[name].shape)
    return learner(), found


def of_pairs() -> tuple[Any, list[Episodes]]:
    made = setup(agent={"batch_size": 8})
    return learner_of(made), [random_episodes(made, 8, seed) for seed in (0, 1)]


def of_outlines() -> tuple[Any, list[Episodes]]:
    return learner_of(MADE), [episode(FAR), episode(other_half())]


def of_pushes() -> tuple[Any, list[Episodes]]:
    agent = Pushing(PushingConfig(width=8, batch_size=8, looked_at=4))
    made, actor = agent.learner(SQUARE, 0, "cpu"), agent.actor(SQUARE)
    actor.load(made.broadcast())
    with closing(SQUARE.make(2)) as env:
        played = [play(SQUARE, env, generators("play", n, 2), actor.act) for n in (0, 2)]
    return made, [one.episodes for one in played]


def history(make: Callable[[], tuple[Any, list[Episodes]]], ahead: bool) -> list[Any]:
    """Numbers, batches and generators of updates with an insert, a save and a way back."""
    made, (first, second) = make()
    made.draws_ahead = ahead
    rng = {name: np.random.default_rng([0, i]) for i, name in enumerate(made.streams)}
    found: list[Any] = []

    def updates() -> None:
        for _ in range(3):
            found.append(made.update(0.0, rng))
            found.append({name: one.tolist() for name, one in made.evidence().items()})
        assert (made._ahead is not None) == ahead

    def states() -> list[Any]:
        return [generator.bit_generator.state for generator in rng.values()]

    made.insert(first, rng)
    updates()
    made.insert(second, rng)
    updates()
    state = made.state()
    found.append(states())
    updates()
    made.load_state(state)
    found.append(states())
    updates()
    return found


@pytest.mark.parametrize("make", [of_goals, of_pairs, of_outlines, of_pushes])
def test_drawing_ahead_changes_nothing(make: Callable[[], tuple[Any, list[Episodes]]]) -> None:
    assert history(make, ahead=True) == history(make, ahead=False)


def test_an_update_that_fails_leaves_its_own_batch_and_generators() -> None:
    found = []
    for ahead in (True, False):
        made: Any = learner(kind=Broken)
        made.draws_ahead = ahead
        rng = {name: np.random.default_rng([0, i]) for i, name in enumerate(made.streams)}
        with pytest.raises(NotFiniteError, match=r"update 1 is not finite"):
            made.update(0.0, rng)
        batch = {name: one.tolist() for name, one in made.evidence().items()}
        found.append((made.updates, batch, [one.bit_generator.state for one in rng.values()]))
    assert found[0] == found[1]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_gpu_draws_ahead() -> None:
    assert learner(device="cuda").draws_ahead
