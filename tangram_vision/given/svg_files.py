"""Draw an untrusted SVG file with resvg.

resvg is fast, but a small hostile file can keep it busy for minutes, or crash it. So it runs in a
process of its own, with limits on time and memory.
"""

import base64
import re
import subprocess
import sys
from io import BytesIO
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from PIL import Image

from tangram_core.arrays import AnyArray, Floats
from tangram_core.errors import ConfigError
from tangram_sim.puzzles.sketches import read_text
from tangram_vision.silhouettes.tilts import shift

SIDE = 2400  # pixels along the square that the drawing is fitted into
SECONDS, BYTES = 10, 2 << 30  # limits for resvg
_BORDER = SIDE // 8  # pixels around the drawing
_SLACK = 3.0  # pixels beyond the page that do not count
_SEEN = 24  # levels of any colour by which a figure differs from its ground
_REFUSED = {"text": "convert it to paths", "image": "give the picture itself"}
# An SVG within another one as an image keeps this size, and cannot read other files.
_FRAME = (
    '<svg xmlns="http://www.w3.org/2000/svg" width="{side}" height="{side}"><image width="{side}" '
    'height="{side}" href="data:image/svg+xml;base64,{content}"/></svg>'
)
_DRAW = """
import resource, sys, resvg_py
size, seconds = map(int, sys.argv[1:])
resource.setrlimit(resource.RLIMIT_AS, (size, size))
resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
drawn = resvg_py.svg_to_bytes(svg_string=sys.stdin.read(), dpi=96.0, shape_rendering="crisp_edges")
sys.stdout.buffer.write(bytes(drawn))
"""


def read_svg(path: Path, source: str) -> tuple[Image.Image, tuple[float, float], Floats]:
    """Draw an SVG file in black on white, with a border.

    Returns:
        The picture; width and height of the page, in units of its viewBox; and the homography
        (3, 3) from points of the picture to points of the page, whose origin is its upper left
        corner. If the page has no size in numbers, or is stretched, the picture is the page.

    Raises:
        ConfigError: the file cannot be used; says why.
    """
    text = read_text(path, source)
    root = _checked(text, source)
    pixels = _drawn(text, source)
    there = np.flatnonzero(pixels[..., 3].any(axis=0)), np.flatnonzero(pixels[..., 3].any(axis=1))
    if not len(there[0]):
        raise ConfigError(f"{source} draws nothing that has an area: draw an outline")
    (left, *_, right), (top, *_, low) = (one[[0, -1]] for one in there)
    page = _page(root)
    told = [re.match(r"\d+(\.\d+)?(?!.*%)", root.get(name, "")) for name in ("width", "height")]
    shown = pixels[top : low + 1, left : right + 1]
    figure = _figure(shown)
    # A page of another colour than white would itself look like a figure.
    opaque = max(shown.shape[:2]) >= SIDE - 1 and shown[..., 3].all()
    if not (opaque and (shown[0, 0, :3] < 256 - _SEEN).any()) and _reaches_out(root, page, source):
        raise ConfigError(
            f"{source} is cut off: it reaches out of its page: enlarge its viewBox, or width "
            "and height"
        )
    picture = Image.fromarray(np.where(np.pad(figure, _BORDER), 0, 255).astype(np.uint8))
    if page is None:
        return picture, picture.size, np.eye(3)
    width, height = page[2:].tolist()
    wide, high = (float(one[0]) for one in told if one) if all(told) else (width, height)
    if not np.isclose(wide * height, high * width, rtol=0.01):  # stretched, or with more around it
        return picture, picture.size, np.eye(3)
    unit = SIDE / max(width, height)
    # The page is centred in the square.
    right, down = np.array([left, top]) - _BORDER - SIDE / 2.0 + unit * page[2:] / 2.0
    return picture, (width, height), np.diag([1.0 / unit, 1.0 / unit, 1.0]) @ shift(right, down)


def _figure(pixels: AnyArray) -> AnyArray:
    """(H, W) whether pixels (H, W, 4) belong to the figure.

    The ground is the colour around an opaque drawing, if that is one colour; otherwise white. A
    drawing that is all white on a transparent ground is the figure.
    """
    colour, there = pixels[..., :3].astype(np.int64), pixels[..., 3] > 127
    rim = np.concatenate([colour[0], colour[-1], colour[:, 0], colour[:, -1]])
    on_ground = there.all() and (rim == rim[0]).all()
    for ground in ([rim[0]] if on_ground else []) + [np.full(3, 255)]:
        found: AnyArray = there & (np.abs(colour - ground).max(axis=-1) >= _SEEN)
        if found.any():
            return found
    return np.asarray(there)


def _drawn(text: str, source: str) -> AnyArray:
    """(SIDE, SIDE, 4) colours and opacity."""
    frame = _FRAME.format(side=SIDE, content=base64.b64encode(text.encode()).decode())
    command = [sys.executable, "-I", "-c", _DRAW, str(BYTES), str(SECONDS)]
    try:
        done = subprocess.run(
            command, input=frame.encode(), capture_output=True, timeout=2 * SECONDS, check=True
        )
    except subprocess.SubprocessError as error:
        if b"ModuleNotFoundError" in (getattr(error, "stderr", None) or b""):
            raise ConfigError(
                f"{source} needs resvg, which is missing: pip install resvg-py"
            ) from None
        raise ConfigError(
            f"{source} cannot be drawn in {SECONDS} s and {BYTES >> 30} GB: remove its filters "
            "and nested groups, or give a PNG of it"
        ) from None
    drawn: AnyArray = np.asarray(Image.open(BytesIO(done.stdout)).convert("RGBA"))
    return drawn


def _page(root: ET.Element) -> Floats | None:
    """(4,) left, top, width and height of the page in its own units; None if unknown."""
    told = root.get("viewBox") or "0 0 {} {}".format(
        *((root.get(name) or "").removesuffix("px") for name in ("width", "height"))
    )
    try:
        page = np.array([float(one) for one in re.split(r"[\s,]+", told.strip())])
    except ValueError:
        return None
    told_all = page.shape == (4,) and np.isfinite(page).all()
    return page if told_all and page[2:].min() > 0.0 else None


def _reaches_out(root: ET.Element, page: Floats | None, source: str) -> bool:
    """Whether something is drawn beyond the page; a rectangle that covers the page is ignored.

    False, too, if that is unknown: the page has no size in numbers, or other sizes depend on it.
    """
    if page is None:
        return False
    x, y, width, height = page.tolist()
    for parent in root.iter():
        for child in [one for one in parent if one.get("width") == one.get("height") == "100%"]:
            parent.remove(child)
    if any("%" in value for one in root.iter() for value in one.attrib.values() if one is not root):
        return False
    for name in ("width", "height", "preserveAspectRatio"):
        root.attrib.pop(name, None)
    root.set("viewBox", f"{x - width} {y - height} {3.0 * width} {3.0 * height}")
    drawn = _figure(_drawn(ET.tostring(root, encoding="unicode"), source))
    pixels = SIDE / (3.0 * max(width, height))
    for axis, length in ((0, width), (1, height)):
        ink = np.flatnonzero(drawn.any(axis=axis)) + 0.5 - SIDE / 2.0
        if len(ink) and np.abs(ink).max() > length * pixels / 2.0 + _SLACK:
            return True
    return False


def _checked(text: str, source: str) -> ET.Element:
    """The root of an SVG that can be drawn.

    Raises:
        ConfigError: the text is no SVG, or looks different elsewhere, as text with other fonts.
    """
    if re.search(r"<!\s*(doctype[^<>]*\[|entity)", text, re.IGNORECASE):
        raise ConfigError(
            f"{source} must have no ENTITY and no DOCTYPE with [...]: write out what each &name; "
            "stands for, then delete them, or give a PNG of it"
        )
    try:
        # Only entities make XML dangerous, and none can be defined without DOCTYPE [...].
        root = ET.fromstring(text)  # noqa: S314
    except (ET.ParseError, ValueError) as error:
        raise ConfigError(
            f"{source} is not XML ({error}): save it anew as SVG, or give a PNG of it"
        ) from None
    for parent in [*root.iter()]:
        for child in [one for one in parent if str(one.tag).endswith("metadata")]:
            parent.remove(child)
    tags = [str(element.tag).rpartition("}")[2] for element in root.iter()]
    if tags[0] != "svg":
        raise ConfigError(f"{source} is no <svg> but a <{tags[0]}>: save the <svg> in it alone")
    for tag in _REFUSED.keys() & {*tags}:
        raise ConfigError(f"{source} has an element <{tag}>: {_REFUSED[tag]}")
    styles = [one.get("style", "") for one in root.iter()]
    styles += [one.text or "" for one in root.iter() if str(one.tag).endswith("style")]
    moves = r"(?<![-\w])(transform|rotate|scale|translate)\s*:(?!\s*none)"
    if any(re.search(moves, style) for style in styles):
        raise ConfigError(
            f"{source} has a style with a transform, rotate, scale or translate: write it as the "
            "attribute transform, without px and deg"
        )
    return root
