"""Pictures of the game: one silhouette, the hand above all, names and shares below."""

import numpy as np
import pytest
from PIL import Image

from tangram_sim.game_drawing import Held, captions, draw_game, figure_sheet, tiles
from tangram_sim.puzzles import load_puzzle
from tests.sim.builders import layout_of
from tests.sim.test_drawing import at

pytestmark = pytest.mark.fast

PAIR = layout_of("square", "square")
GOAL = PAIR.corners(np.array([[0.2, -0.5, 0.0], [-0.2, -0.5, 0.0]]))
STARTS = PAIR.corners(np.array([[0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]]))
STACKED = PAIR.corners(np.array([[0.0, 0.5, 0.0], [0.0, 0.5, 0.0]]))


def scene(corners: np.ndarray = STARTS, held: Held | None = None) -> Image.Image:
    return draw_game(PAIR, 2.0, corners, GOAL, 240, held)


def test_the_target_is_one_figure_without_seams() -> None:
    image = scene()
    inside = {at(image, x, -0.5) for x in np.linspace(-0.35, 0.35, 50)}
    assert len(inside) == 1
    assert min(at(image, 0.4, -0.5)) < min(*inside)  # its edge is darker


def test_the_piece_in_the_hand_lies_above_the_others() -> None:
    first, second = (at(scene(STARTS), x, 0.5) for x in (0.5, -0.5))
    assert first != second
    held = [at(scene(STACKED, Held(k)), 0.0, 0.5) for k in (0, 1)]
    np.testing.assert_allclose(held, [first, second], atol=30)
    assert held[0] != held[1]


def dark(image: Image.Image) -> float:
    """The share of the upper right quarter that is darker than the table."""
    size = image.width // 2
    return float((np.asarray(image.convert("L"))[:size, size:] < 245).mean())


def test_a_lifted_piece_is_larger_and_throws_a_shadow() -> None:
    shares = [dark(scene(held=Held(0, height))) for height in (0.0, 0.5, 1.0)]
    assert shares[0] < shares[1] < shares[2]


def test_a_piece_that_cannot_be_set_down_is_marked_in_red() -> None:
    red = [
        int(((pixels[..., 0] > 180) & (pixels[..., 1:].max(axis=-1) < 80)).sum())
        for pixels in (np.asarray(scene(held=Held(0, 0.5, stopped))) for stopped in (False, True))
    ]
    assert red[0] == 0
    assert red[1] > 50


def test_a_piece_on_its_edge_is_a_line() -> None:
    """As it is seen half way of being turned over."""
    corners = STARTS.copy()
    corners[:4, 1] = 0.5
    assert dark(scene(corners, Held(0, 1.0))) > 0.0


@pytest.mark.parametrize(
    ("count", "width", "columns", "size"),
    [(1, 960, 1, 480), (2, 960, 2, 480), (14, 1200, 5, 240), (100, 1200, 12, 120)],
)
def test_tiles_fill_the_width(count: int, width: int, columns: int, size: int) -> None:
    assert tiles(count, width) == (columns, size)


def test_captions_tell_name_and_share() -> None:
    ends = np.stack([GOAL, PAIR.corners(np.array([[0.2, -0.5, 0.0], [0.2, -0.5, 0.0]]))])
    told = captions(PAIR, ends, np.stack([GOAL, GOAL]), ["cat", "dog"])
    assert told == ["cat   100.0 %", "dog   50.0 %"]


def test_a_sheet_has_a_picture_for_every_figure() -> None:
    cat = load_puzzle("cat")
    ends = np.stack([cat.corners] * 3)
    sheet = figure_sheet(cat.layout, 2.0, ends, ends, ["a", "b", "c"])
    assert 1200 < sheet.width < 1400
    left, tile = np.asarray(sheet), (sheet.width - 13) // 3
    # The same figure three times: what is 413 pixels further on is the same picture.
    np.testing.assert_array_equal(left[:400, 13:413], left[:400, 13 + tile : 413 + tile])
