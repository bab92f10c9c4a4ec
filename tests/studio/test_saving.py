"""Files of what was played are what other commands read."""

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageOps

from tangram_core.errors import ConfigError
from tangram_sim.puzzles.assembly import PuzzleRules
from tangram_sim.puzzles.figures import parse_puzzles
from tangram_sim.targets.targets import placement
from tangram_studio import saving
from tangram_studio.playing import Sides, begin, next_move, player
from tangram_studio.saving import FRAMES, gif, puzzle_file, svg
from tangram_vision.given.svg_files import read_svg
from tests.studio.test_playing import figure

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", ["cat", "swan"])
def test_a_puzzle_file_and_an_svg_have_the_tokens_where_they_lie(name: str, tmp_path: Path) -> None:
    goal, layout = figure(name), player().layout
    (puzzle,) = parse_puzzles(puzzle_file(goal, "mine").decode(), "saved", PuzzleRules(0.6))
    poses, flipped = placement(puzzle, layout)
    assert puzzle.name == "mine"
    corners, wanted = layout.corners(poses, flipped), layout.corners(*goal)
    # As sets: equal tokens may have changed places, and symmetric ones turned.
    far = np.linalg.norm(corners[:, None] - wanted[None], axis=-1)
    assert far.min(axis=1).max() < 2e-3
    (tmp_path / "mine.svg").write_bytes(svg(goal))
    picture = ImageOps.invert(read_svg(tmp_path / "mine.svg", "mine.svg")[0]).getbbox()
    extent = np.ptp(wanted, axis=0)
    assert picture is not None
    wide, high = picture[2] - picture[0], picture[3] - picture[1]
    assert wide / high == pytest.approx(extent[0] / extent[1], rel=0.02)


def test_tokens_on_each_other_are_no_puzzle() -> None:
    goal = figure("cat")
    heap = Sides(np.zeros((7, 3)), goal.flipped)
    with pytest.raises(
        ConfigError, match="this is no puzzle, .* lies 0.5 units deep in piece 2 [^;]*$"
    ):
        puzzle_file(heap, "heap")


@pytest.mark.parametrize("name", ["", "a" * 65, "a\nb"])
def test_a_name_that_no_reader_takes_is_refused(name: str) -> None:
    with pytest.raises(ConfigError):
        puzzle_file(figure("cat"), name)


def test_a_gif_has_all_moves_up_to_a_number(monkeypatch: pytest.MonkeyPatch) -> None:
    goal = figure("cat")
    scene = Sides(begin(goal, 0), goal.flipped)
    first = next_move(scene, goal, "lift", ())
    second = next_move(Sides(first.frames[-1], scene.flipped), goal, "lift", first.done)
    with Image.open(BytesIO(gif([first, second], goal))) as film:
        assert film.format == "GIF"
        # Stills are one long frame each.
        assert 2 * FRAMES <= getattr(film, "n_frames", 1) <= 2 * FRAMES + 30
    monkeypatch.setattr(saving, "MOVES", 1)
    assert gif([first, second], goal) == gif([second], goal)
