"""How silhouettes are filled, and by whom."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tangram_agent.runs import load_run
from tangram_game.config import EvalConfig
from tangram_game.evaluate import evaluate_run
from tangram_game.figures.methods import Learned, together
from tangram_game.figures.silhouettes import read_silhouette
from tangram_sim.geometry.areas import Area
from tangram_sim.geometry.dissections import Budget, Search, Tokens
from tangram_sim.geometry.rings import covered_area
from tangram_sim.puzzles.figures import library
from tangram_sim.targets.targets import placement
from tangram_vision.silhouettes.silhouettes import Method
from tests.sim.builders import SEVEN, TRIO, layout_of


def told(method: Method) -> tuple[bool, int, bool]:
    return method.search, method.width, method.values is not None


@pytest.mark.fast
def test_tokens_that_nobody_learned_to_fill_with_are_laid_by_size() -> None:
    assert told(together(layout_of(*SEVEN, scale=1.7))) == (True, 12, True)
    assert told(together(layout_of(*TRIO, scale=1.0))) == (True, 12, False)


@pytest.mark.fast
def test_values_are_those_of_the_agent_whatever_the_scale() -> None:
    every = []
    for scale in (0.6, 1.5):
        layout = layout_of(*SEVEN, scale=scale)
        tokens = Tokens(layout)
        (puzzle,) = [one for one in library("test", scale) if one.name == "heart"]
        poses, flipped = placement(puzzle, layout)
        area: Area = covered_area(layout.corners(poses, flipped), layout)
        search = Search(tokens, 0.004 * tokens.unit, Budget(np.inf))
        places = search.places(area, tokens.counts)
        given = [place.rest for place in places], [place.left for place in places]
        values = Learned(layout)(*given)
        assert len(set(np.round(values, 3).tolist())) > 1
        every.append(values)
    # Of sides that are all but equal another may be the longest, and is seen along another axis.
    assert np.corrcoef(*every)[0, 1] > 0.95


@pytest.mark.fast
@pytest.mark.parametrize(("searches", "by"), [(True, "search"), (False, "beam")])
def test_it_is_told_who_filled_what(
    searches: bool, by: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = load_run("pretrained/tangram7").task
    method = replace(together(task.layout), search=searches)
    monkeypatch.setattr("tangram_game.figures.methods.together", lambda _: method)
    shown = read_silhouette("swan", "it", task)
    assert shown.exact
    assert shown.told.startswith(f"filled by the {by} in ")


FILLER = "pretrained/tangram7_silhouette"


@pytest.mark.fast
@pytest.mark.parametrize("puzzle", [("heart",), None])
def test_a_report_takes_the_scores_of_an_agent_of_outlines(
    tmp_path: Path, puzzle: tuple[str, ...] | None
) -> None:
    """The mean reward of several tokens is of what they cover; every episode is told."""
    out = tmp_path / "scores.json"
    sim = {"backend": "kinematic"}
    few = {} if puzzle else {"episodes": 2}
    config = EvalConfig(FILLER, puzzle=puzzle, out=str(out), changes={"sim": sim}, **few)
    assert evaluate_run(config) == 0
    report = json.loads(out.read_text())
    for scores in (report, *report["baselines"].values()):
        assert len(scores["coverage_each"]) == scores["episodes"] == (2 if puzzle is None else 1)
        assert scores["mean_reward"] == pytest.approx(
            2.0 * np.mean(scores["coverage_each"]) - 1.0, abs=1e-5
        )
