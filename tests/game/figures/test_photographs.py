"""tangram-play target=: photographs of tokens, drawn here, and pictures that show none."""

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageDraw

from tangram_agent.runs import load_run
from tangram_core.arrays import Floats
from tangram_core.errors import ConfigError
from tangram_game.config import PlayConfig
from tangram_game.play import play_run
from tangram_sim.drawing.strokes import colour_of
from tangram_sim.geometry.layout import Layout
from tangram_vision.given.photos import find_tokens
from tangram_vision.given.picture_files import MAX_MEGAPIXELS, read_picture
from tests.sim.builders import TRIO, layout_of

pytestmark = pytest.mark.fast

UNIT = 150.0  # pixels
LAYOUT = layout_of(*TRIO, scale=0.8)
POSES = np.array([[-0.7, 0.3, 0.4], [0.1, 0.5, 2.0], [0.6, -0.4, -1.0]])
FLIPPED = np.array([False, False, True])
NAMES = "square, small_triangle, parallelogram"


def levels(
    layout: Layout, poses: Floats, ground: int = 220, token: int = 60, size: Any = (450, 300)
) -> Floats:
    """Levels of tokens around the middle of a photograph, drawn large and averaged."""
    times, corners = 4, layout.corners(poses, FLIPPED[: layout.tokens])
    canvas = Image.new("L", (size[0] * times, size[1] * times), ground)
    middle = np.array(size) / 2.0
    for k in range(layout.tokens):
        own = (corners[layout.corners_of(k)] * (UNIT, -UNIT) + middle) * times - 0.5
        ImageDraw.Draw(canvas).polygon([(float(x), float(y)) for x, y in own], token)
    return np.asarray(canvas.reduce(times), np.float64)


def photo(path: Path, shown: Floats, **save: Any) -> str:
    Image.fromarray(np.clip(shown, 0, 255).astype(np.uint8)).save(path, **save)
    return str(path)


def found(path: Path, layout: Layout = LAYOUT) -> Any:
    return find_tokens(read_picture(path, "target=it").picture, layout, "target=it")


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("bad", ["", "light", "noise", "pile"])
def test_tokens_are_found_where_they_lie(tmp_path: Path, dark: bool, bad: str) -> None:
    poses = POSES.copy()
    if bad == "pile":
        poses[1, :2] = (-0.41, 0.3)
    shown = levels(LAYOUT, poses, *((30, 200) if dark else (220, 60)))
    if bad == "light":
        shown *= np.linspace(0.6, 1.1, 450)
    if bad == "noise":
        shown += np.random.default_rng(0).normal(0.0, 8.0, shown.shape)
    photo(tmp_path / "it.jpg", shown, quality=80)
    seen = found(tmp_path / "it.jpg")
    assert seen.unit == pytest.approx(UNIT, rel=0.01)
    where = seen.poses[:, :2] * seen.unit / UNIT - np.array([1.5, -1.0])
    np.testing.assert_allclose(where, poses[:, :2], atol=0.01)
    turn = 2.0 * np.pi / LAYOUT.symmetries
    off = (seen.poses[:, 2] - poses[:, 2] + turn / 2.0) % turn - turn / 2.0
    np.testing.assert_allclose(np.degrees(off), 0.0, atol=1.0)
    np.testing.assert_array_equal(seen.flipped, FLIPPED)


@pytest.mark.parametrize("share", [0.4, 0.6, 0.8])
@pytest.mark.parametrize("dark", [False, True])
def test_a_token_may_cover_most_of_a_photograph(tmp_path: Path, dark: bool, share: float) -> None:
    """The ground is what the picture's border shows."""
    layout, side = layout_of("square", scale=0.8), 400
    unit = side * np.sqrt(share / float(layout.areas[0]))
    canvas = Image.new("L", (side, side), 20 if dark else 250)
    corners = layout.corners(np.zeros((1, 3))) * unit + side / 2.0
    ImageDraw.Draw(canvas).polygon([(x, y) for x, y in corners.tolist()], 250 if dark else 20)
    canvas.save(tmp_path / "it.png")
    picture = read_picture(tmp_path / "it.png", "it").picture
    assert find_tokens(picture, layout, "it").unit == pytest.approx(unit, rel=0.01)


@pytest.mark.parametrize("mode", ["RGBA", "P", "I;16", "upright", "one level"])
def test_every_kind_of_file_shows_the_same(tmp_path: Path, mode: str) -> None:
    grey = levels(LAYOUT, POSES).astype(np.uint8)
    exif = Image.Exif()
    if mode == "I;16":
        picture = Image.fromarray(grey.astype(np.uint16) * 257)
    elif mode == "upright":
        picture = Image.fromarray(np.rot90(grey))
        exif[0x0112] = 6  # the camera was held upright
    elif mode == "one level":  # and another that is transparent
        picture = Image.fromarray(np.where(grey < 140, 60, 61).astype(np.uint8))
        picture.info["transparency"] = 61
    else:
        picture = Image.fromarray(grey).convert(mode)
    if mode == "RGBA":  # nothing but the tokens is drawn
        picture.putalpha(Image.fromarray(np.where(grey < 200, 255, 0).astype(np.uint8)))
    picture.save(tmp_path / "it.png", exif=exif)
    read = read_picture(tmp_path / "it.png", "it").picture
    assert (read.mode, read.size) == ("RGB", (450, 300))
    assert found(tmp_path / "it.png").unit == pytest.approx(UNIT, rel=0.02)


def crowd() -> Floats:
    return np.tile(np.pad(np.full((10, 10), 60.0), 5, constant_values=220.0), (15, 20))


REFUSED = {
    "crowd": (crowd(), f"shows more than 40 areas, and the run moves {NAMES}: lay them all "),
    "one": (
        levels(layout_of("square"), POSES[:1]),
        "shows 1 area, by shape no token alone, and the ",
    ),
    "cut": (
        levels(LAYOUT, POSES + (1.0, 0.0, 0.0)),
        rf"shows 2 areas \(1 more at its edge .*the run moves {NAMES} .not found: .*.: lay",
    ),
    "dirt": (
        np.random.default_rng(0).integers(0, 256, (600, 600)).astype(np.float64),
        r"shows .* areas \(.*\), by shape no token alone, and the run moves",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_was_found_instead_is_told(tmp_path: Path, name: str) -> None:
    shown, expected = REFUSED[name]
    photo(tmp_path / "it.png", shown)
    with pytest.raises(ConfigError, match=f"^target=it {expected}") as raised:
        found(tmp_path / "it.png")
    assert "\n" not in str(raised.value)


def test_files_that_are_no_pictures_are_refused(tmp_path: Path) -> None:
    path, whole = tmp_path / "it.png", tmp_path / "whole.png"
    photo(whole, levels(LAYOUT, POSES))
    large = [b"IHDR" + struct.pack(">II", side, side) + b"\1\0\0\0\0" for side in (9000, 20000)]
    for content, expected in (
        (whole.read_bytes()[:-600], r"is no PNG that can be read \(.+\): save it anew"),
        *(
            (
                whole.read_bytes()[:12] + head + struct.pack(">II", zlib.crc32(head), 0) + b"IDAT",
                f"has more than {MAX_MEGAPIXELS} million pixels: make it smaller",
            )
            for head in large
        ),
    ):
        path.write_bytes(content)
        with pytest.raises(ConfigError, match=f"^target=it {expected}"):
            found(path)


def test_what_was_seen_is_drawn_before_the_film(tmp_path: Path) -> None:
    layout = load_run("pretrained/square").task.layout
    target = photo(tmp_path / "it.jpg", levels(layout, POSES[:1]), quality=80)
    sizes = []
    for out in ("it.gif", "it.png"):
        config = PlayConfig("pretrained/square", out=str(tmp_path / out), target=target)
        play_run(config)
        with Image.open(tmp_path / out) as picture:
            sizes.append(picture.size)
            first = np.asarray(picture.convert("RGB"), np.int64)
        near = np.abs(first[:, : sizes[0][0]] - colour_of(0)).sum(axis=2) < 60
        # The GIF begins with an outline, no filled token.
        rows, columns = np.nonzero(near)
        box = np.ptp(rows) * np.ptp(columns)
        assert 0 < near.sum() < box / 4
    assert sizes[1][0] > 2 * sizes[0][0]


def test_a_photograph_is_instead_of_other_targets() -> None:
    with pytest.raises(ConfigError, match="^sim.targets=uniform changes nothing with target: "):
        PlayConfig(target="it.png", changes={"sim": {"targets": "uniform"}})
    assert PlayConfig(target="it.png").run == "pretrained/tangram7"


def test_a_photograph_is_not_written_over(tmp_path: Path) -> None:
    target, link = photo(tmp_path / "it.png", levels(LAYOUT, POSES)), tmp_path / "link.png"
    link.symlink_to(target)
    for out in (target, str(link)):
        with pytest.raises(ConfigError, match="^out=.* would overwrite target=.*it.png: "):
            PlayConfig(out=out, target=target)
    PlayConfig(out=str(tmp_path / "another.png"), target=target)
