"""Edges that lie against each other are found, and closed by the fit."""

import numpy as np
import pytest

from tangram_core.arrays import Floats
from tangram_vision.pictures.contacts import Contact, closing, touching
from tangram_vision.pictures.kinds import Kind, kinds_of
from tangram_vision.pictures.ramps import fitted, ramps
from tests.sim.builders import layout_of

pytestmark = pytest.mark.fast

LAYOUT = layout_of("square", "large_triangle", scale=0.6)
KINDS = kinds_of(LAYOUT, 2.0, 64)  # a square of 6.8 pixels, and a triangle of 13.6


def kind(name: str) -> Kind:
    return next(one for one in KINDS if LAYOUT.shapes[one.tokens[0]].name == name)


PAIR = [kind("square"), kind("square")]
SIDE = float(np.sqrt(kind("square").area))


def beside(gap: float = 0.0, turn: float = 0.0, along: float = 1.0) -> Floats:
    """Two squares side by side."""
    return np.array([[20.0, -20.0, 0.0], [20.0 + SIDE + gap, -20.0 + along, np.radians(turn)]])


def other_side(edge: int) -> int:
    return (edge + 2) % 4


def test_edges_that_lie_against_each_other_are_found() -> None:
    for gap, turn in ((0.0, 0.0), (0.8, 5.0), (-0.8, -5.0)):
        (found,) = touching(PAIR, beside(gap, turn))
        assert (found.one, found.other) == (0, 1)
        assert found.against == other_side(found.edge)


@pytest.mark.parametrize(
    "poses",
    [beside(gap=1.5), beside(turn=20.0), beside(along=SIDE - 0.5)],
    ids=["far", "turned", "past"],
)
def test_edges_that_do_not_are_not(poses: Floats) -> None:
    """Too far, turned off, or with nothing in common."""
    assert touching(PAIR, poses) == []


def test_turns_change_as_is_told() -> None:
    """By differences; edges need not be parallel."""
    kinds = [kind("square"), kind("large_triangle")]
    poses = np.array([[20.0, -20.0, 0.1], [25.0, -18.0, 0.3]])
    contacts = [Contact(0, edge, 1, against) for edge in range(4) for against in range(3)]
    missing, change = closing(kinds, poses, contacts)
    for n in range(6):
        moved = poses.copy().ravel()
        moved[n] += 1e-6
        after, _ = closing(kinds, moved.reshape(2, 3), contacts)
        assert ((after - missing) / 1e-6)[::2] == pytest.approx(-change[::2, n], abs=1e-4)


def test_the_gap_of_parallel_edges_changes_as_is_told() -> None:
    poses = beside(gap=0.5)
    contacts = touching(PAIR, poses)
    missing, change = closing(PAIR, poses, contacts)
    assert missing == pytest.approx([0.0, -0.5], abs=1e-9) or missing == pytest.approx(
        [0.0, 0.5], abs=1e-9
    )
    for n in (0, 1, 3, 4):
        moved = poses.copy().ravel()
        moved[n] += 1e-5
        after, _ = closing(PAIR, moved.reshape(2, 3), contacts)
        assert (after - missing) / 1e-5 == pytest.approx(-change[:, n], abs=1e-6)


def test_a_fit_with_contacts_narrows_what_pixels_leave_open() -> None:
    """Pixels that show a square too far to the right by more than half of one."""
    cover = np.minimum(ramps(PAIR, beside(gap=0.6), 40).sum(axis=0), 1.0).astype(np.float32)
    free, _ = fitted(PAIR, beside(gap=0.6), cover)
    held, _ = fitted(PAIR, free, cover, touching(PAIR, free))
    gaps = [float(poses[1, 0] - poses[0, 0]) - SIDE for poses in (free, held)]
    assert gaps[0] == pytest.approx(0.6, abs=0.1)
    assert 0.0 < gaps[1] < 0.85 * gaps[0]
