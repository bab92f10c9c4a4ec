"""Drawings as SVG: what is drawn counts, and what harms is refused."""

from pathlib import Path

import numpy as np
import pytest
import shapely
from PIL import Image

from tangram_core.arrays import Floats
from tangram_core.errors import ConfigError
from tangram_vision.given.svg_files import read_svg
from tangram_vision.silhouettes.tilts import mapped

pytestmark = pytest.mark.fast

HEAD = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 300 300" width="300" height="300">'
LOW, HIGH = "10,10 110,10 10,110", "110,10 110,110 10,110"
HALF, REST = f'<polygon points="{LOW}"/>', f'<polygon points="{HIGH}"/>'
TRIANGLE = [(10, 10), (110, 10), (10, 110)]
SQUARE = [(10, 10), (110, 10), (110, 110), (10, 110)]
OTHER = [(230, 70), (230, 170), (130, 170)]
XMLNS = 'xmlns="http://www.w3.org/2000/svg"'


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fourth of the pixels, a third of the time."""
    monkeypatch.setattr("tangram_vision.given.svg_files.SIDE", 1200)


def read(folder: Path, content: str) -> np.ndarray:
    return np.asarray(read_whole(folder, content)[0])


def read_whole(folder: Path, content: str) -> tuple[Image.Image, tuple[float, float], Floats]:
    path = folder / "it.svg"
    path.write_text(content)
    return read_svg(path, f"silhouette={path.name}")


@pytest.mark.parametrize(
    ("content", "drawn"),
    [
        (
            f'<style>.a{{display:none}}</style>{HALF}<polygon class="a" points="{HIGH}"/>',
            [TRIANGLE],
        ),
        (f'{HALF}<svg x="120" y="60">{REST}</svg>', [TRIANGLE, OTHER]),
        (
            f'<polygon id="a" points="{LOW}"/><use href="#a" x="140" y="50"/>',
            [TRIANGLE, [(150, 60), (250, 60), (150, 160)]],
        ),
        (f'{HALF}<g transform="translate(120 60)">{REST}</g>', [TRIANGLE, OTHER]),
        (f'<g fill="none">{HALF}</g>{REST}', [SQUARE[1:]]),
        (
            '<clipPath id="c"><rect x="10" y="10" width="50" height="100"/></clipPath>'
            f'<g clip-path="url(#c)">{HALF}{REST}</g>',
            [[(10, 10), (60, 10), (60, 110), (10, 110)]],
        ),
        (f'{HALF}<polygon opacity="0" points="{HIGH}"/>', [TRIANGLE]),
        (
            f'<g visibility="hidden">{REST}<polygon visibility="visible" points="{LOW}"/></g>',
            [TRIANGLE],
        ),
        (f"{HALF}{REST}", [SQUARE]),
        (
            f"{HALF}<switch><foreignObject><div>T</div></foreignObject></switch>",
            [TRIANGLE],
        ),
    ],
    ids=range(10),
)
def test_what_is_drawn_counts(
    tmp_path: Path, content: str, drawn: list[list[tuple[int, int]]]
) -> None:
    pixels = read(tmp_path, f"{HEAD}{content}</svg>")
    dark = pixels < 128
    rows, columns = (np.flatnonzero(dark.any(axis=axis)) for axis in (1, 0))
    assert min(rows[0], columns[0]) > 100  # there is a border
    area = shapely.union_all([shapely.Polygon(one) for one in drawn])
    left, top, right, low = area.bounds
    found = dark[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    y, x = ((np.arange(count) + 0.5) / count for count in found.shape)
    wanted = shapely.contains_xy(
        area, *np.meshgrid(left + x * (right - left), top + y * (low - top))
    )
    assert (found & wanted).sum() > 0.99 * (found | wanted).sum()


@pytest.mark.parametrize(
    "content",
    [
        '<rect width="300" height="300"/><circle cx="150" cy="150" r="50" fill="#fff"/>',
        '<circle cx="150" cy="150" r="50" fill="#fff"/>',
        '<circle cx="150" cy="150" r="50" fill="#ff0"/>',
        '<circle cx="39.6875mm" cy="3cm" r="50" fill="red"/>',
    ],
    ids=["dark ground", "white", "yellow", "millimetres"],
)
def test_whatever_differs_from_the_ground_is_the_figure(tmp_path: Path, content: str) -> None:
    pixels = read(tmp_path, f"{HEAD}{content}</svg>")
    rows, columns = (np.flatnonzero((pixels < 128).any(axis=axis)) for axis in (1, 0))
    high, wide = np.ptp(rows) + 1, np.ptp(columns) + 1
    assert high == pytest.approx(wide, rel=0.02)
    assert (pixels < 128).sum() == pytest.approx(np.pi / 4 * high * wide, rel=0.02)


@pytest.mark.parametrize(
    ("page", "size", "moved"),
    [
        ('viewBox="0 0 300 200"', (300, 200), 0),
        ('viewBox="-50 -50 300 300" width="9cm" height="9cm"', (300, 300), 50),
        ('width="250px" height="300"', (250, 300), 0),
    ],
)
def test_a_point_of_the_picture_is_known_in_the_file(
    tmp_path: Path, page: str, size: tuple[int, int], moved: int
) -> None:
    drawn, found, own = read_whole(tmp_path, f"<svg {XMLNS} {page}>{HALF}</svg>")
    dark = np.asarray(drawn) < 128
    (left, *_, right), (top, *_, low) = (np.flatnonzero(dark.any(axis=axis)) for axis in (0, 1))
    corners = mapped(own, np.array([[left, top], [right + 1.0, low + 1.0]]))
    assert found == size
    assert corners.tolist() == [pytest.approx([end + moved] * 2, abs=0.3) for end in (10, 110)]


def test_a_page_that_is_not_told_or_stretched_is_the_picture(tmp_path: Path) -> None:
    for page in (
        "",
        'viewBox="0 0 300 300" width="1.2.3" height="9"',
        'width="9cm" height="9cm"',
        'viewBox="0 0 300 300" width="9cm" height="5cm"',
    ):
        drawn, size, own = read_whole(tmp_path, f"<svg {XMLNS} {page}>{HALF}</svg>")
        assert size == drawn.size
        assert own.tolist() == np.eye(3).tolist()


@pytest.mark.parametrize("ground", ["", '<rect width="100%" height="100%" fill="white"/>'])
def test_what_reaches_out_of_its_page_is_cut_off(tmp_path: Path, ground: str) -> None:
    def drawn(right: int) -> np.ndarray:
        return read(tmp_path, f'{HEAD}{ground}<polygon points="9,9 {right},9 {right},300"/></svg>')

    assert (drawn(300) < 128).any()  # to the page's very edge
    for page in ('width="400" height="300"', 'width="300" preserveAspectRatio="none" height="90"'):
        thin = '<path d="M20 20H80V80H20Z" fill="none" stroke="#000" stroke-width="0.4"/>'
        assert (read(tmp_path, f'<svg {XMLNS} viewBox="0 0 100 100" {page}>{thin}</svg>') < 1).any()
    with pytest.raises(ConfigError, match="is cut off: it reaches out of its page: enlarge"):
        drawn(400)
    told = f'<svg {XMLNS} width="300px" height="90"><path d="M20 20H400V80Z"/></svg>'
    with pytest.raises(ConfigError, match="is cut off"):
        read(tmp_path, told)


@pytest.mark.parametrize(
    "content",
    [
        f"{'<g>' * 5000}{HALF}{'</g>' * 5000}",
        "<defs>"
        + "".join(f'<g id="a{i}"><use href="#a{i + 1}"/></g>' for i in range(300))
        + '<rect id="a300" width="9" height="9"/></defs><use href="#a0"/>',
        '<filter id="f"><feGaussianBlur stdDeviation="90000"/></filter>'
        + f'<g filter="url(#f)">{HALF}' * 30
        + "</g>" * 30,
        "<script>alert(1)</script>",
    ],
    ids=["nested", "referred to", "blurred", "script"],
)
def test_what_would_end_or_stop_the_program_that_draws_is_refused(
    tmp_path: Path, content: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tangram_vision.given.svg_files.SECONDS", 1)
    with pytest.raises(ConfigError, match="cannot be drawn|draws nothing|is not XML"):
        read(tmp_path, f"{HEAD}{content}</svg>")
