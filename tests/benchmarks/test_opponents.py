"""What is measured is what users train."""

import pytest

from tangram_lab.benchmarks.setups import place, several

pytestmark = pytest.mark.fast


def test_several_tokens_are_a_valid_task() -> None:
    for count in range(1, 8):
        task = place(several(count))
        assert task.layout.tokens == task.spec.horizon == count
