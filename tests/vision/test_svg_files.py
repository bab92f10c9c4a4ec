"""Drawings as SVG: what is drawn counts, and what harms is refused."""

from pathlib import Path

import numpy as np
import pytest
import shapely

from tangram_core.errors import ConfigError
from tangram_vision.given.svg_files import read_svg

pytestmark = pytest.mark.fast

HEAD = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 300 300" width="300" height="300">'
LOW, HIGH = "10,10 110,10 10,110", "110,10 110,110 10,110"
HALF, REST = f'<polygon points="{LOW}"/>', f'<polygon points="{HIGH}"/>'
TRIANGLE = [(10, 10), (110, 10), (10, 110)]
SQUARE = [(10, 10), (110, 10), (110, 110), (10, 110)]
OTHER = [(230, 70), (230, 170), (130, 170)]
MANY, MIB = 100_000, 2**20


def read(folder: Path, content: str) -> np.ndarray:
    path = folder / "it.svg"
    path.write_text(content)
    return np.asarray(read_svg(path, f"silhouette={path.name}"))


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
    dark = (pixels[..., 3] > 128) & (pixels[..., :3].max(axis=-1) < 128)
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


def test_a_ground_is_no_figure(tmp_path: Path) -> None:
    white = (
        '<rect width="300" height="300" fill="#222"/><circle cx="150" cy="150" r="50" fill="#fff"/>'
    )
    pixels = read(tmp_path, f"{HEAD}{white}</svg>")
    assert (pixels[0] == (0x22, 0x22, 0x22, 255)).all()
    assert (pixels[len(pixels) // 2, pixels.shape[1] // 2] == 255).all()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (f"{HALF}<text x='9' y='90'>A</text>", "has an element <text>: convert it to paths"),
        ('<image href="/etc/passwd"/>', "has an element <image>: give the picture itself"),
        ('<filter id="f"/>', "has an element <filter>: leave effects"),
        (f'<g style="filter: blur(9999px)">{HALF}</g>', "a style with a filter: leave effects"),
        (f'<g style="transform:scale(2)">{HALF}</g>', "a style with a transform: write it as"),
        ('<path d="M 1 1 L 9 9"/>', "draws nothing that has an area"),
        ("<script>alert(1)</script>", "draws nothing that has an area"),
        ("<g>", "is not XML"),
        (f"{'<g>' * 60}{'</g>' * 60}", "nests deeper than 50 groups: ungroup it"),
        (HALF * MANY, "has more than 2000 tags: draw its outline alone"),
        (" " * 5 * MIB, "is larger than"),
    ],
    ids=range(11),
)
def test_what_cannot_be_used_is_refused_by_its_name(
    tmp_path: Path, content: str, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        read(tmp_path, f"{HEAD}{content}</svg>")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('<!DOCTYPE svg [<!ENTITY a "b">]><svg>&a;</svg>', "no ENTITY and no DOCTYPE with"),
        ("<html/>", "must be an <svg> element, got <html>"),
        ("", "is not XML"),
    ],
)
def test_what_is_no_drawing_is_refused(tmp_path: Path, content: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read(tmp_path, content)


def test_a_drawing_that_multiplies_itself_is_soon_given_up(tmp_path: Path) -> None:
    twice = "".join(
        f'<g id="a{i + 1}"><use href="#a{i}"/><use href="#a{i}" x="1"/></g>' for i in range(30)
    )
    content = (
        f'{HEAD}<defs><rect id="a0" width="1" height="1"/>{twice}</defs><use href="#a30"/></svg>'
    )
    with pytest.raises(ConfigError, match="draws nothing"):
        read(tmp_path, content)
