"""Learners of actor and critics: what an update does to which network."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tangram_agent.agents.goal.agent import Goal, GoalConfig
from tangram_agent.agents.goal.gaussian import GaussianPolicy
from tangram_agent.agents.goal.learner import GoalLearner
from tangram_agent.base.compiling import Whole
from tangram_agent.flat.actor_critic import ActorCritic, Batch, Loss
from tangram_core.agent import NotFiniteError
from tangram_core.errors import ConfigError, RunError
from tests.agent.agents.goal.worlds import Line

pytestmark = pytest.mark.fast

TASK = Line()
SMALL = GoalConfig(hidden=(8,), batch_size=16, learning_starts=4, replay_capacity=100)


def learner(
    config: GoalConfig = SMALL, kind: type[ActorCritic[Any]] | None = None, device: str = "cpu"
) -> Any:
    """With four random episodes."""
    agent = Goal(config)
    made: Any = (kind or agent.learns())(agent, TASK, 0, device)
    rng, episodes = np.random.default_rng(0), TASK.spec.empty(4)
    for name in ("place", "goal", "actions"):
        episodes[name][:] = rng.uniform(-1, 1, episodes[name].shape)
    episodes["rewards"][:] = -1
    made.insert(episodes, streams(made))
    return made


def streams(made: ActorCritic[Any]) -> dict[str, np.random.Generator]:
    return {name: np.random.default_rng([0, i]) for i, name in enumerate(made.streams)}


def parts(made: Any) -> dict[str, Tensor]:
    """All parameters of each network in one."""
    modules = made.parts | {f"target_{name}": one for name, one in made.targets.items()}
    return {
        name: torch.cat([p.detach().flatten().clone() for p in module.parameters()])
        for name, module in modules.items()
    }


@pytest.mark.parametrize(
    ("algorithm", "networks"),
    [
        ("ddpg", {"actor", "critic", "target_actor", "target_critic"}),
        ("td3", {"actor", "critic", "target_actor", "target_critic"}),
        ("sac", {"actor", "critic", "temperature", "target_critic"}),
    ],
)
def test_an_update_moves_all_networks(algorithm: str, networks: set[str]) -> None:
    made = learner(replace(SMALL, algorithm=algorithm))
    before = parts(made)
    assert before.keys() == networks
    made.update(0.0, streams(made))
    after = parts(made)
    assert all(not torch.equal(before[name], after[name]) for name in networks)
    for name in made.targets:
        expected = torch.lerp(before[f"target_{name}"], after[name], 1 - SMALL.polyak)
        assert torch.allclose(after[f"target_{name}"], expected, atol=1e-7)


def test_a_delayed_actor_moves_in_every_other_update() -> None:
    made, rng = learner(), streams(learner())
    told = []
    for _ in range(4):
        before = parts(made)["actor"]
        numbers = made.update(0.0, rng)
        told.append("actor_loss" in numbers)
        assert torch.equal(before, parts(made)["actor"]) != told[-1]
    assert told == [True, False, True, False]


def test_targets_stay_within_what_rewards_add_up_to() -> None:
    made = learner(replace(SMALL, gamma=0.75))
    values = torch.tensor([-9.0, -1.0, 2.0])
    assert made.bounded(values).tolist() == [-4.0, -1.0, 0.0]  # rewards are in [-1, 0]


@pytest.mark.parametrize("algorithm", ["ddpg", "td3", "sac"])
def test_what_terminates_is_worth_its_reward(algorithm: str) -> None:
    made = learner(replace(SMALL, algorithm=algorithm))
    batch = made.drawn(streams(made))
    ended = replace(batch, goes_on=torch.zeros_like(batch.goes_on))
    with torch.no_grad():
        assert torch.equal(made._target(ended), batch.rewards)
        assert not torch.equal(made._target(batch), batch.rewards)


def test_densities_are_those_of_a_gaussian_through_tanh() -> None:
    torch.manual_seed(0)
    policy = GaussianPolicy(3, 2, replace(SMALL, algorithm="sac"))
    rows, normals = torch.randn(50, 3), torch.randn(50, 2)
    actions, density = policy.drawn(rows, normals)
    mean, raw = policy.layers(rows).chunk(2, dim=-1)
    deviation = (-5 + 7 * torch.sigmoid(raw)).exp()
    normal = torch.distributions.Normal(mean, deviation)
    one = torch.distributions.TransformedDistribution(
        normal, [torch.distributions.TanhTransform(cache_size=1)]
    )
    assert torch.allclose(actions, torch.tanh(mean + deviation * normals))
    expected = one.log_prob(torch.tanh(mean + deviation * normals).clamp(-0.999999, 0.999999))
    inside = actions.abs().amax(-1) < 0.999
    assert torch.allclose(density[inside], expected.sum(-1)[inside], rtol=1e-3, atol=1e-3)
    assert torch.isfinite(policy.drawn(rows, normals * 100)[1]).all()


class Broken(ActorCritic[GoalConfig]):
    """One network, whose loss is no number."""

    def modules(self) -> dict[str, nn.Module]:
        return {"critic": nn.Linear(1, 1)}

    def losses(self, batch: Batch) -> Iterator[Loss]:
        every = [one.sum() for one in self.parts["critic"].parameters()]
        yield Loss("critic", torch.stack(every).sum() * math.nan)


def test_numbers_that_are_not_finite_are_told_and_do_not_count() -> None:
    made = learner(kind=Broken)
    with pytest.raises(NotFiniteError, match=r"update 1 is not finite \(critic_loss=nan"):
        made.update(0.0, streams(made))
    assert made.updates == 0
    assert made.evidence()["actions"].shape == (16, 1)


class Buffered(Broken):
    def modules(self) -> dict[str, nn.Module]:
        return {"critic": nn.BatchNorm1d(2)}


def test_a_network_with_buffers_is_refused() -> None:
    with pytest.raises(ConfigError, match="the network critic has buffers"):
        learner(kind=Buffered)


def test_weights_come_of_the_seed_and_leave_torch_as_it_was() -> None:
    torch.manual_seed(5)
    expected = torch.rand(1)
    torch.manual_seed(5)
    first, second = learner(), learner()
    assert torch.equal(torch.rand(1), expected)
    assert torch.equal(parts(first)["critic"], parts(second)["critic"])
    other = Goal(SMALL).learner(TASK, 1, "cpu")
    assert not torch.equal(parts(first)["critic"], parts(other)["critic"])


def test_a_run_begins_with_anothers_networks_and_new_optimisers() -> None:
    first, second = learner(), Goal(SMALL).learner(TASK, 1, "cpu")
    first.update(0.0, streams(first))
    second.begin_with(first.state())
    assert torch.equal(parts(first)["actor"], parts(second)["actor"])
    assert second.updates == 0
    slots = [value for name, value in second.state().items() if name.endswith("exp_avg_sq")]
    assert slots
    assert not any(one.any() for one in slots)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"hidden": ()}, "agent.hidden must name at least one"),
        ({"batch_size": 101}, "must not exceed agent.replay_capacity"),
        ({"algorithm": "ddpg", "actor_delay": 3}, "agent.actor_delay=3 changes nothing with"),
    ],
)
def test_settings_that_cannot_work_are_refused(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        replace(SMALL, **changes)


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("mean", np.nan, "damaged weights: the statistics must be finite, with positive scales"),
        ("scale", 0.0, "damaged weights: the statistics must be finite, with positive scales"),
        ("policy.layers.0.weight", np.nan, r"damaged weights: 'layers.0.weight' must hold finite"),
        ("policy.layers.0.weight", 2e6, r"finite numbers up to 1e\+06: take them from another"),
    ],
)
def test_damaged_weights_are_not_played(name: str, value: float, told: str) -> None:
    weights = Goal(SMALL).learner(TASK, 0, "cpu").broadcast()
    with pytest.raises(RunError, match=told):
        Goal(SMALL).actor(TASK).load(weights | {name: np.full_like(weights[name], value)})


class Fading(GoalLearner):
    """What its losses are hangs on how many updates were made."""

    def losses(self, batch: Batch) -> Iterator[Loss]:
        for loss in super().losses(batch):
            yield replace(loss, value=loss.value / (1 + self.updates))


def test_losses_that_change_without_their_batch_are_refused_for_graphs() -> None:
    steady, fading = learner(), learner(kind=Fading)
    for made in (steady, fading):
        made._whole = Whole(made.step, [p for own in made.lists.values() for p in own], False)
    steady.prepare()
    with pytest.raises(ConfigError, match=r"Fading.losses: wanted equal losses.*compiles = False"):
        fading.prepare()


@pytest.mark.parametrize("algorithm", ["ddpg", "td3", "sac"])
def test_drawing_and_an_update_stay_on_their_device(algorithm: str) -> None:
    """On torch's `meta` device, which has no values: see tests/agent/base/test_devices.py."""
    made = learner(replace(SMALL, algorithm=algorithm), device="meta")
    batch = made.drawn(streams(made))
    assert {one.device.type for one in vars(batch).values() if isinstance(one, Tensor)} == {"meta"}
    assert made._whole(batch, made.rates(0.0)).device.type == "meta"
