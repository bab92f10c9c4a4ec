"""Learning from pairs: losses by hand, what gradients reach, and that it learns."""

from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tangram_agent.learner import Learner
from tangram_agent.pairs import Pairs
from tangram_agent.policy import Policy
from tangram_agent.relabelling import PairBatch, SceneBatch
from tangram_agent.setup import Setup
from tangram_agent.types import Transitions
from tangram_sim.batch import BatchedEnv
from tangram_sim.geometry import overlap_share
from tangram_sim.rewards import scaled_overlap
from tangram_sim.targets import sample_targets
from tests.agent.builders import setup
from tests.agent.pair_scenes import (
    PERCEPTRON,
    TWO,
    PerfectCritic,
    random_pairs,
    seven,
    transitions,
)

pytestmark = pytest.mark.fast

TWINS = [{"strategy": "final"}, {"strategy": "near", "position": 0.1, "angle": 0.5}]
AGENT = {"hindsight": TWINS, "pairs_per_transition": 4}
UPDATES = 120
CASES: dict[str, dict[str, Any]] = {
    "mha": {"agent": AGENT},
    "mlp": {"agent": AGENT, "net": PERCEPTRON},
}


def updated(learner: Learner, made: Setup) -> Learner:
    """After one update."""
    learner.update(learner.prepared(transitions(made, 16, 0), np.random.default_rng(0)), 0.25)
    return learner


@pytest.mark.parametrize("case", CASES)
def test_the_losses_by_hand(case: str) -> None:
    """Before the first update the acting networks are the learner's own."""
    made = seven(**CASES[case])
    learner = Learner(made, 0)
    batch = learner.prepared(transitions(made, 8, 0), np.random.default_rng(0))
    assert isinstance(batch, PairBatch)
    t = {name: torch.from_numpy(np.asarray(c, np.float32)) for name, c in vars(batch).items()}
    for name in ("token", "piece"):
        t[name] = t[name].long()
    steps, own, still = learner.steps(batch), learner.acting, torch.zeros(32, 3)

    def pairs_of(when: str) -> Pairs:
        columns = ("token", "goal", "goal_flipped", "piece", "covered")
        return Pairs(t[when], t[f"{when}_flipped"], *(t[name] for name in columns))

    value = own.critic(pairs_of("after"), still)
    loss, q = learner.critic_loss(steps)
    expected = (value - t["reward"]).square().mean().item()
    assert loss.item() == pytest.approx(expected, rel=1e-6)
    np.testing.assert_allclose(q.detach(), value, atol=1e-6)
    start = pairs_of("start")
    velocity, raw = own.actor(start)
    gain, penalty = learner.actor_loss(steps)
    assert gain.item() == pytest.approx(-own.critic(start, velocity).mean().item(), rel=1e-5)
    assert penalty.item() == pytest.approx(torch.relu(raw.abs() - 1.0).square().mean().item())


def test_with_several_tokens_nothing_is_bootstrapped() -> None:
    learner = Learner(seven(**CASES["mlp"]), 0)
    assert not learner.bootstraps
    assert set(learner.parts) == {"actor", "critic", "acting"}


def test_what_plays_is_the_average_of_both_networks() -> None:
    made = seven(AGENT | {"acting_average": 0.5}, PERCEPTRON)
    learner = Learner(made, 0)
    learner.updates = 1000  # the average is no longer young
    before = learner.acting_weights(0).tensors
    updated(learner, made)
    after = learner.acting_weights(1).tensors
    own = learner.state()
    assert {name.split(".")[0] for name in after} == {"actor", "critic"}
    for name, average in after.items():
        np.testing.assert_allclose(average, (before[name] + own[name]) / 2.0, atol=1e-6)


def beside(made: Setup, count: int, seed: int, each: float = 0.0) -> Transitions:
    """Scenes with each token near its piece, and what the environment gives for them.

    All are shifted together, so that they lie apart, and each is moved by up to so much more.
    """
    rng = np.random.default_rng(seed)
    rngs = [np.random.default_rng([seed, i]) for i in range(count)]
    poses, sides = sample_targets(made.layout, made.sim, made.sim.task, rngs)
    goals = made.layout.corners(poses, sides)
    corners = made.layout.corners(poses + each * rng.uniform(-1, 1, poses.shape), sides)
    corners += rng.uniform(-0.2, 0.2, (count, 1, 2))
    reward = scaled_overlap(overlap_share(corners, goals, made.layout))
    return replace(
        transitions(made, count, seed),
        next_state=corners.astype(np.float32),
        goal=goals.astype(np.float32),
        reward=reward.astype(np.float32),
    )


def test_a_reward_is_the_sum_over_all_pairs() -> None:
    """By a critic that knows the geometry, whatever turns that look alike the pieces have."""
    made = seven(AGENT | {"credit": "reward"}, PERCEPTRON, mirrored=0.5)
    learner, batch = Learner(made, 0), beside(made, 8, 0)
    scenes = learner.prepared(batch, np.random.default_rng(0))
    assert isinstance(scenes, SceneBatch)
    assert not np.allclose(scenes.goals[..., 2], made.layout.poses(batch.goal)[..., 2])
    learner.critic = PerfectCritic(made.layout)
    steps = learner.steps(scenes)
    assert steps.scenes is not None
    loss, share = learner.scene_loss(steps.scenes)
    assert loss.item() < 1e-9
    np.testing.assert_allclose(2.0 * share - 1.0, batch.reward, atol=1e-5)
    assert np.ptp(batch.reward) > 0.2


def test_of_a_covered_piece_nothing_is_left_where_scenes_teach() -> None:
    critic = Learner(seven(AGENT | {"credit": "reward"}, PERCEPTRON), 0).critic
    pairs = replace(random_pairs(seven().layout, 0), covered=torch.ones(49))
    assert not critic(pairs, torch.zeros(49, 3), pairs).any()
    pairs = replace(pairs, covered=torch.zeros(49))
    assert critic(pairs, torch.zeros(49, 3), pairs).all()


def test_noise_on_the_corners_does_no_harm() -> None:
    made = seven(**CASES["mlp"])
    learner, batch = Learner(made, 0), transitions(made, 64)
    rng = np.random.default_rng(0)
    names = ("state", "next_state", "goal")
    noise = {name: 0.2 * rng.standard_normal(batch.state.shape) for name in names}
    noisy = {name: (vars(batch)[name] + noise[name]).astype(np.float32) for name in names}
    pairs = learner.prepared(replace(batch, **noisy), rng)
    for share in (pairs.covered, pairs.reward):
        assert 0.0 <= share.min() < share.max() <= 1.0
    learner.update(pairs)


def coverage(learner: Learner, made: Setup, episodes: int) -> float:
    """Mean overlap of episodes that the acting weights play."""
    policy = Policy(made)
    policy.load(learner.acting_weights(0))
    with closing(BatchedEnv(made.layout, made.sim, made.reward, episodes)) as env:
        env.reset([np.random.default_rng([1, i]) for i in range(episodes)])
        for _ in range(env.horizon):
            actions = policy.act(env.corners, env.placed, env.goals)
            result = env.step(actions.astype(np.float64))
    return float(result.overlap.mean())


@pytest.mark.parametrize("credit", ["piece", "reward"])
def test_it_learns_to_assemble_two_tokens(credit: str) -> None:
    """From random scenes and hindsight alone; without learning next to nothing is covered."""
    agent = {
        "hindsight": [*TWINS, {"strategy": "near", "position": 0.02, "angle": 0.1}],
        "actor_lr": 5e-3,
        "critic_lr": 5e-3,
        "reapply": 1,
        "credit": credit,
    }
    net = {"kind": "mlp", "hidden": [64, 64]}
    made = setup(TWO, agent, net, starts="outside", mirrored=0.5)
    learner = Learner(made, seed=1)
    before = coverage(learner, made, 30)
    for i in range(UPDATES):
        scenes = (
            transitions(made, 48, i) if credit == "piece" else beside(made, 48, i, 1.0 * (i % 2))
        )
        learner.update(learner.prepared(scenes, np.random.default_rng(i)), i / UPDATES)
    assert before < 0.2
    assert coverage(learner, made, 30) > 0.6
