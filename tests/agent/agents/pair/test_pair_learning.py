"""Learning from pairs: losses by hand, what gradients reach, and that it learns."""

from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tangram_agent.agents.pair.batch import PairBatch, make_pairs
from tangram_agent.agents.pair.coverage import Lying
from tangram_agent.agents.pair.learner import PairLearner
from tangram_agent.agents.pair.pairs import Pairs
from tangram_agent.base.types import Transitions
from tangram_core.setup import Setup
from tangram_sim.batch import BatchedEnv
from tests.agent.agents.pair.pair_scenes import PERCEPTRON, TWO, seven, transitions
from tests.agent.builders import Policy, learn, learner_of, setup

pytestmark = pytest.mark.fast

TWINS = [{"strategy": "final"}, {"strategy": "near", "position": 0.1, "angle": 0.5}]
AGENT = {"hindsight": TWINS}
UPDATES = 120
CASES: dict[str, dict[str, Any]] = {
    "mha": {"agent": AGENT},
    "mlp": {"agent": AGENT, "net": PERCEPTRON},
}


def pairs_in(made: Setup, batch: Transitions) -> PairBatch:
    hindsight = made.agent.config.hindsight
    return make_pairs(batch, made.task.layout, hindsight, np.random.default_rng(0))


@pytest.mark.parametrize("case", CASES)
def test_the_losses_by_hand(case: str) -> None:
    """Before the first update the acting networks are the learner's own."""
    made = seven(**CASES[case])
    learner = learner_of(made, 0)
    batch = pairs_in(made, transitions(made, 8, 0))
    steps, own, still = learner.steps_of(batch), learner.acting, torch.zeros(64, 3)

    def of(lying: Lying) -> tuple[torch.Tensor, ...]:
        pose, flipped = (torch.from_numpy(one).float() for one in (lying.pose, lying.flipped))
        return pose, flipped, torch.from_numpy(lying.index)

    def pairs_of(token: Lying) -> Pairs:
        return Pairs(*of(token), *of(batch.piece), torch.from_numpy(batch.covered).float())

    value = own.critic(pairs_of(batch.after), still)
    critic_loss, actor_loss = learner.losses(steps)
    expected = (value - torch.from_numpy(batch.reward).float()).square().mean().item()
    assert critic_loss.value.item() == pytest.approx(expected, rel=1e-6)
    assert critic_loss.told["q"].item() == pytest.approx(value.mean().item(), rel=1e-5)
    start = pairs_of(batch.start)
    velocity, raw = own.actor(start)
    gain, penalty = (actor_loss.told[name] for name in ("actor_loss", "saturation"))
    assert gain.item() == pytest.approx(-own.critic(start, velocity).mean().item(), rel=1e-5)
    assert penalty.item() == pytest.approx(torch.relu(raw.abs() - 1.0).square().mean().item())


def test_noise_on_the_corners_does_no_harm() -> None:
    made = seven(**CASES["mlp"])
    learner, batch = learner_of(made, 0), transitions(made, 64)
    rng = np.random.default_rng(0)
    names = ("state", "next_state", "goal")
    noise = {name: 0.2 * rng.standard_normal(batch.state.shape) for name in names}
    noisy = {name: (vars(batch)[name] + noise[name]).astype(np.float32) for name in names}
    pairs = pairs_in(made, replace(batch, **noisy))
    for share in (pairs.covered, pairs.reward):
        assert 0.0 <= share.min() < share.max() <= 1.0
    learner.learn(learner.steps_of(pairs))


def coverage(learner: PairLearner, made: Setup, episodes: int) -> float:
    """Mean overlap of episodes that the acting weights play."""
    policy = Policy(made)
    policy.load(learner.broadcast())
    with closing(BatchedEnv(made.task.layout, made.task.sim, made.task.reward, episodes)) as env:
        env.reset([np.random.default_rng([1, i]) for i in range(episodes)])
        for _ in range(env.horizon):
            actions = policy.act(env.corners, env.placed, env.goals)
            result = env.step(actions.astype(np.float64))
    return float(result.coverage.mean())


def test_it_learns_to_assemble_two_tokens() -> None:
    """From random scenes and hindsight alone; without learning next to nothing is covered."""
    agent = {
        "hindsight": [*TWINS, {"strategy": "near", "position": 0.02, "angle": 0.1}],
        "actor_lr": 5e-3,
        "critic_lr": 5e-3,
        "reapply": 1,
    }
    net = {"kind": "mlp", "hidden": [64, 64]}
    made = setup(TWO, agent, net, starts="outside", mirrored=0.5)
    learner = learner_of(made, seed=1)
    before = coverage(learner, made, 30)
    for i in range(UPDATES):
        learn(learner, transitions(made, 48, i), i / UPDATES, i)
    assert before < 0.2
    assert coverage(learner, made, 30) > 0.6
