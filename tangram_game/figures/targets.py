"""Finds out whether `target=` names a puzzle, a silhouette or a photograph."""

from pathlib import Path
from typing import TYPE_CHECKING

from tangram_core.errors import ConfigError
from tangram_game.figures.photographs import read_photograph
from tangram_game.figures.silhouettes import answered
from tangram_sim.geometry.dissections import Dissection
from tangram_sim.puzzles.sketches import check_file, loaded, read_text
from tangram_tasks.place import Place

if TYPE_CHECKING:  # needs OpenCV and shapely
    from tangram_vision.solution import Solution

PUZZLE, SILHOUETTE, PHOTOGRAPH = "puzzle", "silhouette", "photograph"
MOST_PARTS = 3  # areas of a figure; a picture with more is a photograph
TOLD = {
    PUZZLE: "a puzzle with its pieces",
    SILHOUETTE: "a figure without its pieces",
    PHOTOGRAPH: "a photograph of the tokens",
}


def told_apart(target: str, task: Place) -> str:
    """The kind of a target, a key of `TOLD`; the target is a file or a puzzle's name.

    A picture is a photograph if it shows all tokens of the run, at most three of them touching.

    Raises:
        ConfigError: the file is missing, or it is a photograph that lacks tokens.
    """
    path, source = Path(target), f"target={target}"
    if not path.suffix and not path.is_file():
        return PUZZLE
    if not path.suffix:
        raise ConfigError(f"{source} has no ending: rename it, a picture to {path.name}.png")
    check_file(path, source)
    if path.suffix.lower() == ".json":
        content = loaded(read_text(path, source), source)
        return SILHOUETTE if isinstance(content, dict) and "outlines" in content else PUZZLE
    if path.suffix.lower() == ".svg":
        return SILHOUETTE
    try:
        from tangram_vision.given.photos import LackingError  # noqa: PLC0415
    except ImportError:
        return SILHOUETTE  # its reader says which package is missing
    try:
        read_photograph(target, task, anywhere=True)
    except LackingError as error:
        if error.areas > MOST_PARTS:
            raise ConfigError(f"{error}; or set silhouette={target} if it is one figure") from None
        return SILHOUETTE
    except ConfigError:
        return SILHOUETTE
    return PHOTOGRAPH


def solved(target: str, source: str, task: Place, kind: str) -> "Solution":
    """Find where a run's tokens lie in a target.

    Args:
        target: a file, or the name of a puzzle, whose own pieces are ignored.
        source: name of the target in errors.
        task: the task of the run.
        kind: kind of the target, a key of `TOLD`.

    Raises:
        ConfigError: the target cannot be read, or OpenCV or shapely is not installed.
    """
    layout, scale = task.layout, task.tokens.scale
    if kind != PHOTOGRAPH:
        return answered(target, source, task).solution(layout, scale, target)
    from tangram_vision.silhouettes.tilts import mapped  # noqa: PLC0415
    from tangram_vision.solution import Picture, Solution, tokens_of  # noqa: PLC0415

    seen = read_photograph(target, task, anywhere=True)
    lies = Dissection(seen.figure.poses, seen.figure.flipped)
    return Solution(
        source=target,
        kind="seen",
        told="found in the photograph",
        iou=None,
        seconds=None,
        picture=Picture.of(seen.given.size),
        tokens=tokens_of(layout, scale, lies, mapped(seen.given.own, seen.outlines)),
    )
