"""Find tokens in pictures, which needs OpenCV, and fill silhouettes. No master imports it.

Start with `solving.py`, `pictures/seeing.py` and `silhouettes/silhouettes.py`. Folders: given,
silhouettes, pictures; each imports only those named after it. May import tangram_sim and
tangram_core.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tangram_vision.solution import Solution


def solve(path: str) -> "Solution":
    """Place the seven tans so that they fill a figure, or come as near to it as a search finds.

    A call takes up to 5 s of processor time, and up to 7.5 s if nothing fills the figure.

    Args:
        path: a picture, an SVG, or a JSON file of a puzzle or an outline; or the name of a puzzle
            of the library, such as "cat".

    Raises:
        tangram_core.errors.ConfigError: the file cannot be read; says why, and what to do.
    """
    # Imported here, so that other parts of the package work without OpenCV.
    from tangram_sim.geometry.layout import TokensConfig, make_layout  # noqa: PLC0415
    from tangram_sim.puzzles.assembly import COUNTS  # noqa: PLC0415
    from tangram_vision.solving import answer  # noqa: PLC0415

    layout = make_layout(TokensConfig(tuple(n for n, c in COUNTS.items() for _ in range(c)), 1.0))
    return answer(path, path, layout, 1.0).solution(layout, 1.0, path)
