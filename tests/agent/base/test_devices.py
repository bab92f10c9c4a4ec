"""Learning stays on its device, shown without one: torch's `meta` device has shapes and no values.

It refuses to mix with the CPU, as a GPU does, and to give a value to the host. So a tensor made on
the wrong device, or an update that waits for the device on its way, ends in an error here.
"""

import numpy as np
import pytest

from tangram_agent.base.ddpg import Ddpg, Steps
from tangram_core.setup import Setup
from tests.agent.agents.outline.outlines import outline_setup
from tests.agent.agents.outline.test_filling_learning import episode
from tests.agent.agents.pair.pair_scenes import transitions
from tests.agent.base.test_ddpg import CASES
from tests.agent.builders import learner_of, random_transitions

META = "meta"


def steps_of(learner: Ddpg, made: Setup, done: int | None) -> Steps:
    """Of a batch on the learner's device."""
    drawn = (
        transitions(made, 16, 0)
        if (made.agent_kind == "pair")
        else random_transitions(made, 32, 0, done=done)
    )
    return learner.steps(drawn, np.random.default_rng(0))


# Whether no transition ends its episode, all do, or some; those of pairs are drawn in one way.
ENDS = [(case, done) for case in CASES for done in ([None] if case[0] == "pairs" else [0, 1, None])]


@pytest.mark.fast
@pytest.mark.parametrize(("case", "done"), ENDS)
def test_an_update_stays_on_its_device(case: tuple[str, str], done: int | None) -> None:
    made = CASES[case]()
    learner = learner_of(made, 0, META)
    numbers = learner._whole(steps_of(learner, made, done), learner.rates(0.5))
    assert (numbers.device.type, len(numbers)) == (META, 6)


@pytest.mark.slow
@pytest.mark.parametrize("case", [("ddpg", "paper"), ("pairs", "mlp")])
def test_a_traced_update_stays_on_its_device(
    case: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch._inductor.standalone_compile", lambda graph, *_, **__: graph)
    made = CASES[case]()
    learner = learner_of(made, 0, META, compiled=True)
    numbers = learner._whole(steps_of(learner, made, None), learner.rates(0.5))
    assert (numbers.device.type, len(numbers)) == (META, 6)


@pytest.mark.fast
def test_learning_what_can_be_filled_stays_on_its_device() -> None:
    made = outline_setup(agent={"replay_capacity": 8, "batch_size": 8})
    learner, generator = learner_of(made, 0, META), np.random.default_rng(0)
    learner.insert(episode([9.0, 9.0, 0.0]), {"hindsight": generator})
    numbers = learner.step(learner.replay.sample(8, generator), learner.rates(0.5))
    assert (numbers.device.type, len(numbers)) == (META, 3)
