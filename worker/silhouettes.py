"""A silhouette as what a run is to assemble: it is filled with the run's tokens first."""

from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from tangram_agent.setup import Setup
from tangram_sim.arrays import Floats
from tangram_sim.drawing import contact_sheet
from tangram_sim.errors import ConfigError
from tangram_sim.layout import Layout
from tangram_sim.targets import has_all_tans, turned_figure
from worker.puzzles import Figure, reach_beyond
from worker.views import outlined

SECONDS = 5.0  # of the search


@dataclass(frozen=True, eq=False)
class Shown:
    """A silhouette and what fills it.

    Attributes:
        picture: of it, in colour.
        outlines: (V, 2) corners of the tokens that fill it, pixels of the picture, y down.
        figure: the tokens in the middle of a run's arena.
        told: how it was filled, in words.
    """

    picture: Image.Image
    outlines: Floats
    figure: Figure
    told: str


def read_silhouette(name: str, setup: Setup) -> Shown:
    """A silhouette, filled with a run's tokens.

    Raises:
        ConfigError: it cannot be read or filled, or OpenCV or shapely is not installed.
    """
    try:
        # Only here: other targets need neither.
        from tangram_vision.silhouette_files import fill_silhouette  # noqa: PLC0415
        from tangram_vision.silhouettes import SOLVED  # noqa: PLC0415
    except ImportError as error:
        raise ConfigError(
            f"silhouette needs OpenCV and shapely ({error}): install opencv-python-headless and "
            "shapely, or leave silhouette out"
        ) from error
    source, layout = f"silhouette={name}", setup.layout
    drawn = fill_silhouette(name, source, layout, SECONDS)
    filled, names = drawn.filled, ", ".join(shape.name for shape in layout.shapes)
    tokens = "the seven tans" if has_all_tans(layout) else names
    if filled.found is None:
        why = (
            f"all ways to lay them were tried, {filled.nodes} steps"
            if filled.complete
            else f"none was found in {filled.seconds:.1f} s"
        )
        raise ConfigError(
            f"{source} cannot be filled with {tokens} ({why}): draw sides that are straight, and "
            "corners where tokens have theirs"
        )
    if filled.iou < SOLVED:
        raise ConfigError(
            f"{source} was not filled with {tokens} in {filled.seconds:.1f} s: best found, IoU "
            f"{filled.iou:.2f}; give a larger picture or its outline as SVG"
        )
    found = filled.found
    poses = turned_figure(layout, (found.poses, found.flipped), 0.0)
    reach = reach_beyond(setup, layout.corners(poses, found.flipped))
    if reach is not None:
        raise ConfigError(
            f"{source} reaches {reach:.3g} from its middle at the run's scale, and its arena only "
            f"{setup.sim.arena / 2.0:.3g}: name a run of a larger arena"
        )
    outlines = layout.corners(found.poses, found.flipped) * (drawn.unit, -drawn.unit)
    told = f"filled in {filled.seconds:.2f} s, IoU {filled.iou:.3f}"
    return Shown(drawn.picture, outlines, Figure(Path(name).stem, 0.0, poses, found.flipped), told)


def draw_silhouette(silhouette: Shown, layout: Layout, size: int) -> Image.Image:
    """The silhouette with the outlines of the tokens that fill it, and how well, below."""
    picture = outlined(silhouette.picture, layout, silhouette.outlines, size)
    return contact_sheet([picture], 1, [silhouette.told])
