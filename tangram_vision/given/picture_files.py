"""Read an untrusted picture file as a picture in colour."""

import struct
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from tangram_core.arrays import Floats
from tangram_core.errors import ConfigError
from tangram_sim.puzzles.sketches import check_file
from tangram_vision.given.svg_files import read_svg

# Formats that Pillow reads by itself. EPS, for example, would start another program.
FORMATS = ("PNG", "JPEG", "WEBP", "GIF", "TIFF", "BMP", "AVIF", "PPM")
READ = (
    *(".png", ".jpg", ".jpeg", ".webp", ".gif", ".tif", ".tiff", ".bmp", ".avif", ".ppm", ".svg"),
)
MAX_MEGAPIXELS = 64
MIN_SIDE = 32
LONGEST = 1280  # pixels along the longer side; a larger picture is reduced
_PAPER, _SLATE = (255, 255, 255), (0, 0, 0)  # ground of a dark, and of a light transparent picture
_LIGHT = 200  # mean level from which a picture is light
# Errors of Pillow for broken files.
_BROKEN = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    TypeError,
    LookupError,
    RuntimeError,
    struct.error,
)


class Given(NamedTuple):
    """The picture of a file.

    Attributes:
        picture: the picture in colour, upright, at most LONGEST pixels along its longer side.
        size: width and height of the file's own page.
        own: homography (3, 3) from points of the picture to points of that page.
    """

    picture: Image.Image
    size: tuple[float, float]
    own: Floats


def read_picture(path: Path, source: str) -> Given:
    """Read a picture, and its position in the file's page.

    Args:
        path: path of the file.
        source: name of the file in errors.

    Raises:
        ConfigError: the file is missing, broken, too large or too small, or is neither an SVG nor
            one of `FORMATS`.
    """
    check_file(path, source)
    if path.suffix.lower() == ".svg":
        drawn, size, own = read_svg(path, source)
        picture, share = _upright(drawn)
        return Given(picture, size, own @ share)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path, formats=FORMATS) as image:
                _check_size(image, source)
                picture, share = _upright(image)
                width, height = share.diagonal()[:2] * picture.size
                return Given(picture, (round(width), round(height)), share)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise ConfigError(_too_large(source)) from None
    except _BROKEN as error:
        why = "" if isinstance(error, UnidentifiedImageError) else f" ({error})"
        kind = path.suffix[1:].upper() or "picture"
        raise ConfigError(
            f"{source} is no {kind} that can be read{why}: save it anew as PNG or JPEG"
        ) from None


def _too_large(source: str) -> str:
    return f"{source} has more than {MAX_MEGAPIXELS} million pixels: make it smaller"


def _check_size(image: Image.Image, source: str) -> None:
    width, height = image.size
    if width * height > MAX_MEGAPIXELS * 1_000_000:
        raise ConfigError(_too_large(source))
    if min(width, height) < MIN_SIDE:
        raise ConfigError(
            f"{source} has {width} x {height} pixels, but at least {MIN_SIDE} along each side are "
            "needed: take a larger picture"
        )


def _upright(image: Image.Image) -> tuple[Image.Image, Floats]:
    """The image in colour, upright and reduced; and the homography to its unreduced points."""
    if image.mode[0] in "IF":  # grey of more than 8 bits
        levels = np.nan_to_num(np.asarray(image, np.float64))
        levels -= levels.min()
        image = Image.fromarray((levels / (levels.max() or 1.0) * 255.0).astype(np.uint8))
    if image.mode in ("1", "P", "PA", "LA") or "transparency" in image.info:
        image = image.convert("RGBA")
    image = ImageOps.exif_transpose(image)
    width, height = image.size
    image.thumbnail((LONGEST, LONGEST), Image.Resampling.BOX)
    own = np.diag([width / image.width, height / image.height, 1.0])
    if image.mode == "RGBA":
        levels = np.asarray(image.convert("LA"), np.float64)
        there = levels[..., 1].sum() or 1.0
        light = there < levels[..., 1].size * 255.0 and levels.prod(axis=-1).sum() / there > _LIGHT
        paper = Image.new("RGBA", image.size, _SLATE if light else _PAPER)
        image = Image.alpha_composite(paper, image)
    return image.convert("RGB"), own
