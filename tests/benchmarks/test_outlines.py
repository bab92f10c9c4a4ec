"""The table of who fills exact outlines: figures that no agent trained on, and those who choose."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely.affinity

from tangram_agent.filling import Filling, Rests
from tangram_agent.values import Corners
from tangram_lab.benchmarks import outlines
from tangram_lab.benchmarks.outlines import Simplest, run_outlines
from tangram_lab.benchmarks.seeing import SCALE
from tangram_lab.benchmarks.silhouettes import Shape
from tangram_sim.dissections import Dissection
from tangram_sim.errors import ConfigError
from tangram_sim.layout import Layout
from tangram_sim.puzzles import library
from tangram_sim.targets import placement, turned_figure
from tests.agent.outlines import AGENT, SIM
from tests.sim.builders import SEVEN, layout_of
from tests.worker.builders import write_run

pytestmark = pytest.mark.fast


def drawn(layout: Layout, split: str, name: str, kind: str, mirrored: bool = False) -> Shape:
    """A puzzle, turned."""
    (puzzle,) = (one for one in library(split, SCALE) if one.name == name)
    laid = placement(puzzle, layout)
    poses, flipped = layout.mirrored(*laid) if mirrored else laid
    return Shape(kind, Dissection(turned_figure(layout, (poses, flipped), 0.7), flipped))


def test_figures_that_agents_trained_on_are_left_out_and_the_rest_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tokens, sim = {"shapes": list(SEVEN), "scale": SCALE}, {"arena": 2.0, "allow_flip": True}
    made = write_run(tmp_path, tokens=tokens, sim=SIM | sim | {"backend": "kinematic"}, agent=AGENT)
    trained = [
        drawn(made.layout, "train", "square", "convex"),
        drawn(made.layout, "train", "duck", "test"),
        drawn(made.layout, "train", "duck", "test", mirrored=True),
    ]
    rest = [
        drawn(made.layout, "test", "trapezoid", "convex"),
        drawn(made.layout, "test", "two_squares", "test"),
    ]
    monkeypatch.setattr(outlines, "figures_of", lambda *_: iter([*trained, *rest]))
    assert run_outlines(str(tmp_path), 0, 0, tmp_path / "out.json") == 0
    rows = json.loads((tmp_path / "out.json").read_text())["rows"]
    assert [row["silhouette"] for row in rows] == [
        f"{who}, {beam}"
        for who in ("the agent", "largest first", "fewest corners", "shortest outline", "by chance")
        for beam in ("no search", "beam of 4", "beam of 12")
    ]
    assert {row["figures"] for row in rows} == {2}
    # Two squares: with a beam of 12 even chance finds how they are filled.
    assert np.array([row["test (1)"] for row in rows])[[2, 5, 8]].max() == 1.0


def test_the_simplest_rest_is_that_of_few_corners_or_a_short_outline() -> None:
    """A square of all the area, and as large a strip with a corner more, beside unused rows."""
    filling = Filling(layout_of(*SEVEN, scale=SCALE))
    side = float(np.sqrt(layout_of(*SEVEN, scale=SCALE).areas.sum()))
    square = shapely.box(0, 0, side, side)
    strip = shapely.Polygon([(0, 0), (4, 0), (4, 0.25), (2, 0.3), (0, 0.25)])
    strip = shapely.affinity.scale(strip, side, side, origin=(0, 0))
    corners = Corners.of(Rests.joined([filling.seen(one, (1,) * 5) for one in (square, strip)]))
    assert Simplest(1.0, 0.0)(corners).tolist() == [-4.0, -5.0]
    lengths = [-4.0, -strip.length / side]
    assert Simplest(0.0, 1.0)(corners).tolist() == pytest.approx(lengths, abs=1e-4)


def test_a_run_that_fills_no_outlines_is_refused(tmp_path: Path) -> None:
    write_run(tmp_path)
    with pytest.raises(ConfigError, match="fills no outlines: take one of agent=outline"):
        run_outlines(str(tmp_path), 1, 0, None)


def test_an_agent_of_pictures_fills_those_of_its_camera(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tokens = {"shapes": list(SEVEN), "scale": SCALE}
    sim = {"arena": 2.0, "allow_flip": True, "backend": "kinematic", "pixels": 128}
    sim |= {"observe": "silhouette_pictures", "picture": "grey"}
    made = write_run(tmp_path, tokens=tokens, sim=SIM | sim, agent=AGENT)
    shown = [drawn(made.layout, "test", "two_squares", "test")]
    monkeypatch.setattr(outlines, "figures_of", lambda *_: iter(shown))
    asked = list[tuple[int, str]]()
    real = outlines.pictured

    def pictured(layout: Layout, figures: Any, camera: Any, *rest: Any) -> Any:
        asked.append((camera.pixels, camera.picture))
        return real(layout, figures, camera, *rest)

    monkeypatch.setattr(outlines, "pictured", pictured)
    assert run_outlines(str(tmp_path), 0, 0, tmp_path / "out.json") == 0
    rows = json.loads((tmp_path / "out.json").read_text())["rows"]
    assert [row["silhouette"] for row in rows] == [
        f"{who}, beam of {beam}"
        for who in ("the agent", "learned from exact outlines", "largest first")
        for beam in (1, 12)
    ]
    assert set(asked) == {(128, "grey")}
    assert rows[3]["filled"] == 1.0
