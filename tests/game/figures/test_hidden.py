"""tangram-eval of puzzles whose pieces are hidden: what is laid, how it is judged, what is told."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import shapely
from PIL import Image

import tangram_tasks.register  # noqa: F401  # registers the environments
from tangram_core.errors import ConfigError
from tangram_game.config import EvalConfig
from tangram_game.evaluate import evaluate_run
from tangram_game.figures.hidden import Hidden, hide, lay, play_hidden
from tangram_game.figures.puzzles import Figure, find_figures, play_figures
from tangram_game.scores import hidden_lines, hidden_means, score_hidden
from tangram_sim.batch import BatchedEnv
from tangram_sim.config import RewardConfig
from tangram_sim.geometry.areas import overlap
from tangram_sim.geometry.dissections import Dissection
from tangram_sim.geometry.overlap import overlap_share
from tangram_tasks.place import Place
from tangram_tasks.rivals.baselines import exact_policy, random_policy
from tangram_vision.silhouettes import silhouettes
from tangram_vision.silhouettes.silhouettes import Filled, covered, fill_outline
from tests.agent.builders import setup
from tests.game.figures.puzzle_files import GAME, SIM, drawn, write_puzzles
from tests.worker.builders import write_run

pytestmark = pytest.mark.fast

PLAIN = {"backend": "kinematic", "starts": "outside"}
OUTLINE = PLAIN | {"observe": "silhouette"}


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine must find what an idle one finds."""
    monkeypatch.setattr("tangram_game.figures.hidden.SECONDS", 60.0)


def game(sim: dict[str, Any]) -> Place:
    return setup(GAME, **sim).task


def square(mirrored: bool = False) -> Figure:
    """The square of the library; its mirror image is another dissection of the same outline."""
    made = game(OUTLINE)
    (figure,) = find_figures("train", made, ["square"])
    if not mirrored:
        return figure
    poses, flipped = made.layout.mirrored(figure.poses, figure.flipped)
    return replace(figure, poses=poses, flipped=flipped)


def exact(hidden: Hidden) -> Any:
    return lambda _: exact_policy(hidden.task.layout, hidden.task.sim)


# What reaches the player


def test_hidden_pieces_do_not_reach_the_player() -> None:
    """Other pieces with the same outline: the same actions from the same starts."""
    one, other = square(), square(mirrored=True)
    assert (one.flipped != other.flipped).any()
    assert np.abs(one.poses - other.poses).max() > 0.1
    played = []
    for figure in (one, other):
        hidden = hide(game(OUTLINE), [figure])
        assert hidden.filled == 1
        played.append(lay(hidden, exact(hidden), seed=0))
    for name in ("corners", "goals", "actions"):
        columns = [own.episodes[name] for own in played]
        np.testing.assert_array_equal(*columns, err_msg=name)
    np.testing.assert_array_equal(played[0].starts, played[1].starts)


def test_what_was_found_reaches_the_player() -> None:
    made = game(OUTLINE)
    hidden = hide(made, find_figures("test", made, ["hut", "two_squares"]))
    played = lay(hidden, exact(hidden), seed=0)
    laid = [made.layout.corners(one.laid.poses, one.laid.flipped) for one in hidden.searches]
    np.testing.assert_allclose(played.episodes["goals"], laid, atol=1e-6)
    goals = [made.layout.corners(one.poses, one.flipped) for one in hidden.figures]
    assert overlap_share(np.stack(laid), np.stack(goals), made.layout).min() > 0.97
    assert overlap_share(played.ends, np.stack(goals), made.layout).min() > 0.97


def test_an_outline_does_not_depend_on_the_pieces() -> None:
    layout = game(OUTLINE).layout
    shown = [
        silhouettes.silhouette(layout, Dissection(own.poses, own.flipped))
        for own in (square(), square(mirrored=True))
    ]
    assert shown[0].equals_exact(shown[1], 0.0)
    for name, parts, holes, corners in (
        ("trapezoid", 1, 0, 4),  # pieces meet within its longest side
        ("hut", 1, 1, 13),
        ("two_squares", 2, 0, 8),
    ):
        (figure,) = find_figures("test", game(OUTLINE), [name])
        laid = Dissection(figure.poses, figure.flipped)
        area = silhouettes.silhouette(layout, laid)
        every = getattr(area, "geoms", [area])
        assert (len(every), sum(len(one.interiors) for one in every)) == (parts, holes)
        assert shapely.get_num_coordinates(area) - parts - holes == corners
        assert overlap(area, covered(layout, laid)) == pytest.approx(1.0, abs=1e-5)


def test_gaps_between_drawn_pieces_do_not_show_them() -> None:
    figure = square()
    layout, apart = game(OUTLINE).layout, figure.poses * (1.003, 1.003, 1.0)
    area = silhouettes.silhouette(layout, Dissection(apart, figure.flipped))
    assert len(getattr(area, "geoms", [area])) == 1
    assert len(area.interiors) == 0


# How it is judged


def test_scores_compare_areas() -> None:
    """The exact union of tokens and figure, whatever lies where."""
    made = game(OUTLINE | {"starts": "anywhere"})
    hidden = hide(made, find_figures("test", made, ["heart", "swan", "hut"]))
    chance = play_hidden(hidden, lambda _: random_policy(made.layout, hidden.task.sim), seed=0)
    assert 0.0 < chance.iou.max() < 0.95
    for e, figure in enumerate(hidden.figures):
        poses, flipped = made.layout.poses(chance.ends[e]), made.layout.flipped(chance.ends[e])
        tokens = covered(made.layout, Dissection(poses, flipped))
        whole = covered(made.layout, Dissection(figure.poses, figure.flipped))
        assert chance.iou[e] == pytest.approx(overlap(tokens, whole), abs=1e-5)
        assert chance.coverage[e] == pytest.approx(
            tokens.intersection(whole).area / whole.area, abs=1e-5
        )


def test_another_dissection_is_as_good() -> None:
    other = square(mirrored=True)
    found = hide(game(OUTLINE), [square()])
    swapped = replace(found, searches=(replace(found.searches[0], laid=other),))
    (iou,) = play_hidden(swapped, exact(swapped), seed=0).iou
    assert iou > 0.999


def not_found(monkeypatch: pytest.MonkeyPatch, *which: int) -> None:
    """Let the search fail at some of the outlines, by their number."""
    asked = list[int]()

    def fill(*given: Any, **more: Any) -> list[Filled]:
        asked.append(len(asked))
        failed = Filled(None, 0.0, 0.25, 1, False)
        return [failed] if asked[-1] in which else fill_outline(*given, **more)

    monkeypatch.setattr("tangram_game.figures.hidden.fill_outline", fill)


def test_what_was_not_filled_counts_as_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    not_found(monkeypatch, 1)
    made = game(OUTLINE)
    hidden = hide(made, find_figures("test", made, ["heart", "swan", "hut"]))
    laid = play_hidden(hidden, exact(hidden), seed=0)
    assert (laid.iou[1], laid.coverage[1], laid.actions_used[1]) == (0.0, 0.0, 0)
    assert laid.seconds[1] == 0.25
    assert laid.iou[[0, 2]].min() > 0.999
    assert laid.actions_used[[0, 2]].tolist() == [7, 7]
    scores = hidden_means(hidden, laid)
    assert (scores["filled"], scores["not_filled"]) == (2, 1)
    assert scores["iou"] == pytest.approx(2 / 3, abs=1e-3)
    assert scores["share_solved_iou"] == pytest.approx(2 / 3)
    assert [one["filled"] for one in hidden_lines(hidden, laid)] == [True, False, True]
    assert hidden.titles == ["heart", "swan, not filled", "hut"]


def test_where_nothing_was_filled_nothing_is_played(monkeypatch: pytest.MonkeyPatch) -> None:
    not_found(monkeypatch, 0)
    hidden = hide(game(OUTLINE), [square()])
    laid = play_hidden(hidden, exact(hidden), seed=0)
    assert (laid.iou[0], hidden.filled, len(hidden.found)) == (0.0, 0, 0)


def test_what_fills_a_silhouette_badly_is_laid_and_does_not_count_as_filled() -> None:
    found = hide(game(OUTLINE), [square()])
    badly = replace(found, searches=(replace(found.searches[0], iou=0.9),))
    assert badly.filled == 0
    assert play_hidden(badly, exact(badly), seed=0).iou[0] > 0.999


def test_the_search_is_part_of_a_puzzles_time() -> None:
    found = hide(game(OUTLINE), [square()])
    slowly = replace(found, searches=(replace(found.searches[0], seconds=1000.0),))
    (seconds,) = play_hidden(slowly, exact(slowly), seed=0).seconds
    assert seconds > 1000.0


# What is told


def evaluated(folder: Path, sim: dict[str, Any], *names: str, **more: Any) -> dict[str, Any]:
    write_run(folder / "run", GAME, sim=SIM | {"pixels": 0})
    out = folder / "scores.json"
    changes = {"sim": {name: value for name, value in sim.items() if name not in PLAIN}}
    config = EvalConfig(
        str(folder / "run"), out=str(out), puzzle=tuple(names), changes=changes, **more
    )
    assert evaluate_run(config) == 0
    report: dict[str, Any] = json.loads(out.read_text())
    return report


def test_the_report_has_a_row_for_each_puzzle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    not_found(monkeypatch, 1)
    path = write_puzzles(tmp_path / "mine.json", drawn("cat"), drawn("fish"))
    sheet = tmp_path / "sheet.png"
    report = evaluated(tmp_path, OUTLINE, str(path), turns=2, sheet=str(sheet))
    rows = report["puzzles"]
    assert [(one["name"], one["degrees"], one["filled"]) for one in rows] == [
        ("my_cat", 0.0, True),
        ("my_cat", 180.0, False),
        ("my_fish", 0.0, True),
        ("my_fish", 180.0, True),
    ]
    for name in ("coverage", "iou", "blocked", "actions_used", "search_seconds"):
        assert report[name] == pytest.approx(np.mean([one[name] for one in rows]))
    assert report["seconds_per_puzzle"] == pytest.approx(np.mean([one["seconds"] for one in rows]))
    assert all(one["seconds"] >= one["search_seconds"] > 0.0 for one in rows)
    assert report["share_solved_iou"] == np.mean([one["solved"] for one in rows])
    assert (report["filled"], report["not_filled"]) == (3, 1)
    assert report["sim"]["observe"] == "silhouette"
    of_pieces = ("wrong", "doubly_used", "position_error_median", "angle_error_deg_median")
    assert not any(name in own for own in (report, *rows) for name in of_pieces)
    formula = report["baselines"]["exact"]
    assert formula["share_solved_iou"] == 0.75
    assert formula["iou"] == pytest.approx(0.75, abs=1e-2)
    printed = " ".join(capsys.readouterr().out.split())
    assert "3 of 4 filled (3 by the search, 0 by the beam); any dissection" in printed
    assert "exact outlines, pieces hidden" in printed
    assert "not filled" in printed
    with Image.open(sheet) as picture:
        assert picture.format == "PNG"


# What is refused


def test_elsewhere_silhouettes_are_refused() -> None:
    reason = "^sim.observe=silhouette is for an agent of outlines: .*corners$"
    made = game(OUTLINE)
    with pytest.raises(ConfigError, match=reason):
        BatchedEnv(made.layout, made.sim, RewardConfig())
    with pytest.raises(ConfigError, match=reason):
        play_figures(made, [square()], lambda _: None, 0)
    with pytest.raises(ConfigError, match=reason):
        gymnasium.make("Tangram-v0", observe="silhouette")


def test_without_puzzles_there_is_nothing_to_hide() -> None:
    changes = {"sim": {"observe": "silhouette"}}
    with pytest.raises(ConfigError, match="hides the pieces of puzzles, got none: add puzzle=test"):
        EvalConfig("runs/mine", changes=changes)
    assert EvalConfig("runs/mine", puzzle=("cat",), changes=changes).puzzle == ("cat",)


def test_a_missing_library_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tangram_game.figures.hidden", None)
    with pytest.raises(ConfigError, match=r"^sim\.observe=silhouette needs OpenCV and shapely"):
        score_hidden(game(OUTLINE), [square()], {}, 0)
