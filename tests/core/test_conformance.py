"""Tasks and agents keep the promises of their interfaces, and who breaks one is told."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

import tests.core.toy  # noqa: F401 - registers environments
from tangram_agent.agents.goal.agent import Goal, GoalConfig
from tangram_agent.flat.actor_critic import Loss
from tangram_core.agent import Agent
from tangram_core.conformance import ConformanceError, check_agent, check_task
from tangram_core.errors import ConfigError
from tangram_core.setup import Setup
from tangram_core.task import Task
from tangram_tasks.gym.task import Gym, GymConfig
from tests.agent.agents.outline.outlines import outline_setup
from tests.agent.builders import PAIR, SCENE, SQUARE, setup
from tests.core.examples import example

pytestmark = pytest.mark.fast

SMALL: dict[str, Any] = {
    "hidden": (8,),
    "batch_size": 16,
    "learning_starts": 20,
    "replay_capacity": 200,
}


POINT, TD3 = example("point"), example("td3")
TOY = Gym(GymConfig(id="Toy-v0", imports=("tests.core.toy",)))
TASKS: dict[str, Task] = {
    "point": POINT.Point(),
    "toy": TOY,
    "toy without ends": Gym(replace(TOY.config, ends=False)),
    "toy made anew": Gym(replace(TOY.config, fresh=True)),
}
TINY = {"width": 8, "layers": 1, "feed_forward": 8}
FEW = {"batch_size": 8, "learning_starts": 8, "replay_capacity": 64}
OF_TOKENS = {
    "scene": setup(agent=SCENE | FEW, net=TINY, actions_per_token=2),
    "pair": setup(PAIR, FEW, TINY),
    "pair of pictures": setup(SQUARE, FEW, TINY, observe="pictures", pixels=64),
    "outline": outline_setup(agent=FEW, net=TINY),
}
AGENTS: dict[str, Agent] = {
    name: Goal(GoalConfig(algorithm=name, **SMALL)) for name in ("ddpg", "td3", "sac")
} | {
    "example": TD3.TD3(TD3.TD3Config(**SMALL)),
}


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_a_task_keeps_its_promises(task: Task) -> None:
    check_task(task)


@pytest.mark.parametrize("task", ["point", "toy"])
@pytest.mark.parametrize("agent", AGENTS.values(), ids=AGENTS)
def test_an_agent_keeps_its_promises(agent: Agent, task: str) -> None:
    check_agent(agent, TASKS[task])


@pytest.mark.parametrize("made", OF_TOKENS.values(), ids=OF_TOKENS)
def test_tasks_and_agents_of_tokens_keep_their_promises(made: Setup) -> None:
    check_task(made.task)
    check_agent(made.agent, made.task)


# Broken promises: each is found, and named


class Points(POINT.Points):  # type: ignore[misc,name-defined]
    """Environments of the example, with one fault."""

    def __init__(self, task: Task, count: int, fault: str) -> None:
        super().__init__(task, count)
        self.fault = fault

    def reset(self, generators: Any) -> Any:
        if self.fault == "global randomness":
            generators = [np.random.default_rng() for _ in generators]
        if self.fault == "neighbours":
            generators = [generators[-1]] * len(generators)
        return super().reset(generators)

    def step(self, actions: Any) -> Any:
        step = super().step(actions)
        if self.fault == "pays otherwise":
            return replace(step, rewards=step.rewards * 0.5)
        if self.fault == "flags of numbers":
            return replace(step, terminated=step.rewards)
        if self.fault == "goal moves":
            self.goal = self.goal * 0.9
        return step

    def seen(self) -> Any:
        seen = super().seen()
        changed = {
            "whole numbers": {"place": seen["place"].astype("i4")},
            "out of bounds": {"place": seen["place"] + 2},
            "not a number": {"place": seen["place"] * np.nan},
            "a field more": {"speed": seen["place"]},
            "a row less": {"place": seen["place"][1:]},
        }
        return seen | changed.get(self.fault, {})


class Broken(POINT.Point):  # type: ignore[misc,name-defined]
    """The example, with one fault of its environments."""

    fault = ""

    def make(self, count: int, purpose: str = "play") -> Any:
        return Points(self, count, self.fault)


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ("global randomness", "Points.reset: wanted the same episodes from the same"),
        ("neighbours", "Points.step: wanted an episode alone to equal"),
        ("pays otherwise", "Broken.rewards: wanted what the step was paid"),
        ("flags of numbers", "Points.step: wanted terminated"),
        ("goal moves", "Points.step: wanted field goal to stay"),
        ("whole numbers", "Points.reset: wanted place to be float32 (3, 2), got int32"),
        ("out of bounds", "Points.reset: wanted place within -1 and 1"),
        ("not a number", "Points.reset: wanted place within -1 and 1, got nan"),
        ("a field more", "Points.reset: wanted fields ['goal', 'place'], got ['goal', 'place'"),
        ("a row less", "Points.reset: wanted place to be float32 (3, 2)"),
    ],
)
def test_a_task_that_breaks_a_promise_is_told(fault: str, told: str) -> None:
    task = type("Broken", (Broken,), {"fault": fault})()
    with pytest.raises(ConformanceError) as caught:
        check_task(task)
    assert str(caught.value).startswith(told)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"score": lambda self, played: {"speed": 1.0}}, ".score: wanted success"),
        ({"score": lambda self, played: {"success": np.nan}}, ".score: wanted finite"),
        ({"ended": lambda self, a, d, recorded: ~recorded}, ".ended: wanted bool"),
        ({"ended": lambda self, a, d, _: (a == d).all(1).any() | np.zeros(len(a), bool)}, ".ended"),
        (
            {"rivals": lambda self: {"two": lambda env: lambda *_: np.full((3, 2), 2, "f4")}},
            ".rivals",
        ),
        ({"rewards": lambda self, a, d: np.zeros((len(a), 1))}, r".rewards: wanted shape \(3,\)"),
        ({"draw": lambda self, played: np.zeros((4, 4))}, ".draw: wanted uint8"),
        ({"identity": lambda self: {"task": self}}, ".identity: wanted values that JSON"),
    ],
)
def test_what_a_task_says_is_checked(changes: Mapping[str, Any], told: str) -> None:
    with pytest.raises(ConformanceError, match=f"^Wrong{told}"):
        check_task(type("Wrong", (POINT.Point,), dict(changes))())


def broadcasts_half(self: Any) -> Any:
    return {name: tensor.astype(np.float64) for name, tensor in full(self).items()}


full = TD3.TD3Learner.broadcast


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"broadcast": broadcasts_half}, ".broadcast: wanted"),
        (
            {"broadcast": lambda self: full(self) | {"more": np.zeros(1, "f4")}},
            ".broadcast: wanted",
        ),
        ({"update": lambda self, share, rng: {"q": np.nan}}, ".update: wanted finite"),
        ({"update": lambda self, share, rng: {"q": 1.0}}, ".update: wanted updates to be 1"),
        ({"load_state": lambda self, state: None}, ".load_state: wanted the numbers of an"),
        ({"load_networks": lambda self, state: None}, ".load_state: wanted the numbers of an"),
        ({"insert": lambda self, episodes, rng: 0}, ".insert: wanted 1 to"),
    ],
)
def test_an_agent_that_breaks_a_promise_is_told(changes: Mapping[str, Any], told: str) -> None:
    learner = type("Wrong", (TD3.TD3Learner,), dict(changes))
    agent = type("Agent", (TD3.TD3,), {"learns": lambda self: learner})(TD3.TD3Config(**SMALL))
    with pytest.raises(ConformanceError, match=f"^Wrong{told}"):
        check_agent(agent, POINT.Point())


def test_actions_are_of_the_tasks_size_also_where_nothing_is_explored() -> None:
    policy = TD3.TD3.policy
    wide = type("Agent", (TD3.TD3,), {"policy": lambda self, inputs, _: policy(self, inputs, 3)})
    with pytest.raises(ConformanceError, match=r"actions to be float32 \(3, 2\), got .*3, 3"):
        check_agent(wide(TD3.TD3Config(**SMALL)), POINT.Point())


def only(part: str, loss: Callable[[Any], Any]) -> Any:
    """Losses of one network alone."""

    def losses(self: Any, batch: Any) -> Any:
        yield Loss(part, loss(sum(self.critic(batch.rows, batch.actions))))

    return losses


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"losses": only("critics", torch.mean)}, "losses: wanted one of actor, critic, got a Los"),
        ({"losses": only("critic", lambda one: one)}, "losses: wanted a single number, got a Loss"),
        (
            {"losses": only("critic", torch.mean)},
            "losses: wanted a Loss of each .* none of",
        ),
        (
            {"target_names": lambda _: "critic"},
            "target_names: wanted names of actor, critic",
        ),
    ],
)
def test_losses_that_cannot_be_learned_are_told(changes: Mapping[str, Any], told: str) -> None:
    learner = type("Wrong", (TD3.TD3Learner,), dict(changes))
    agent = type("Agent", (TD3.TD3,), {"learns": lambda self: learner})(TD3.TD3Config(**SMALL))
    with pytest.raises(ConfigError, match=f"^Wrong.{told}"):
        check_agent(agent, POINT.Point())
