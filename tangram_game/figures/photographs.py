"""A photograph as a target: its tokens are found, outlined, and assembled by the run."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

from tangram_core.arrays import Floats
from tangram_game.figures.puzzles import Figure, check_inside
from tangram_game.show.views import outlined
from tangram_sim.drawing.scenes import contact_sheet
from tangram_sim.geometry.layout import Layout
from tangram_sim.targets.targets import turned_figure
from tangram_tasks.place import Place

if TYPE_CHECKING:  # needs OpenCV
    from tangram_vision.given.picture_files import Given


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph and the tokens found in it.

    Attributes:
        given: the picture.
        outlines: (V, 2) corners of the tokens in pixels of the picture, y down.
        figure: the tokens, moved to the middle of the run's arena.
    """

    given: "Given"
    outlines: Floats
    figure: Figure


def read_photograph(target: str, task: Place, anywhere: bool = False) -> Photograph:
    """Find a run's tokens in a photograph; with `anywhere` they may reach out of the arena.

    Raises:
        ConfigError: not all tokens are found; the text says what is.
    """
    # Imported here: other targets need no OpenCV.
    from tangram_vision.given.photos import find_tokens  # noqa: PLC0415
    from tangram_vision.given.picture_files import read_picture  # noqa: PLC0415

    source, layout = f"target={target}", task.layout
    given = read_picture(Path(target), source)
    found = find_tokens(given.picture, layout, source)
    poses = turned_figure(layout, (found.poses, found.flipped), 0.0)
    if not anywhere:
        remedy = "lay tokens nearer together, or write out=solution.json, which needs no arena"
        check_inside(source, task, layout.corners(poses, found.flipped), remedy)
    outlines = layout.corners(found.poses, found.flipped) * (found.unit, -found.unit)
    figure = Figure(Path(target).stem, 0.0, poses, found.flipped)
    return Photograph(given, outlines, figure)


def draw_photograph(photograph: Photograph, layout: Layout, size: int) -> Image.Image:
    """The photograph with the outlines of the tokens found, and their number below."""
    picture = outlined(photograph.given.picture, layout, photograph.outlines, size)
    seen = f"{layout.tokens} tokens" if layout.tokens > 1 else layout.shapes[0].name
    return contact_sheet([picture], 1, [f"seen: {seen.replace('_', ' ')}"])
