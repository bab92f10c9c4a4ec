"""Who finds how silhouettes are filled."""

from typing import Any

import numpy as np
import pytest

from tangram_agent.runs import load_run
from tangram_sim.areas import Area
from tangram_sim.dissections import Budget, Search, Tokens
from tangram_sim.errors import ConfigError
from tangram_sim.puzzles import library
from tangram_sim.rings import covered_area
from tangram_sim.targets import placement
from tangram_vision.silhouettes import Method
from tests.sim.builders import SEVEN, TRIO, layout_of
from tests.worker.test_hidden import OUTLINE, exact, game
from worker.config import EvalConfig, PlayConfig
from worker.hidden import hide, means, one_by_one, play_hidden
from worker.methods import Learned, method_of
from worker.puzzles import find_figures
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
    hidden = hide(
        made,
        find_figures("test", made, ["heart", "swan"]).figures,
        0,
        method_of(solve, made.layout),
    )
    laid = play_hidden(hidden, exact(hidden), seed=0)
    assert means(hidden, laid)["filled_by"] == {"search": 0, "beam": 0} | {by: 2}
    assert [one["filled_by"] for one in one_by_one(hidden, laid)] == [by, by]
    assert laid.iou.min() > 0.95


@pytest.mark.fast
def test_a_drawing_is_filled_by_who_is_named() -> None:
    setup = load_run("pretrained/tangram7").setup
    assert read_silhouette("swan", setup, solve="beam").told.startswith("filled by the beam in ")
    assert read_silhouette("swan", setup, solve="solver").told.startswith("filled by the search ")
    with pytest.raises(ConfigError, match=r"solutions=2 changes nothing with solve=beam, which"):
        read_silhouette("swan", setup, 2, solve="beam")


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
