"""What `target=` names: a puzzle, a drawing, a silhouette or a photograph, told apart by itself."""

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
MOST_PARTS = 3  # of a figure; a picture of more is a photograph
TOLD = {
    PUZZLE: "a puzzle with its pieces",
    SILHOUETTE: "a figure without its pieces",
    PHOTOGRAPH: "a photograph of the tokens",
}


def told_apart(target: str, task: Place) -> str:
    """Which of `TOLD` a target is, a file or the name of a puzzle of the library.

    A picture is a photograph if it shows all tokens of the run, three touching at most.

    Raises:
        ConfigError: there is no such file, or it is a photograph that lacks tokens.
    """
    path, source = Path(target), f"target={target}"
    if not path.suffix and not path.is_file():
        return PUZZLE
    if not path.suffix:
        raise ConfigError(f"{source} has no ending: name a picture {path.name}.png, say")
    check_file(path, source)
    if path.suffix.lower() == ".json":
        content = loaded(read_text(path, source), source)
        return SILHOUETTE if isinstance(content, dict) and "outlines" in content else PUZZLE
    if path.suffix.lower() == ".svg":
        return SILHOUETTE
    try:
        from tangram_vision.given.photos import LackingError  # noqa: PLC0415
    except ImportError:
        return SILHOUETTE  # whose reader says what is missing
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
    """Where a run's tokens lie in a target.

    Args:
        target: a file, or the name of a puzzle of the library, whose pieces are forgotten.
        source: what errors call it.
        task: the run.
        kind: which of `TOLD` it is.

    Raises:
        ConfigError: it cannot be read, or OpenCV or shapely is not installed.
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
