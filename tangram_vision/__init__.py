"""Pictures -> tokens; silhouettes -> tokens that fill them. Workers only, by OpenCV.

Start with `solving.py`, `pictures/seeing.py` and `silhouettes/silhouettes.py`. Folders, each
imports those behind it only: given, silhouettes, pictures. May import tangram_sim and tangram_core.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tangram_vision.solution import Solution


def solve(path: str, seconds: float = 5.0) -> "Solution":
    """Where the seven tans lie in a figure: they fill it, or come as near as was found.

    Args:
        path: of a picture, an SVG, a puzzle or an outline as JSON; or a puzzle of the library, as
            "cat".
        seconds: of processor time for the search; what comes nearest takes up to 2.5 s more.

    Raises:
        tangram_core.errors.ConfigError: it cannot be read; says why, and what to do.
    """
    # Only here: whoever wants another part of the package needs no OpenCV for it.
    from tangram_vision import solving  # noqa: PLC0415

    return solving.solve(path, seconds)
