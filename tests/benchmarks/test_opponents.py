"""What the project is compared with must do the same work, or the comparison is worth nothing."""

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from tangram_lab.benchmarks.setups import place, preset, several
from tangram_lab.benchmarks.speed.sim import BareLoop
from tangram_sim.world.physics import PhysicsWorld

pytestmark = pytest.mark.fast


def test_a_preset_has_what_it_inherits() -> None:
    mlp, paper = preset("mlp"), preset("paper")
    assert mlp.agent.config == replace(paper.agent.config, name="mlp")
    assert (mlp.agent.net.kind, paper.agent.net.kind) == ("mlp", "mha")


@pytest.mark.parametrize("count", [1, 7])
def test_the_bare_loop_takes_the_same_pictures(count: int) -> None:
    task = place(several(count)).with_sim(pixels=128)
    poses = np.array([[0.3 * k - 0.9, 0.2, 0.4 * k] for k in range(count)])
    with closing(PhysicsWorld(task.layout, task.sim)) as world:
        world.place(poses)
        expected = world.picture() < 255
    bare = BareLoop(task.layout, task.sim, task.horizon)
    with closing(bare):
        scaled = poses * [2.0 / task.sim.arena, 2.0 / task.sim.arena, 1.0]
        bare.poses = [scaled.tolist()]
        bare._place()
        colours = np.reshape(bare._picture()[2], (128, 128, 4))
    # Its camera stands half a pixel beside ours, so the edges differ.
    shown, wanted = np.count_nonzero(colours[..., 0] < 255), np.count_nonzero(expected)
    assert shown == pytest.approx(wanted, rel=0.1)


def test_a_bare_episode_is_as_long_as_ours() -> None:
    task = place(several(3))
    with closing(BareLoop(task.layout, task.sim, task.horizon)) as bare:
        moved: list[int] = []
        bare._move = moved.append  # type: ignore[method-assign]
        assert bare.play() == 1
    assert moved == bare.bodies


def test_several_tokens_are_a_valid_task() -> None:
    for count in range(1, 8):
        task = place(several(count))
        assert task.layout.tokens == task.horizon == count
