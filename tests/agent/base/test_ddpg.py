"""Eqs. 3-6 on scenes and pairs: hand-made targets, goldens, and what must have no effect."""

import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tangram_agent.agents.scene.scenes import Scenes, next_token
from tangram_agent.base.adam import Adam
from tangram_agent.base.ddpg import Ddpg
from tangram_agent.base.learning import Rates, polyak_update
from tangram_core.agent import NotFiniteError
from tangram_core.errors import RunError
from tangram_core.setup import Setup
from tests.agent.agents.pair.pair_scenes import PERCEPTRON, TWO, seven, transitions
from tests.agent.builders import (
    PAIR,
    PAPER,
    SCENE,
    SMALL,
    learn,
    learner_of,
    random_transitions,
    setup,
)

pytestmark = pytest.mark.fast

GOLDEN = Path(__file__).parents[2] / "golden"
TARGETS = ("target_actor", "target_critic")
MLP = {"kind": "mlp"}
NEAR = {"strategy": "near", "position": 0.1, "angle": 0.5}
TWINS = {"hindsight": [{"strategy": "final"}, NEAR]}
# File of golden values, and name there -> setup.
CASES: dict[tuple[str, str], Callable[[], Setup]] = {
    ("ddpg", "tangram"): lambda: setup(agent=SCENE),
    ("ddpg", "paper"): lambda: setup(agent=PAPER, actions_per_token=2),
    ("ddpg", "mlp"): lambda: setup(agent=PAPER, net=MLP, actions_per_token=2),
    ("ddpg", "several"): lambda: setup(PAIR, SCENE | {"gamma": 0.9}),
    ("pairs", "mha"): lambda: seven(TWINS),
    ("pairs", "mlp"): lambda: seven(TWINS, PERCEPTRON),
}


def play(learner: Ddpg, made: Setup, seeds: range, progress: float = 0.25) -> list[Any]:
    """Updates on what the seeds draw."""
    numbers = []
    for seed in seeds:
        drawn = (
            transitions(made, 16, seed)
            if (made.agent_kind == "pair")
            else random_transitions(made, 32, seed, done=None)
        )
        numbers.append(learn(learner, drawn, progress, seed))
    return numbers


def changed(one: dict[str, Any], other: dict[str, Any]) -> set[str]:
    """The parts of a state in which two differ."""
    return {name.split(".")[0] for name in one if not np.array_equal(one[name], other[name])}


def scaled(learner: Ddpg, parts: Iterable[str], factor: float) -> Ddpg:
    """The learner with every weight of some parts multiplied."""
    with torch.no_grad():
        for part in parts:
            for parameter in learner.parts[part].parameters():
                parameter.mul_(factor)
    return learner


def copied(learner: Ddpg) -> dict[str, Any]:
    return {name: value.copy() for name, value in learner.state().items()}


def largest_change(before: dict[str, Any], after: dict[str, Any], part: str) -> float:
    names = [name for name in before if name.startswith(f"{part}.")]
    return max(float(np.abs(before[name] - after[name]).max()) for name in names)


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
    learner = learner_of(setup(agent=SCENE | {"acting_average": rho}))
    learner.updates = updates
    assert learner.rates(0.0).kept == pytest.approx(expected)


def test_after_the_first_update_the_actor_itself_plays() -> None:
    learner = learner_of(setup(agent=SCENE | {"acting_average": 0.99}))
    learn(learner, random_transitions(setup(), 16, done=None))
    pairs = zip(learner.acting.parameters(), learner.actor.parameters(), strict=True)
    assert all(torch.equal(average, own) for average, own in pairs)


@pytest.mark.parametrize(
    ("placed", "token"), [([0, 0, 0], 0), ([1, 0, 0], 1), ([1, 0, 1], 1), ([1, 1, 1], 0)]
)
def test_the_first_unplaced_token_moves(placed: list[int], token: int) -> None:
    assert next_token(torch.tensor([placed])).tolist() == [token]


@pytest.mark.parametrize("agent", [PAPER, {"kind": "pair"}])
def test_the_critic_loss_is_the_mean_squared_bellman_error(agent: dict[str, Any]) -> None:
    """Against the value by hand: y from the target networks, 0 after the end."""
    made = setup(agent=agent | {"gamma": 0.9}, actions_per_token=2)
    learner = scaled(learner_of(made), TARGETS, 1.5)
    batch = random_transitions(made, 6, done=None)
    assert 0 < batch.done.sum() < 6
    steps = learner.steps(batch, np.random.default_rng(0))
    assert steps.follow is not None
    actor, critic = learner.targets["actor"], learner.targets["critic"]
    follow = critic(steps.follow, actor(steps.follow)[0])
    y = torch.from_numpy(batch.reward) + 0.9 * follow * (1 - torch.from_numpy(batch.done))
    q = learner.critic(steps.view, steps.velocity, steps.seen_after)
    loss = next(learner.losses(steps))
    assert loss.value.item() == pytest.approx((q - y).square().mean().item(), rel=1e-5)
    assert loss.told["q"].item() == pytest.approx(q.mean().item(), rel=1e-5)
    if made.agent_kind != "pair":  # those move their tokens on before they are valued
        torch.testing.assert_close(q, learner.critic(steps.view, torch.from_numpy(batch.action)))


def test_the_actor_loss_is_minus_the_value_of_its_actions() -> None:
    made = setup(agent=SCENE)
    learner = learner_of(made)
    steps = learner.steps(random_transitions(made, 6), np.random.default_rng(0))
    velocity, raw = learner.actor(steps.start)
    _, loss = learner.losses(steps)
    value, penalty = loss.told["actor_loss"], loss.told["saturation"]
    assert value.item() == pytest.approx(-learner.critic(steps.start, velocity).mean().item(), 1e-6)
    assert penalty.item() == pytest.approx(raw.square().mean().item())
    assert loss.value.item() == pytest.approx((value + penalty).item())


def test_the_token_that_moved_is_valued_and_the_next_one_is_asked() -> None:
    made = setup(PAIR, agent=SCENE)
    batch = replace(random_transitions(made, 3), placed=np.array([[0, 0], [1, 0], [1, 1]], "u1"))
    batch.action[:, 0] = [0.5, 0.5, -0.5]
    steps = learner_of(made).steps(batch, np.random.default_rng(0))
    assert isinstance(steps.view, Scenes)
    assert isinstance(steps.start, Scenes)
    assert steps.view.token.tolist() == [1, 1, 0]
    assert steps.start.token.tolist() == [0, 1, 0]
    assert steps.velocity.shape == (3, 3)


@pytest.mark.parametrize(
    ("agent", "actions", "there"),
    [({"gamma": 0.9}, 1, False), ({}, 2, False), ({"gamma": 0.9}, 2, True)],
)
@pytest.mark.parametrize("kind", ["scene", "pair"])
def test_target_networks_are_there_where_something_bootstraps(
    agent: dict[str, Any], actions: int, there: bool, kind: str
) -> None:
    made = setup(agent=agent | {"kind": kind}, actions_per_token=actions)
    learner = learner_of(made)
    assert learner.bootstraps == there
    assert ("actor" in learner.targets) == there
    assert any(name.startswith("target_critic.") for name in learner.state()) == there


def test_target_networks_matter_just_where_an_episode_goes_on() -> None:
    made = setup(agent=SCENE | {"gamma": 0.99}, actions_per_token=2)
    plain = learner_of(made)
    spoilt = scaled(learner_of(made), TARGETS, float("nan"))
    for seed in range(3):
        for learner in (plain, spoilt):
            learn(learner, random_transitions(made, 16, seed))
    assert changed(plain.state(), spoilt.state()) == set(TARGETS)
    with pytest.raises(NotFiniteError, match="update 4 is not finite .critic_loss=nan"):
        learn(spoilt, random_transitions(made, 16, done=None))
    assert spoilt.updates == 3


def test_an_update_moves_each_network_and_drags_the_averages() -> None:
    agent = SCENE | {"gamma": 0.9, "polyak": 0.9, "acting_average": 0.5}
    made = setup(agent=agent, actions_per_token=2)
    learner = learner_of(made)
    learner.updates = 1000  # the acting average is no longer young
    before = copied(learner)
    play(learner, made, range(1))
    after = learner.state()
    for part in ("actor", "critic"):
        moved = largest_change(before, after, part)
        assert moved > 1e-4
        assert largest_change(before, after, f"target_{part}") == pytest.approx(0.1 * moved, 1e-3)
    acting = largest_change(before, after, "acting")
    assert acting == pytest.approx(0.5 * largest_change(before, after, "actor"), 1e-3)
    assert learner.updates == after["updates"][0] == 1001


def test_the_actor_moves_in_one_of_so_many_updates() -> None:
    made = setup(agent=SCENE | {"actor_delay": 3})
    learner, moved = learner_of(made), list[bool]()
    for number in range(6):
        before = copied(learner)
        play(learner, made, [number])
        moved.append("actor" in changed(before, learner.state()))
    assert moved == [False, False, True] * 2


@pytest.mark.parametrize("case", [("ddpg", "tangram"), ("pairs", "mlp")])
def test_the_actor_step_leaves_the_critic_alone(case: tuple[str, str]) -> None:
    """The critic's own step uses the critic's loss only: spoil the actor, the critic agrees."""
    made = CASES[case]()
    plain, spoilt = learner_of(made), scaled(learner_of(made), ["actor"], -3.0)
    for learner in (plain, spoilt):
        play(learner, made, range(2))
    parts = changed(plain.state(), spoilt.state())
    assert "actor" in parts
    assert not {"critic", "critic_optimiser"} & parts


def test_the_penalty_counts_by_its_weight() -> None:
    """Where the value is flat, the actor's gradient is that of the penalty: twice the weight."""
    norms = []
    for weight in (0.5, 1.0):
        made = setup(agent={"kind": "scene", "saturation_penalty": weight})
        learner = learner_of(made)
        with torch.no_grad():
            learner.critic.head.readout.weight.zero_()
        steps = learner.steps(random_transitions(made, 16), np.random.default_rng(0))
        numbers = learner.step(steps, Rates(0.0, 0.0, 0.0)).tolist()
        norms.append(numbers[learner.names[True].index("actor_gradient")])
    assert norms[1] == pytest.approx(2.0 * norms[0], rel=1e-5)
    assert norms[0] > 0.0


DECAY = {0.0: 1.0, 0.5: 0.505, 1.0: 0.01, 2.0: 0.01, -1.0: 1.0}
UNDECAYED = {"lr_final": 1.0}


@pytest.mark.parametrize(
    ("options", "progress", "share"),
    [*(({}, progress, share) for progress, share in DECAY.items()), (UNDECAYED, 0.9, 1.0)],
)
def test_cosine_decay_of_the_learning_rate(
    options: dict[str, Any], progress: float, share: float
) -> None:
    learner = learner_of(setup(agent=SCENE | {"actor_lr": 2e-3} | options))
    rates = learner.rates(progress)
    assert (rates.actor, rates.critic) == pytest.approx((2e-3 * share, 1e-3 * share))


def test_networks_step_by_their_own_rates() -> None:
    """The first step of Adam is as long as its rate."""
    learner = learner_of(setup(agent=SCENE | {"actor_lr": 2e-3, "critic_lr": 5e-4}))
    before = copied(learner)
    learn(learner, random_transitions(setup(), 16), 0.5)
    for part, rate in (("actor", 2e-3 * 0.505), ("critic", 5e-4 * 0.505)):
        assert largest_change(before, learner.state(), part) == pytest.approx(rate, rel=1e-3)


def test_steps_are_those_of_torch() -> None:
    """Also along gradients that lie in memory otherwise than their parameters."""
    generator = torch.Generator().manual_seed(0)
    start = [torch.randn(shape, generator=generator) for shape in ((3, 2), (5,))]
    ours, theirs = ([one.clone().requires_grad_() for one in start] for _ in range(2))
    told = [one.clone() for one in start]
    traced, optimiser = Adam(told), Adam(ours)
    judge = torch.optim.Adam(theirs, lr=0.1, fused=True)
    for _ in range(5):
        slopes = [torch.randn(one.shape, generator=generator) for one in start]
        for other, slope in zip(theirs, slopes, strict=True):
            other.grad = slope.clone()
        judge.step()
        optimiser.step([one.mT.contiguous().mT if one.ndim > 1 else one for one in slopes], 0.1)
        traced.step(slopes, torch.tensor(0.1))
    for mine, other, one in zip(ours, theirs, told, strict=True):
        assert torch.equal(mine, other)
        torch.testing.assert_close(one, other.detach(), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("case", CASES)
def test_a_restored_learner_goes_on_bit_for_bit(case: tuple[str, str]) -> None:
    made = CASES[case]()
    first, again, second = (learner_of(made, seed) for seed in (0, 0, 9))
    assert changed(first.state(), again.state()) == set()
    assert {"actor", "critic"} <= changed(first.state(), second.state())
    play(first, made, range(2), 0.1)
    second.load_state(copied(first))
    assert play(first, made, range(2, 4)) == play(second, made, range(2, 4))
    assert first.state().keys() == second.state().keys()
    assert changed(first.state(), second.state()) == set()


@pytest.mark.parametrize(
    ("made", "other", "reason"),
    [
        (setup(agent=SCENE), setup(agent=SCENE, net=MLP), "on one side only"),
        (setup(agent=SCENE), setup(agent=SCENE, net={**SMALL, "width": 32}), "of another layout"),
        (seven(TWINS, PERCEPTRON), seven(TWINS), "weights of another"),
        (seven(TWINS, PERCEPTRON), seven(TWINS, MLP | {"hidden": [8]}), "weights of another"),
        (seven(TWINS, PERCEPTRON), seven(SCENE, PERCEPTRON), "weights of another"),
    ],
)
def test_weights_of_another_network_are_refused(made: Setup, other: Setup, reason: str) -> None:
    with pytest.raises(RunError, match=reason):
        learner_of(other).load_state(learner_of(made).state())
    with pytest.raises(RunError, match="has no number of updates"):
        learner_of(made).load_state({})


@pytest.mark.parametrize("name", ["exp_avg", "exp_avg_sq", "step"])
def test_averages_of_another_optimiser_are_refused(name: str) -> None:
    made = CASES[next(iter(CASES))]()
    learner = learner_of(made)
    play(learner, made, range(1), 0.1)
    key = f"actor_optimiser.0.{name}"
    whole = copied(learner)
    wrong = {key: np.zeros(5, np.float32)}
    for state in (whole | wrong, {k: v for k, v in whole.items() if k != key}):
        with pytest.raises(RunError, match="averages belong to another network: start a new"):
            learner_of(made).load_state(state)


@pytest.mark.parametrize(
    ("made", "other"),
    [
        (setup(agent=SCENE), setup(PAIR, SCENE)),  # attention serves any token set
        (setup(TWO, TWINS), seven(TWINS)),
        (setup(TWO, TWINS, PERCEPTRON), seven(TWINS, PERCEPTRON)),  # with as many corners
    ],
)
def test_one_network_serves_other_sets_of_tokens(made: Setup, other: Setup) -> None:
    learner = learner_of(other, 0)
    learner.load_state(learner_of(made, 1).state())
    assert "actor" not in changed(learner.state(), learner_of(made, 1).state())


def golden(made: Setup) -> dict[str, float]:
    """Losses of the first two updates, and sums over the weights after them."""
    learner = learner_of(made, seed=1)
    numbers = play(learner, made, range(2))
    result = {f"{name}_{i}": v for i, one in enumerate(numbers) for name, v in one.items()}
    state = learner.state()
    for part in learner.parts:
        values = [v.astype(np.float64) for k, v in state.items() if k.startswith(f"{part}.")]
        result[f"{part}_abs_sum"] = float(sum(np.abs(v).sum() for v in values))
    return result


# Processors add in different orders. A sum of n products is off by n roundings at most: of 64 x 64
# where a layer meets its gradient, in each of two updates; and of 64 where it all but cancels out.
ROUNDING = float(np.finfo(np.float32).eps)


@pytest.mark.parametrize("case", CASES)
def test_golden_values_of_two_updates(case: tuple[str, str]) -> None:
    """Rewrite them with `python -m tests.agent.base.test_ddpg` when a change is meant."""
    expected = json.loads((GOLDEN / f"{case[0]}.json").read_text())[case[1]]
    near = pytest.approx(expected, rel=2 * 64 * 64 * ROUNDING, abs=64 * ROUNDING)
    assert golden(CASES[case]()) == near


if __name__ == "__main__":
    for name in {file for file, _ in CASES}:
        found = {case: golden(made()) for (file, case), made in CASES.items() if file == name}
        (GOLDEN / f"{name}.json").write_text(json.dumps(found, indent=1) + "\n")
