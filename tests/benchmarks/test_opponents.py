"""What the project is compared with must do the same work, or the comparison is worth nothing."""

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
import torch

from tangram_agent.attention import GraphAttention
from tangram_agent.learner import Learner
from tangram_lab.benchmarks.learner import HeadByHead, PlainLearner
from tangram_lab.benchmarks.replay import filled, random_transitions
from tangram_lab.benchmarks.setups import preset, several, with_agent, with_sim
from tangram_lab.benchmarks.sim import BareLoop
from tangram_sim.physics import PhysicsWorld

pytestmark = pytest.mark.fast


def _split(joint: GraphAttention, apart: HeadByHead) -> None:
    """Give the heads' own matrices the numbers of the joint ones."""
    width, heads = joint.combine.in_features, joint.heads
    parts = joint.query_key_value.weight.view(3, heads, width // heads, width)
    with torch.no_grad():
        for kind, modules in zip(parts, (apart.query, apart.key, apart.value), strict=True):
            for head, module in zip(kind, modules, strict=True):
                module.weight.copy_(head)
        columns = joint.combine.weight.split(width // heads, dim=1)
        for column, module in zip(columns, apart.combine, strict=True):
            module.weight.copy_(column)


@pytest.mark.parametrize("count", [9, 53])
def test_head_by_head_gives_the_same_messages(count: int) -> None:
    torch.manual_seed(0)
    joint = GraphAttention(64, 4, "sqrt_d")
    apart = HeadByHead(64, 4, joint.scale)
    _split(joint, apart)
    nodes, edges = torch.randn(3, count, 64), torch.rand(count, count) > 0.3
    edges.fill_diagonal_(fill_value=True)
    torch.testing.assert_close(apart(nodes, edges), joint(nodes, edges), atol=1e-5, rtol=1e-4)


def test_a_preset_has_what_it_inherits() -> None:
    mlp, paper = preset("mlp"), preset("paper")
    assert mlp.agent == replace(paper.agent, name="mlp")
    assert (mlp.net.kind, paper.net.kind) == ("mlp", "mha")


def test_the_plain_learner_learns_from_the_same_targets_where_nothing_goes_on() -> None:
    """Only its targets' networks are asked in vain: that is what it is there to cost."""
    setup = with_agent(preset("mlp"), batch_size=32)
    ours, plain = Learner(setup, seed=0), PlainLearner(setup, seed=0)
    batch = ours.prepared(random_transitions(setup, 32), np.random.default_rng(0))
    for _ in range(3):
        found, expected = plain.update(batch), ours.update(batch)
        assert found == pytest.approx(expected, rel=1e-4)


def test_the_plain_learner_moves_its_targets() -> None:
    setup = with_agent(preset(), batch_size=16)
    plain = PlainLearner(setup, seed=0)
    before = [parameter.clone() for parameter in plain.target_critic.parameters()]
    plain.update(plain.prepared(random_transitions(setup, 16), np.random.default_rng(0)))
    after = plain.target_critic.parameters()
    assert any(not torch.equal(old, new) for old, new in zip(before, after, strict=True))


@pytest.mark.parametrize("count", [1, 7])
def test_the_bare_loop_takes_the_same_pictures(count: int) -> None:
    setup = with_sim(several(count), pixels=128)
    poses = np.array([[0.3 * k - 0.9, 0.2, 0.4 * k] for k in range(count)])
    with closing(PhysicsWorld(setup.layout, setup.sim)) as world:
        world.place(poses)
        expected = world.picture() < 255
    bare = BareLoop(setup.layout, setup.sim, setup.horizon)
    with closing(bare):
        scaled = poses * [2.0 / setup.sim.arena, 2.0 / setup.sim.arena, 1.0]
        bare.poses = [scaled.tolist()]
        bare._place()
        colours = np.reshape(bare._picture()[2], (128, 128, 4))
    # Its camera stands half a pixel beside ours, so the edges differ.
    shown, wanted = np.count_nonzero(colours[..., 0] < 255), np.count_nonzero(expected)
    assert shown == pytest.approx(wanted, rel=0.1)


def test_a_bare_episode_is_as_long_as_ours() -> None:
    setup = several(3)
    with closing(BareLoop(setup.layout, setup.sim, setup.horizon)) as bare:
        moved: list[int] = []
        bare._move = moved.append  # type: ignore[method-assign]
        assert bare.play() == 1
    assert moved == bare.bodies


def test_a_filled_buffer_is_full_and_several_tokens_are_a_valid_task() -> None:
    replay = filled(preset(), 1000)
    assert (len(replay), replay.capacity) == (1000, 1000)
    replay.check_valid()
    assert replay.sample(8, np.random.default_rng(0)).state.any()
    for count in range(1, 8):
        assert several(count).layout.tokens == several(count).horizon == count
