"""Eqs. 3-6: hand-made targets, goldens, and what must have no effect."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tangram_agent.learner import (
    Learner,
    NotFiniteError,
    average_so_far,
    critic_target,
    polyak_update,
    saturation,
)
from tangram_agent.scenes import Scenes, next_token
from tangram_agent.setup import Setup
from tangram_agent.types import Transitions
from tangram_sim.errors import RunError
from tests.agent.builders import PAIR, PAPER, SCENE, SMALL, random_transitions, setup

pytestmark = pytest.mark.fast

GOLDEN = Path(__file__).parents[1] / "golden" / "ddpg.json"
CASES: dict[str, dict[str, Any]] = {
    "tangram": {"agent": SCENE},
    "paper": {"agent": PAPER, "actions_per_token": 2},
    "mlp": {"agent": PAPER, "net": {"kind": "mlp"}, "actions_per_token": 2},
    "several": {"tokens": PAIR, "agent": SCENE | {"gamma": 0.9}},
}


def weights(learner: Learner) -> dict[str, np.ndarray]:
    return {name: value.copy() for name, value in learner.state().items()}


def largest_change(before: dict[str, np.ndarray], after: dict[str, np.ndarray], part: str) -> float:
    names = [name for name in before if name.startswith(f"{part}.")]
    assert names
    return max(float(np.abs(before[name] - after[name]).max()) for name in names)


def test_the_target_of_eq_5_with_the_end_of_an_episode() -> None:
    reward, done = torch.tensor([1.0, -0.5, 0.25]), torch.tensor([0.0, 1.0, 0.0])
    y = critic_target(reward, done, torch.tensor([2.0, 100.0, -1.0]), gamma=0.5)
    assert y.tolist() == [2.0, -0.5, -0.25]


def test_polyak_averaging_of_eq_4() -> None:
    target, source = torch.nn.Linear(1, 1), torch.nn.Linear(1, 1)
    with torch.no_grad():
        target.weight.fill_(1.0)
        source.weight.fill_(3.0)
    polyak_update(list(target.parameters()), list(source.parameters()), 0.75)
    assert target.weight.item() == pytest.approx(1.5)
    assert source.weight.item() == 3.0


@pytest.mark.parametrize(
    ("rho", "updates", "expected"),
    [(0.99, 0, 0.0), (0.99, 1, 0.1), (0.99, 9, 0.5), (0.99, 891, 0.99), (0.5, 50, 0.5), (0, 9, 0)],
)
def test_a_young_average_forgets_its_start(rho: float, updates: int, expected: float) -> None:
    assert average_so_far(rho, updates) == pytest.approx(expected)


def test_after_the_first_update_the_actor_itself_plays() -> None:
    learner = Learner(setup(agent=SCENE | {"acting_average": 0.99}), seed=0)
    learner.update(random_transitions(setup(), 16, done=None))
    pairs = zip(learner.acting.parameters(), learner.actor.parameters(), strict=True)
    assert all(torch.equal(average, own) for average, own in pairs)


def test_saturation_counts_what_lies_beyond_the_limit() -> None:
    raw = torch.tensor([[0.0, 2.0], [-3.0, 4.0]])
    assert saturation(raw, 2.0).item() == pytest.approx((1 + 4) / 4)


@pytest.mark.parametrize(
    ("placed", "token"), [([0, 0, 0], 0), ([1, 0, 0], 1), ([1, 0, 1], 1), ([1, 1, 1], 0)]
)
def test_the_first_unplaced_token_moves(placed: list[int], token: int) -> None:
    assert next_token(torch.tensor([placed])).tolist() == [token]


def test_the_critic_loss_is_the_mean_squared_bellman_error() -> None:
    """Against the value by hand: y from the target networks, one transition at a time."""
    made = setup(agent={**PAPER, "gamma": 0.9}, actions_per_token=2)
    learner = Learner(made, seed=0)
    for module in (learner.target_actor, learner.target_critic):
        for parameter in module.parameters():
            parameter.mul_(1.5)
    batch = random_transitions(made, 6, done=None)
    assert 0 < batch.done.sum() < 6
    steps, errors = learner.steps(batch), []
    for i in range(6):
        row = learner.steps(Transitions(**{n: c[i : i + 1] for n, c in vars(batch).items()}))
        follow = learner.target_critic(row.follow, learner.target_actor(row.follow)[0])
        y = batch.reward[i] + 0.9 * follow * (1 - int(batch.done[i]))
        q = learner.critic(row.view, torch.from_numpy(batch.action[i : i + 1]))
        errors.append((q - y).item() ** 2)
    loss, _ = learner.critic_loss(steps)
    assert loss.item() == pytest.approx(sum(errors) / 6, rel=1e-5)


def test_the_actor_loss_is_minus_the_value_of_its_actions() -> None:
    made = setup(agent=SCENE)
    learner = Learner(made, seed=0)
    steps = learner.steps(random_transitions(made, 6))
    velocity, raw = learner.actor(steps.start)
    loss, penalty = learner.actor_loss(steps)
    assert loss.item() == pytest.approx(-learner.critic(steps.start, velocity).mean().item(), 1e-6)
    assert penalty.item() == pytest.approx(torch.relu(raw.abs() - 1).square().mean().item())


def test_the_token_that_moved_is_valued_and_the_next_one_is_asked() -> None:
    made = setup(PAIR, agent=SCENE)
    batch = replace(random_transitions(made, 3), placed=np.array([[0, 0], [1, 0], [1, 1]], "u1"))
    batch.action[:, 0] = [0.5, 0.5, -0.5]
    steps = Learner(made, seed=0).steps(batch)
    assert isinstance(steps.view, Scenes)
    assert isinstance(steps.start, Scenes)
    assert steps.view.token.tolist() == [1, 1, 0]
    assert steps.start.token.tolist() == [0, 1, 0]
    assert steps.velocity.shape == (3, 3)


def spoil_targets(learner: Learner) -> None:
    for module in (learner.target_actor, learner.target_critic):
        for parameter in module.parameters():
            parameter.fill_(float("nan"))


@pytest.mark.parametrize(
    ("agent", "actions", "there"),
    [({"gamma": 0.9}, 1, False), ({}, 2, False), ({"gamma": 0.9}, 2, True)],
)
@pytest.mark.parametrize("readout", ["token", "pair"])
def test_target_networks_are_there_where_something_bootstraps(
    agent: dict[str, Any], actions: int, there: bool, readout: str
) -> None:
    made = setup(agent=agent | {"readout": readout}, actions_per_token=actions)
    learner = Learner(made, seed=0)
    assert learner.bootstraps == there
    assert hasattr(learner, "target_actor") == there
    assert any(name.startswith("target_critic.") for name in learner.state()) == there


def test_target_networks_are_not_asked_where_every_transition_ends() -> None:
    made = setup(agent=SCENE | {"gamma": 0.99}, actions_per_token=2)
    plain, spoilt = Learner(made, seed=0), Learner(made, seed=0)
    spoil_targets(spoilt)
    for seed in range(3):
        batch = random_transitions(made, 16, seed)
        plain.update(batch)
        spoilt.update(batch)
    a, b = weights(plain), weights(spoilt)
    for part in ("actor", "critic", "acting"):
        assert largest_change(a, b, part) == 0.0


def test_target_networks_matter_where_an_episode_goes_on() -> None:
    made = setup(agent=SCENE | {"gamma": 0.99}, actions_per_token=2)
    spoilt = Learner(made, seed=0)
    spoil_targets(spoilt)
    with pytest.raises(NotFiniteError, match="update 1 is not finite .critic_loss=nan"):
        spoilt.update(random_transitions(made, 16, done=None))
    assert spoilt.updates == 0


def test_an_update_moves_each_network_and_drags_the_averages() -> None:
    agent = SCENE | {"gamma": 0.9, "polyak": 0.9, "acting_average": 0.5}
    made = setup(agent=agent, actions_per_token=2)
    learner = Learner(made, seed=0)
    learner.updates = 1000  # the acting average is no longer young
    before = weights(learner)
    learner.update(random_transitions(made, 16, done=None))
    after = weights(learner)
    for part in ("actor", "critic"):
        moved = largest_change(before, after, part)
        assert moved > 1e-4
        assert largest_change(before, after, f"target_{part}") == pytest.approx(0.1 * moved, 1e-3)
    acting = largest_change(before, after, "acting")
    assert acting == pytest.approx(0.5 * largest_change(before, after, "actor"), 1e-3)
    assert learner.updates == after["updates"][0] == 1001


def test_the_actor_step_leaves_the_critic_alone() -> None:
    """The critic's own step uses the critic's loss only: spoil the actor, the critic agrees."""
    made = setup(agent=SCENE)
    plain, spoilt = Learner(made, seed=0), Learner(made, seed=0)
    with torch.no_grad():
        for parameter in spoilt.actor.parameters():
            parameter.mul_(-3.0)
    batch = random_transitions(made, 16)
    plain.update(batch)
    spoilt.update(batch)
    assert largest_change(weights(plain), weights(spoilt), "critic") == 0.0


@pytest.mark.parametrize("readout", ["token", "pair"])
def test_the_penalty_counts_by_its_weight(readout: str) -> None:
    """Where the value is flat, the actor's gradient is that of the penalty: twice the weight."""
    norms = []
    for weight in (0.5, 1.0):
        agent = {"readout": readout, "saturation_penalty": weight, "saturation_limit": 0.0}
        made = setup(agent=agent)
        learner = Learner(made, seed=0)
        with torch.no_grad():
            learner.critic.head.readout.weight.zero_()
        batch = learner.prepared(random_transitions(made, 16), np.random.default_rng(0))
        steps = learner.steps(batch)
        norms.append(learner._actor_step(steps, None)["actor_gradient"].item())
    assert norms[1] == pytest.approx(2.0 * norms[0], rel=1e-5)
    assert norms[0] > 0.0


def test_the_penalty_pulls_a_saturated_actor_back() -> None:
    made = setup(agent=SCENE | {"squash": "tanh", "angle_head": "plain"})
    learner = Learner(made, seed=0)
    with torch.no_grad():
        learner.actor.head.readout.bias.fill_(6.0)
    batch = random_transitions(made, 32)
    first = learner.update(batch)["saturation"]
    for _ in range(60):
        last = learner.update(batch)["saturation"]
    assert first > 1.0
    assert last < 0.5 * first


@pytest.mark.parametrize(
    ("progress", "share"), [(0.0, 1.0), (0.5, 0.505), (1.0, 0.01), (2.0, 0.01), (-1.0, 1.0)]
)
def test_cosine_decay_of_the_learning_rate(progress: float, share: float) -> None:
    learner = Learner(setup(agent=SCENE | {"actor_lr": 2e-3}), seed=0)
    learner.update(random_transitions(setup(), 4), progress)
    assert learner.actor_optimiser.param_groups[0]["lr"] == pytest.approx(2e-3 * share)
    assert learner.critic_optimiser.param_groups[0]["lr"] == pytest.approx(1e-3 * share)


def test_without_decay_the_learning_rate_stays() -> None:
    learner = Learner(setup(agent=SCENE | {"lr_decay": "none"}), seed=0)
    learner.update(random_transitions(setup(), 4), 0.9)
    assert learner.actor_optimiser.param_groups[0]["lr"] == 1e-3


def test_gradients_are_clipped_to_the_norm() -> None:
    made = setup(agent=SCENE | {"grad_clip": 1e-3})
    learner = Learner(made, seed=0)
    learner.update(random_transitions(made, 16))
    norms = [p.grad.norm() for p in learner.critic.parameters() if p.grad is not None]
    assert torch.stack(norms).norm().item() == pytest.approx(1e-3, rel=1e-2)


@pytest.mark.parametrize("case", CASES)
def test_a_restored_learner_goes_on_bit_for_bit(case: str) -> None:
    made = setup(**CASES[case])
    first, second = Learner(made, seed=0), Learner(made, seed=9)
    for seed in range(2):
        first.update(random_transitions(made, 8, seed, done=None), 0.1)
    second.load_state(weights(first))
    for seed in range(2, 4):
        batch = random_transitions(made, 8, seed, done=None)
        assert first.update(batch, 0.2) == second.update(batch, 0.2)
    a, b = weights(first), weights(second)
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name])


@pytest.mark.parametrize(
    ("other", "reason"),
    [
        ({"tokens": PAIR, "agent": SCENE}, None),  # attention serves any token set: its weights fit
        ({"net": {"kind": "mlp"}, "agent": SCENE}, "on one side only"),
        ({"net": {**SMALL, "width": 32}, "agent": SCENE}, "weights of another layout"),
        ({"agent": SCENE | {"offsets": False}}, "weights of another layout"),
    ],
)
def test_weights_of_another_network_are_refused(other: dict[str, Any], reason: str | None) -> None:
    state = weights(Learner(setup(agent=SCENE), seed=0))
    learner = Learner(setup(**other), seed=0)
    if reason is None:
        learner.load_state(state)
    else:
        with pytest.raises(RunError, match=reason):
            learner.load_state(state)


def test_a_state_that_is_no_learners_is_refused() -> None:
    with pytest.raises(RunError, match="not a learner's checkpoint"):
        Learner(setup(), seed=0).load_state({})


def golden(made: Setup) -> dict[str, float]:
    """Losses of the first two updates, and sums over the weights after them."""
    learner = Learner(made, seed=1)
    result = {}
    for i in range(2):
        metrics = learner.update(random_transitions(made, 32, i, done=None), 0.25)
        result |= {f"{name}_{i}": value for name, value in metrics.items()}
    state = learner.state()
    for part in learner.parts:
        values = [v.astype(np.float64) for k, v in state.items() if k.startswith(f"{part}.")]
        result[f"{part}_abs_sum"] = float(sum(np.abs(v).sum() for v in values))
    return result


@pytest.mark.parametrize("case", CASES)
def test_golden_values_of_two_updates(case: str) -> None:
    """Rewrite them with `python -m tests.agent.test_learner` when a change is meant."""
    expected = json.loads(GOLDEN.read_text())[case]
    assert golden(setup(**CASES[case])) == pytest.approx(expected, rel=1e-3, abs=1e-5)


if __name__ == "__main__":
    values = {case: golden(setup(**options)) for case, options in CASES.items()}
    GOLDEN.write_text(json.dumps(values, indent=1) + "\n")
