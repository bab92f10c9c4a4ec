"""A drawing as SVG, read without trust -> a picture of what it shows, by resvg.

resvg is a fast program, not a wary one: what would keep it busy for minutes, or end it, is refused
before. Text hangs on the fonts of a machine, so it is refused, too.
"""

import base64
import re
from io import BytesIO
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import resvg_py
from PIL import Image

from tangram_core.errors import ConfigError
from tangram_sim.puzzles.sketches import read_text

SIDE = 2400  # pixels of a square that the whole drawing goes into
MAX_TAGS, MAX_DEPTH = 2_000, 50
_BORDER = SIDE // 8  # around it
_REFUSED = {
    "text": "convert it to paths",
    "image": "give the picture itself",
    "filter": "leave effects such as shadows out",
}
_STYLES = {"filter": _REFUSED["filter"], "transform": "write it as an attribute"}
_FRAME = (
    '<svg xmlns="http://www.w3.org/2000/svg" width="{side}" height="{side}"><image width="{side}" '
    'height="{side}" href="data:image/svg+xml;base64,{content}"/></svg>'
)


def read_svg(path: Path, source: str) -> Image.Image:
    """What a file draws, with transparency, and around it a border of its ground.

    Raises:
        ConfigError: it cannot be used, and why.
    """
    text = read_text(path, source)
    _check(text, source)
    # As a picture in another one it stays within this size, and reads no other file.
    frame = _FRAME.format(side=SIDE, content=base64.b64encode(text.encode()).decode())
    drawn = bytes(resvg_py.svg_to_bytes(svg_string=frame, shape_rendering="crisp_edges"))
    pixels = np.asarray(Image.open(BytesIO(drawn)).convert("RGBA"))
    there = np.flatnonzero(pixels[..., 3].any(axis=0)), np.flatnonzero(pixels[..., 3].any(axis=1))
    if not len(there[0]):
        raise ConfigError(f"{source} draws nothing that has an area: draw an outline")
    (left, *_, right), (top, *_, low) = (one[[0, -1]] for one in there)
    fills = SIDE in (right + 1 - left, low + 1 - top)
    pixels = pixels[top : low + 1, left : right + 1]
    rim = np.concatenate([pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]])
    # One colour all around the whole drawing, and another inside of it: that is its ground.
    on_ground = fills and (rim == rim[0]).all() and (pixels != rim[0]).any()
    ground = rim[0] if on_ground and (pixels[..., 3] > 0).all() else np.zeros(4, np.uint8)
    whole = np.empty((len(pixels) + 2 * _BORDER, pixels.shape[1] + 2 * _BORDER, 4), np.uint8)
    whole[:] = ground
    whole[_BORDER:-_BORDER, _BORDER:-_BORDER] = pixels
    return Image.fromarray(whole)


def _check(text: str, source: str) -> None:
    """Refuse what would take long, and what would be drawn otherwise elsewhere."""
    waiting = [(_parsed(text, source), 0)]
    for name, remedy in _STYLES.items():
        if re.search(rf"(?<![-\w]){name}\s*:\s*(?!none)", text):
            raise ConfigError(f"{source} has a style with a {name}: {remedy}")
    while waiting:
        element, depth = waiting.pop()
        if depth > MAX_DEPTH:
            raise ConfigError(f"{source} nests deeper than {MAX_DEPTH} groups: ungroup it")
        if (tag := _tag(element)) in _REFUSED:
            raise ConfigError(f"{source} has an element <{tag}>: {_REFUSED[tag]}")
        if tag != "foreignObject":  # no part of a drawing: labels in HTML
            waiting += [(child, depth + 1) for child in element]


def _parsed(text: str, source: str) -> ET.Element:
    if text.count("<") > MAX_TAGS:
        raise ConfigError(f"{source} has more than {MAX_TAGS} tags: draw its outline alone")
    if re.search(r"<!\s*(doctype[^<>]*\[|entity)", text, re.IGNORECASE):
        raise ConfigError(f"{source} must have no ENTITY and no DOCTYPE with [...]: delete them")
    try:
        # Entities are the danger of XML, and none can be defined without a [...] of DOCTYPE.
        root = ET.fromstring(text)  # noqa: S314
    except (ET.ParseError, ValueError) as error:
        raise ConfigError(f"{source} is not XML: {error}") from None
    if _tag(root) != "svg":
        raise ConfigError(f"{source} must be an <svg> element, got <{_tag(root)}>")
    return root


def _tag(element: ET.Element) -> str:
    return str(element.tag).rpartition("}")[2]
