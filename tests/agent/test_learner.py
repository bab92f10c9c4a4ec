"""Eqs. 3-6: hand-made targets, goldens, and what must have no effect."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tangram_agent.ddpg import (
    Learner,
    NotFiniteError,
    average_so_far,
    critic_target,
    next_token,
    polyak_update,
    saturation,
    split_action,
)

from tangram_agent.setup import Setup
from tangram_agent.types import Transitions
from tangram_sim.errors import RunError
from tests.agent.builders import PAIR, PAPER, SMALL, random_transitions, setup

pytestmark = pytest.mark.fast

GOLDEN = Path(__file__).parents[1] / "golden" / "ddpg.json"
CASES: dict[str, dict[str, Any]] = {
    "tangram": {"agent": {}},
    "paper": {"agent": PAPER},
    "mlp": {"agent": PAPER, "net": {"kind": "mlp"}},
    "pair": {"tokens": PAIR, "agent": {"gamma": 0.9}},
}


def tensors(learner: Learner, batch: Transitions) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(np.asarray(c, "f4")) for name, c in vars(batch).items()}


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
    learner = Learner(setup(agent={"acting_average": 0.99}), seed=0)
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


@pytest.mark.parametrize(
    ("selector", "token"), [(-1.0, 0), (-0.34, 0), (-0.3, 1), (0.3, 1), (0.34, 2), (1.0, 2)]
)
def test_the_first_entry_of_an_action_names_the_token(selector: float, token: int) -> None:
    action = torch.tensor([[selector, 0.1, 0.2, 0.3]])
    found, velocity = split_action(action, 3)
    assert found.tolist() == [token]
    assert velocity.tolist() == action[:, 1:].tolist()


def test_the_entry_that_turns_a_token_over_is_no_velocity() -> None:
    """Tokens turned over: an entry between the token's and the velocity."""
    found, velocity = split_action(torch.tensor([[0.9, 1.0, 0.1, 0.2, 0.3]]), 2)
    assert found.tolist() == [1]
    assert velocity[0].tolist() == pytest.approx([0.1, 0.2, 0.3])
    assert split_action(torch.tensor([[1.0, 0.1, 0.2, 0.3]]), 1)[1].shape == (1, 3)


def test_the_critic_loss_is_the_mean_squared_bellman_error() -> None:
    """Against the value by hand: y from the target networks, one transition at a time."""
    made = setup(agent={**PAPER, "gamma": 0.9}, actions_per_token=2)
    learner = Learner(made, seed=0)
    for module in (learner.target_actor, learner.target_critic):
        for parameter in module.parameters():
            parameter.mul_(1.5)
    batch = random_transitions(made, 6, done=None)
    assert 0 < batch.done.sum() < 6
    t = tensors(learner, batch)
    token, errors = torch.zeros(1, dtype=torch.long), []
    for i in range(6):
        row = {name: column[i : i + 1] for name, column in t.items()}
        after = (row["next_state"], row["next_placed"], row["goal"], token)
        follow = learner.target_critic(*after, learner.target_actor(*after)[0])
        y = row["reward"] + 0.9 * follow * (1 - row["done"])
        q = learner.critic(row["state"], row["placed"], row["goal"], token, row["action"])
        errors.append((q - y).item() ** 2)
    loss, _ = learner.critic_loss(t)
    assert loss.item() == pytest.approx(sum(errors) / 6, rel=1e-5)


def test_the_actor_loss_is_minus_the_value_of_its_actions() -> None:
    learner = Learner(setup(), seed=0)
    t = tensors(learner, random_transitions(setup(), 6))
    token = torch.zeros(6, dtype=torch.long)
    velocity, raw = learner.actor(t["state"], t["placed"], t["goal"], token)
    value = learner.critic(t["state"], t["placed"], t["goal"], token, velocity)
    loss, penalty = learner.actor_loss(t)
    assert loss.item() == pytest.approx(-value.mean().item(), rel=1e-6)
    assert penalty.item() == pytest.approx(torch.relu(raw.abs() - 2).square().mean().item())


def spoil_targets(learner: Learner) -> None:
    for module in (learner.target_actor, learner.target_critic):
        for parameter in module.parameters():
            parameter.fill_(float("nan"))


def test_target_networks_have_no_effect_where_every_transition_ends() -> None:
    made = setup(agent={"gamma": 0.99})
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
    made = setup(agent={"gamma": 0.99})
    spoilt = Learner(made, seed=0)
    spoil_targets(spoilt)
    with pytest.raises(NotFiniteError, match="update 1 is not finite .critic_loss=nan"):
        spoilt.update(random_transitions(made, 16, done=None))
    assert spoilt.updates == 0


def test_an_update_moves_each_network_and_drags_the_averages() -> None:
    made = setup(agent={"gamma": 0.9, "polyak": 0.9, "acting_average": 0.5})
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
    made = setup()
    plain, spoilt = Learner(made, seed=0), Learner(made, seed=0)
    with torch.no_grad():
        for parameter in spoilt.actor.parameters():
            parameter.mul_(-3.0)
    batch = random_transitions(made, 16)
    plain.update(batch)
    spoilt.update(batch)
    assert largest_change(weights(plain), weights(spoilt), "critic") == 0.0


def test_the_penalty_pulls_a_saturated_actor_back() -> None:
    made = setup(agent={"saturation_penalty": 1.0, "squash": "tanh", "angle_head": "plain"})
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
    learner = Learner(setup(agent={"lr_decay": "cosine", "actor_lr": 2e-3}), seed=0)
    learner.update(random_transitions(setup(), 4), progress)
    assert learner.actor_optimiser.param_groups[0]["lr"] == pytest.approx(2e-3 * share)
    assert learner.critic_optimiser.param_groups[0]["lr"] == pytest.approx(1e-3 * share)


def test_without_decay_the_learning_rate_stays() -> None:
    learner = Learner(setup(agent={"lr_decay": "none"}), seed=0)
    learner.update(random_transitions(setup(), 4), 0.9)
    assert learner.actor_optimiser.param_groups[0]["lr"] == 1e-3


def test_gradients_are_clipped_to_the_norm() -> None:
    made = setup(agent={"grad_clip": 1e-3})
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
        ({"tokens": PAIR}, None),  # attention serves any token set: its weights fit
        ({"net": {"kind": "mlp"}}, "on one side only"),
        ({"net": {**SMALL, "width": 32}}, "weights of another layout"),
        ({"agent": {"offsets": False}}, "weights of another layout"),
    ],
)
def test_weights_of_another_network_are_refused(other: dict[str, Any], reason: str | None) -> None:
    state = weights(Learner(setup(), seed=0))
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
    for part in ("actor", "critic", "target_actor", "target_critic", "acting"):
        values = [v.astype(np.float64) for k, v in state.items() if k.startswith(f"{part}.")]
        result[f"{part}_abs_sum"] = float(sum(np.abs(v).sum() for v in values))
    return result


@pytest.mark.parametrize("case", CASES)
def test_golden_values_of_two_updates(case: str) -> None:
    """Rewrite them with `python -m tests.agent.test_ddpg` when a change is meant."""
    expected = json.loads(GOLDEN.read_text())[case]
    assert golden(setup(**CASES[case])) == pytest.approx(expected, rel=1e-3, abs=1e-5)


if __name__ == "__main__":
    values = {case: golden(setup(**options)) for case, options in CASES.items()}
    GOLDEN.write_text(json.dumps(values, indent=1) + "\n")
