"""Pictures for people: colours where they belong, sizes, files that open, and the game's."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageDraw

from tangram_sim.drawing.game_drawing import Held, captions, draw_game, tiles
from tangram_sim.drawing.scenes import contact_sheet, draw_scene, save_gif, with_legend
from tangram_sim.drawing.strokes import TARGET
from tests.sim.builders import SEVEN, layout_of

pytestmark = pytest.mark.fast

SQUARE, PAIR = layout_of("square"), layout_of("square", "square")
CENTRE, AWAY = (SQUARE.corners(np.array([[x, 0.0, 0.0]])) for x in (0.0, 5.0))
GHOST = draw_scene(SQUARE, 2.0, AWAY, AWAY, 200, start=CENTRE + [0.05, 0.05])


def scene(size: int = 120, active: int | None = None) -> Image.Image:
    """Tokens upper right and upper left, the targets below them."""
    corners = PAIR.corners(np.array([[0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]]))
    goal = PAIR.corners(np.array([[0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]]))
    return draw_scene(PAIR, 2.0, corners, goal, size, active)


def at(image: Image.Image, x: float, y: float) -> tuple[int, ...]:
    """Colour at a point of the arena of width 2, whose margin is 4 % of the picture."""
    side = image.size[0]
    return image.getpixel((side * (0.5 + 0.46 * x), side * (0.5 - 0.46 * y)))  # type: ignore[return-value]


@pytest.mark.parametrize("size", [60, 241])
def test_tokens_and_targets_lie_where_they_should(size: int) -> None:
    image = scene(size)
    assert image.size == (size, size)
    places = [(0.5, 0.5), (-0.5, 0.5), (0.5, -0.5), (0.0, 0.0)]
    first, second, target, table = (at(image, *place) for place in places)
    assert table == (255, 255, 255)
    assert len({first, second, target, table}) == 4
    assert at(image, -0.5, -0.5) == target
    assert min(target) > 200  # pale


def test_edges_are_smooth_and_tokens_outside_the_arena_are_cut() -> None:
    turned, away = (SQUARE.corners(np.array([pose])) for pose in ([0, 0, 0.3], [50, -50, 0.0]))
    drawn = np.asarray(draw_scene(SQUARE, 2.0, turned, away, 100))
    assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 20
    assert draw_scene(SQUARE, 2.0, away, away, 64).size == (64, 64)


def test_the_active_token_is_marked() -> None:
    plain, marked = np.asarray(scene()), np.asarray(scene(active=1))
    changed = np.nonzero((plain != marked).any(axis=-1))
    assert len(changed[0]) > 0
    assert changed[1].max() < 60  # all in the left half


def test_every_tan_has_its_own_colour() -> None:
    layout, poses = layout_of(*SEVEN, scale=0.3), np.zeros((7, 3))
    poses[:, 0] = np.linspace(-0.85, 0.85, 7)
    corners, away = layout.corners(poses), layout.corners(poses + [0.0, 0.5, 0.0])
    image = draw_scene(layout, 2.0, corners, away, 400)
    assert len({at(image, x, 0.0) for x in poses[:, 0]}) == 7


def test_contact_sheet_of_twelve() -> None:
    sheet = contact_sheet([scene(240)] * 12, columns=4, captions=[f"test {i}" for i in range(12)])
    assert sheet.size[0] == 1000
    assert contact_sheet([scene(240)] * 2, columns=4).size[0] < 600
    # Each picture stands where it should, whole.
    assert np.array_equal(np.asarray(sheet.crop((8, 8, 248, 248))), np.asarray(scene(240)))


def test_gif_keeps_pictures_and_pace(tmp_path: Path) -> None:
    path = tmp_path / "film.gif"
    frames = [scene(), scene(active=0), scene(active=1)]
    save_gif(frames, path, 250)
    with Image.open(path) as film:
        assert getattr(film, "n_frames", 1) == 3
        assert film.info["duration"] == 250
        assert film.info["loop"] == 0
        film.seek(2)
        shown = np.asarray(film.convert("RGB")).astype(int)
    assert np.abs(shown - np.asarray(frames[2]).astype(int)).mean() < 3


def test_where_a_token_started_is_a_pale_ghost_with_a_way() -> None:
    start, end, away = (SQUARE.corners(np.array([[x, 0.0, 0.0]])) for x in (-0.6, 0.6, 5.0))
    plain = draw_scene(SQUARE, 2.0, end, away, 200)
    shown = draw_scene(SQUARE, 2.0, end, away, 200, start=start)
    assert at(plain, -0.6, 0.05) == (255, 255, 255)
    assert 200 < min(at(shown, -0.6, 0.05)) < 255
    changed = np.nonzero((np.asarray(plain) != np.asarray(shown)).any(axis=-1))
    assert changed[1].max() > 120  # the way goes on towards the end


@pytest.mark.parametrize(("width", "lines"), [(600, 1), (200, 3), (20, 4)])
def test_a_legend_below_the_sheet_tells_start_way_end_target_and_number(
    width: int, lines: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    words: list[str] = []
    monkeypatch.setattr(ImageDraw.ImageDraw, "text", lambda *given, **_: words.append(given[2]))
    sheet = with_legend(Image.new("RGB", (width, 50), "white"), 10)
    assert words[:4] == ["start", "way", "end", "target"]
    assert " ".join(words[4:]) == "coverage: covered share of the target, 1 is all of it"
    assert sheet.height == 50 + 15 * lines + 5
    assert (sheet.width == width) == (lines < 4)
    marks = np.asarray(sheet, int)[50:].reshape(-1, 3)
    for mark in (at(draw_scene(SQUARE, 2.0, CENTRE, AWAY, 200), 0, 0), at(GHOST, 0, 0), TARGET):
        assert np.abs(marks - mark).max(axis=1).min() < 8  # the paper behind it is not the table's


GOAL = PAIR.corners(np.array([[0.2, -0.5, 0.0], [-0.2, -0.5, 0.0]]))
STARTS = PAIR.corners(np.array([[0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]]))
STACKED = PAIR.corners(np.array([[0.0, 0.5, 0.0], [0.0, 0.5, 0.0]]))


def game(corners: np.ndarray = STARTS, held: Held | None = None) -> Image.Image:
    return draw_game(PAIR, 2.0, corners, GOAL, 240, held)


def test_the_target_is_one_figure_without_seams() -> None:
    image = game()
    inside = {at(image, x, -0.5) for x in np.linspace(-0.35, 0.35, 50)}
    assert len(inside) == 1
    assert min(at(image, 0.4, -0.5)) < min(*inside)  # its edge is darker


def test_the_piece_in_the_hand_lies_above_the_others() -> None:
    first, second = (at(game(STARTS), x, 0.5) for x in (0.5, -0.5))
    assert first != second
    held = [at(game(STACKED, Held(k)), 0.0, 0.5) for k in (0, 1)]
    np.testing.assert_allclose(held, [first, second], atol=30)
    assert held[0] != held[1]


def dark(image: Image.Image) -> float:
    """The share of the upper right quarter that is darker than the table."""
    size = image.width // 2
    return float((np.asarray(image.convert("L"))[:size, size:] < 245).mean())


def test_a_lifted_piece_is_larger_throws_a_shadow_and_is_a_line_on_its_edge() -> None:
    shares = [dark(game(held=Held(0, height))) for height in (0.0, 0.5, 1.0)]
    assert shares[0] < shares[1] < shares[2]
    turning = STARTS.copy()
    turning[:4, 1] = 0.5  # half way of being turned over
    assert dark(game(turning, Held(0, 1.0))) > 0.0


def test_a_piece_that_cannot_be_set_down_is_marked_in_red() -> None:
    shown = [np.asarray(game(held=Held(0, 0.5, stopped))) for stopped in (False, True)]
    red = [((one[..., 0] > 180) & (one[..., 1:].max(axis=-1) < 80)).sum() for one in shown]
    assert red[0] == 0
    assert red[1] > 50


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


def test_the_finger_is_drawn_where_it_is() -> None:
    places = [(0.6, -0.6), (-0.6, 0.6)]
    for x, y in places:
        shown = game(held=Held(0, finger=np.array([x, y])))
        assert [sum(at(shown, *place)) < 200 for place in places] == [
            place == (x, y) for place in places
        ]
