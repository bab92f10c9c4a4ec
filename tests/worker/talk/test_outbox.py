"""What is kept of the conversation, without sockets: unacknowledged batches, newest weights."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tangram_core.agent import Weights
from worker.talk.outbox import NewestWeights, Outbox

pytestmark = pytest.mark.fast


@given(st.lists(st.one_of(st.none(), st.integers(1, 12)), max_size=40))
def test_the_outbox_against_a_list(steps: list[int | None]) -> None:
    """None adds if there is room, a number removes."""
    outbox, kept, count = Outbox(window=3), [], 0
    for step in steps:
        if step is None and outbox.free:
            count += 1
            outbox.add([bytes([count])])
            kept.append(count)
        elif step is not None:
            assert outbox.remove(step) == (step in kept)
            kept = [number for number in kept if number != step]
        assert len(outbox) == len(kept) <= 3
        assert outbox.free == 3 - len(kept)
        assert outbox.messages == [[bytes([number])] for number in kept]
        assert (outbox.first, outbox.next) == (kept[0] if kept else count + 1, count + 1)


def test_a_window_may_shrink_below_what_is_kept() -> None:
    outbox = Outbox(window=3)
    for _ in range(3):
        outbox.add([b""])
    outbox.window = 1
    assert outbox.free == 0


def test_newest_weights_are_those_of_the_present_life() -> None:
    kept = NewestWeights()
    kept.begin("a")
    assert kept.take() is None
    for version in (3, 5, 4):
        kept.offer("a", Weights(version, {}))
    kept.offer("b", Weights(9, {}))
    newest = kept.take()
    assert newest is not None
    assert (newest.version, kept.version, kept.take()) == (5, 5, None)
    kept.offer("a", Weights(5, {}))
    assert kept.take() is None
    # The same life again changes nothing, another one begins with its own versions.
    kept.begin("a")
    assert kept.version == 5
    kept.begin("b")
    assert kept.version == -1
    kept.offer("b", Weights(1, {}))
    kept.begin("c")
    assert kept.take() is None
