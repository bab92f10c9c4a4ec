"""Puzzles as targets of a run: found, named, turned, refused, played from fixed starts."""

from pathlib import Path

import numpy as np
import pytest

from tangram_core.arrays import Floats
from tangram_core.errors import ConfigError
from tangram_game.figures.puzzles import find_figures, play_figures
from tangram_sim.geometry.overlap import covered_share
from tangram_sim.puzzles.figures import library, load_puzzle
from tangram_tasks.place import Place
from tangram_tasks.rivals.baselines import exact_policy, random_policy
from tests.agent.builders import setup
from tests.game.figures.puzzle_files import GAME, SIM, drawn, write_puzzles

pytestmark = pytest.mark.fast


def game(**sim: object) -> Place:
    return setup(GAME, **(SIM | sim)).task


@pytest.mark.parametrize("split", ["train", "test"])
def test_a_split_of_the_library_is_found_by_its_name(split: str) -> None:
    named = [puzzle.name for puzzle in library(split)]
    assert [one.name for one in find_figures(split, game())] == named


def test_without_a_file_the_whole_library_is_meant() -> None:
    found = find_figures(None, game(), ["cat", "heart"])
    assert [(one.name, one.degrees) for one in found] == [("cat", 0.0), ("heart", 0.0)]


def test_puzzles_are_turned_evenly_from_how_they_are_drawn() -> None:
    made = game()
    found = find_figures("test", made, ["heart"], turns=8)
    assert [one.degrees for one in found] == [45.0 * i for i in range(8)]
    assert [one.title for one in found[:2]] == ["heart", "heart 45°"]
    drawn_as = load_puzzle("heart").corners @ (1.0, 1j)
    for one in found:
        corners = made.layout.corners(one.poses, one.flipped) @ (1.0, 1j)
        turned = drawn_as * np.exp(1j * np.radians(one.degrees))
        # In the middle of the arena, whichever way it is turned.
        middle = [(part.min() + part.max()) / 2.0 for part in (turned.real, turned.imag)]
        gaps = np.abs(corners[:, None] - (turned - complex(*middle)))
        assert gaps.min(axis=0).max() < 1e-6


@pytest.mark.parametrize("scale", [0.6, 0.3])
def test_pieces_are_as_large_as_the_tokens(tmp_path: Path, scale: float) -> None:
    made = setup(GAME | {"scale": scale}, **SIM).task
    path = write_puzzles(tmp_path / "mine.json", drawn("cat"))
    (figure,) = find_figures(str(path), made)
    corners = made.layout.corners(figure.poses, figure.flipped)[None]
    own = load_puzzle("cat", scale).corners[None]
    assert covered_share(corners, own, made.layout)[0] > 0.99


@pytest.mark.parametrize(
    ("puzzles", "names", "message"),
    [
        ([drawn("cat")], ["dog"], "no puzzle 'dog' in .*mine.json: choose from my_cat"),
        ([drawn("cat", stretch=1.3)], None, "puzzle 'my_cat', piece 1"),
    ],
)
def test_what_cannot_be_played_is_refused_by_name(
    tmp_path: Path, puzzles: list, names: list[str] | None, message: str
) -> None:
    path = write_puzzles(tmp_path / "mine.json", *puzzles)
    with pytest.raises(ConfigError, match=message):
        find_figures(str(path), game(), names)


def starts(names: list[str], seed: int = 0, turns: int = 1) -> dict[tuple[str, float], Floats]:
    made = game()
    figures = find_figures("test", made, names, turns)
    played = play_figures(made, figures, lambda _: random_policy(made.layout, made.sim), seed)
    assert len(played.starts) == len(figures)
    keys = [(one.name, one.degrees) for one in figures]
    return dict(zip(keys, played.starts, strict=True))


def test_starts_depend_on_seed_and_figure_and_nothing_else() -> None:
    alone, among = starts(["heart"]), starts(["swan", "heart", "camel"])
    np.testing.assert_array_equal(alone["heart", 0.0], among["heart", 0.0])
    assert (among["swan", 0.0] != among["camel", 0.0]).all()
    assert (starts(["heart"], seed=1)["heart", 0.0] != alone["heart", 0.0]).all()
    turned = starts(["heart"], turns=2)
    assert (turned["heart", 0.0] != turned["heart", 180.0]).all()
    np.testing.assert_array_equal(turned["heart", 0.0], alone["heart", 0.0])


def test_more_puzzles_than_are_played_at_a_time() -> None:
    made = game()
    figures = find_figures("train", made)
    played = play_figures(made, figures, lambda _: exact_policy(made.layout, made.sim), 0)
    assert len(played.coverage) == len(figures) == 35
    goals = [made.layout.corners(one.poses, one.flipped) for one in figures]
    np.testing.assert_allclose(played.goals, np.stack(goals))
    np.testing.assert_allclose(played.coverage, 1.0, atol=1e-5)
