"""Who finds how silhouettes are filled."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tangram_agent.config import AgentConfig
from tangram_agent.runs import load_run
from tangram_sim.areas import Area
from tangram_sim.dissections import Budget, Search, Tokens
from tangram_sim.errors import ConfigError
from tangram_sim.puzzles import library
from tangram_sim.rings import covered_area
from tangram_sim.targets import placement
from tangram_vision.silhouettes import Method
from tests.sim.builders import SEVEN, TRIO, layout_of
from tests.worker.test_hidden import OUTLINE, game
from worker.baselines import exact_policy
from worker.config import EvalConfig, PlayConfig
from worker.evaluate import evaluate_run
from worker.methods import Learned, learned_method, method_of
from worker.puzzles import find_figures
from worker.scores import RUN, score_hidden
from worker.silhouettes import read_silhouette


def told(method: Method) -> tuple[bool, int, bool]:
    return method.search, method.width, method.values is not None


@pytest.mark.fast
@pytest.mark.parametrize(
    ("solve", "seven", "three"),
    [
        ("together", (True, 12, True), (True, 12, False)),
        ("solver", (True, 12, False), (True, 12, False)),
        ("beam", (False, 12, True), None),
        ("agent", (False, 1, True), None),
    ],
)
def test_methods(solve: str, seven: Any, three: Any) -> None:
    """Tokens that nobody learned to fill with are laid by size."""
    assert told(method_of(solve, layout_of(*SEVEN, scale=1.7))) == seven
    if three is not None:
        assert told(method_of(solve, layout_of(*TRIO, scale=1.0))) == three
        return
    with pytest.raises(ConfigError, match=f"^solve={solve} needs an agent .* set solve=solver"):
        method_of(solve, layout_of(*TRIO, scale=1.0))


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
@pytest.mark.parametrize(("solve", "by"), [("together", "search"), ("beam", "beam")])
def test_it_is_told_who_filled_what(solve: str, by: str) -> None:
    made = game(OUTLINE)
    figures = find_figures("test", made, ["heart", "swan"]).figures
    formula = exact_policy(made.layout, made.sim)
    scored = score_hidden(made, figures, {RUN: formula}, 0, solve)
    assert scored.means[RUN]["filled_by"] == {"search": 0, "beam": 0} | {by: 2}
    assert [one["filled_by"] for one in scored.puzzles] == [by, by]
    assert scored.means[RUN]["share_solved_iou"] == 1.0


@pytest.mark.fast
def test_a_drawing_is_filled_by_who_is_named() -> None:
    setup = load_run("pretrained/tangram7").setup
    assert read_silhouette("swan", setup, solve="beam").told.startswith("filled by the beam in ")
    assert read_silhouette("swan", setup, solve="solver").told.startswith("filled by the search ")
    with pytest.raises(ConfigError, match=r"solutions=2 changes nothing with solve=beam, which"):
        read_silhouette("swan", setup, 2, solve="beam")


FILLER = "pretrained/tangram7_silhouette"
SHOWN = {"sim": {"backend": "kinematic", "observe": "silhouette_pictures", "pixels": 64}}


@pytest.mark.fast
def test_an_agent_of_outlines_fills_pictures_itself(tmp_path: Path) -> None:
    """By its own beam; what it finds is laid by the formula, as what others find is."""
    out, grey = tmp_path / "scores.json", {"sim": SHOWN["sim"] | {"picture": "grey"}}
    config = EvalConfig(FILLER, puzzle=("heart", "swan"), out=str(out), changes=grey)
    assert evaluate_run(config) == 0
    report = json.loads(out.read_text())
    assert report["filled_by"] == {"search": 0, "beam": 2}
    assert report["share_solved_iou"] == 1.0
    largest, solver = (report["baselines"][name] for name in ("largest first", "solver"))
    assert largest["filled_by"]["search"] == 0
    assert largest["search_seconds"] != report["search_seconds"]
    assert solver["filled_by"] == {"search": 2, "beam": 0}


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


@pytest.mark.fast
@pytest.mark.parametrize(
    ("settings", "width"), [({}, 12), ({"lookahead": "none", "beam": AgentConfig.beam}, 1)]
)
def test_a_run_fills_by_as_wide_a_beam_as_it_looks_ahead(settings: Any, width: int) -> None:
    run = load_run(FILLER)
    method = learned_method(run.with_settings({"agent": settings}) if settings else run)
    assert told(method) == (False, width, True)


@pytest.mark.fast
def test_a_run_that_fills_outlines_asks_nobody() -> None:
    config = EvalConfig(FILLER, puzzle=("heart",), solve="beam", changes=SHOWN)
    with pytest.raises(ConfigError, match="^solve=beam changes nothing with a run that fills "):
        evaluate_run(config)


@pytest.mark.fast
@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        (EvalConfig, {"solve": "beam"}, "^solve=beam changes nothing with puzzle=null"),
        (
            EvalConfig,
            {"solve": "solver", "puzzle": ("cat",)},
            "^solve=solver changes nothing with pieces that are shown, .* sim.observe=silhouette",
        ),
        (PlayConfig, {"solve": "beam"}, "^solve=beam changes nothing with silhouette=null"),
        (PlayConfig, {"solve": "me", "silhouette": "cat"}, "solve must be one of together, solver"),
    ],
)
def test_it_is_said_where_nobody_is_asked(kind: Any, settings: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        kind(run_dir="pretrained/tangram7", **settings)
