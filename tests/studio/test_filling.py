"""Figures that a person laid of tans: what is one, and what is not."""

import pytest

from tangram_core.errors import ConfigError
from tangram_studio.filling import fill
from tangram_studio.messages import Fill, Tokens
from tests.studio.test_playing import figure

pytestmark = pytest.mark.slow


def laid(*shifts: tuple[int, float]) -> Fill:
    """The tans of a cat, some of them shifted to the right."""
    cat = figure("cat")
    poses = cat.poses.copy()
    for token, by in shifts:
        poses[token, 0] += by
    rows = [(float(x), float(y), float(angle)) for x, y, angle in poses]
    return Fill(number=1, pieces=Tokens(rows, [bool(side) for side in cat.flipped]))


def test_what_was_laid_is_filled() -> None:
    found = fill(laid())
    assert found.exact
    assert found.iou > 0.999


@pytest.mark.parametrize(
    ("shifts", "why"),
    [
        ([(0, 0.15)], "the tans lie on each other: move them apart"),
        ([(k, 3.0 * (k + 1)) for k in range(3)], "lie in [4-6] groups: move them until they touch"),
    ],
)
def test_what_is_no_figure_is_refused(shifts: list[tuple[int, float]], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        fill(laid(*shifts))
