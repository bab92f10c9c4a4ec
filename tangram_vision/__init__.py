"""Pictures -> tokens; silhouettes -> tokens that fill them. Workers only, by OpenCV.

Start with `solving.py`, `pictures/seeing.py` and `silhouettes/silhouettes.py`. Folders, each
imports those behind it only: given, silhouettes, pictures. May import tangram_sim and tangram_core.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tangram_vision.solution import Solution


def solve(path: str) -> "Solution":
    """Where the seven tans lie in a figure: they fill it, or come as near as was found.

    It takes up to five seconds of processor time, and half as long again where nothing fills it.

    Args:
        path: of a picture, an SVG, a puzzle or an outline as JSON; or a puzzle of the library, as
            "cat".

    Raises:
        tangram_core.errors.ConfigError: it cannot be read; says why, and what to do.
    """
    # Only here: whoever wants another part of the package needs no OpenCV for it.
    from tangram_sim.geometry.layout import TokensConfig, make_layout  # noqa: PLC0415
    from tangram_sim.puzzles.assembly import COUNTS  # noqa: PLC0415
    from tangram_vision.solving import answer  # noqa: PLC0415

    layout = make_layout(TokensConfig(tuple(n for n, c in COUNTS.items() for _ in range(c)), 1.0))
    return answer(path, path, layout, 1.0).solution(layout, 1.0, path)
