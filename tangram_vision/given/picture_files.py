"""A picture file that a person gives, read without trust -> a picture in colour."""

import struct
import warnings
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from tangram_core.errors import ConfigError
from tangram_sim.puzzles.sketches import check_file
from tangram_vision.given.svg_files import read_svg

# Those of them that Pillow reads by itself; EPS, say, starts another program.
FORMATS = ("PNG", "JPEG", "WEBP", "GIF", "TIFF", "BMP", "AVIF", "PPM")
READ = (
    *(".png", ".jpg", ".jpeg", ".webp", ".gif", ".tif", ".tiff", ".bmp", ".avif", ".ppm", ".svg"),
)
MAX_MEGAPIXELS = 64
MIN_SIDE = 32
LONGEST = 1280  # pixels of the longer side that are looked at
_PAPER, _SLATE = (255, 255, 255), (0, 0, 0)  # behind what is transparent and dark, and light
_LIGHT = 200  # mean level of what is light
# What Pillow raises where a file is not what it says.
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


def read_picture(path: Path, source: str) -> Image.Image:
    """A file's picture in colour, upright, at most LONGEST pixels along its longer side.

    Args:
        path: of the file.
        source: what errors call it.

    Raises:
        ConfigError: no file, none of `FORMATS` or SVG that can be read, too large or too small.
    """
    check_file(path, source)
    if path.suffix.lower() == ".svg":
        return _upright(read_svg(path, source))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path, formats=FORMATS) as image:
                _check_size(image, source)
                return _upright(image)
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
            f"{source} has {width} x {height} pixels, and at least {MIN_SIDE} along each side are "
            "needed: take a larger picture"
        )


def _upright(image: Image.Image) -> Image.Image:
    if image.mode.startswith("I"):  # 16 bits of grey
        levels = np.clip(np.asarray(image) >> 8, 0, 255)
        image = Image.fromarray(levels.astype(np.uint8))
    if image.mode in ("1", "P", "PA", "LA") or "transparency" in image.info:
        image = image.convert("RGBA")
    image.thumbnail((LONGEST, LONGEST), Image.Resampling.BOX)
    image = ImageOps.exif_transpose(image)
    if image.mode == "RGBA":
        levels = np.asarray(image.convert("LA"), np.float64)
        there = levels[..., 1].sum() or 1.0
        light = there < levels[..., 1].size * 255.0 and levels.prod(axis=-1).sum() / there > _LIGHT
        paper = Image.new("RGBA", image.size, _SLATE if light else _PAPER)
        image = Image.alpha_composite(paper, image)
    return image.convert("RGB")
