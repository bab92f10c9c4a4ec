"""What is measured is what users train."""

from dataclasses import replace

import pytest

from tangram_lab.benchmarks.setups import place, preset, several

pytestmark = pytest.mark.fast


def test_a_preset_has_what_it_inherits() -> None:
    mlp, paper = preset("mlp"), preset("paper")
    assert mlp.agent.config == replace(paper.agent.config, name="mlp")
    assert (mlp.agent.net.kind, paper.agent.net.kind) == ("mlp", "mha")


def test_several_tokens_are_a_valid_task() -> None:
    for count in range(1, 8):
        task = place(several(count))
        assert task.layout.tokens == task.horizon == count
