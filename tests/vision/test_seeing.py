"""What pictures show of tokens: one, several, in piles, and what they do not."""

from itertools import permutations
from typing import Any

import numpy as np
import pytest

from tangram_core.arrays import Floats, Singles
from tangram_sim.config import SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.sight.perception import Look
from tangram_sim.sight.pictures import coverage, rasterise
from tangram_sim.targets.connected import sample_connected
from tangram_sim.targets.sampling import sample_batch
from tangram_vision.pictures.blobs import find_blobs
from tangram_vision.pictures.seeing import see
from tests.sim.builders import LOPSIDED, SEVEN, layout_of, pieces

pytestmark = pytest.mark.fast

ARENA = 2.0
TANS = sorted(set(SEVEN))


def shown(corners: Floats, layout: Layout, pixels: int, times: int = 4) -> Singles:
    """Coverage by tokens with corners (V, 2)."""
    large = coverage(rasterise(corners, layout, ARENA, pixels * times))
    return large.reshape(pixels, times, pixels, times).mean(axis=(1, 3))


def errors(layout: Layout, poses: Floats, flipped: Any, seen: Look) -> Floats:
    """(K, 2) distance and degrees of each token from where it was seen, alike ones in any order."""
    names = [shape.name for shape in layout.shapes]
    best: dict[str, list[tuple[float, float]]] = {}
    for name in set(names):
        own = [k for k in range(layout.tokens) if names[k] == name]
        tries = [
            [_error(layout, poses, flipped, seen, *pair) for pair in zip(own, order, strict=True)]
            for order in permutations(own)
        ]
        best[name] = min(tries, key=lambda one: sum(distance for distance, _ in one))
    return np.array([best[name].pop(0) for name in names])


def _error(
    layout: Layout, poses: Floats, flipped: Any, seen: Look, token: int, as_token: int
) -> tuple[float, float]:
    if not seen.sure[as_token] or seen.flipped[as_token] != flipped[token]:
        return np.inf, np.inf
    turn = np.pi / layout.symmetries[token]
    off = seen.poses[as_token] - poses[token]
    return float(np.hypot(*off[:2])), float(np.degrees(abs((off[2] + turn) % (2 * turn) - turn)))


def scene(layout: Layout, rng: np.random.Generator, gap: float) -> tuple[Floats, Any]:
    """Poses and sides of tokens that lie so far apart, arena units."""
    while True:
        flipped = (rng.random(layout.tokens) < 0.5) & layout.chiral
        poses = sample_batch(layout, SimConfig(), [rng], flipped[None])[0]
        own = pieces(layout, poses, flipped)
        if all(one.distance(two) >= gap for i, one in enumerate(own) for two in own[:i]):
            return poses, flipped


@pytest.mark.parametrize("shape", [*TANS, LOPSIDED], ids=str)
@pytest.mark.parametrize(("pixels", "near", "degrees"), [(128, 0.003, 0.6), (64, 0.006, 3.0)])
def test_one_token_is_seen(shape: Any, pixels: int, near: float, degrees: float) -> None:
    scale = 0.6 if isinstance(shape, str) else 0.12
    layout, rng = layout_of(shape, scale=scale), np.random.default_rng(0)
    for _ in range(6):
        poses, flipped = scene(layout, rng, 0.0)
        corners = layout.corners(poses, flipped)
        seen = see(shown(corners, layout, pixels), layout, ARENA)
        [[distance, turn]] = errors(layout, poses, flipped, seen)
        assert distance < near
        assert turn < degrees


def test_seven_tokens_two_pixels_apart_are_seen() -> None:
    layout, rng = layout_of(*SEVEN, scale=0.6), np.random.default_rng(1)
    for _ in range(5):
        poses, flipped = scene(layout, rng, 2 * ARENA / 128)
        seen = see(shown(layout.corners(poses, flipped), layout, 128), layout, ARENA)
        assert (errors(layout, poses, flipped, seen) < (0.01, 2.0)).all()


@pytest.mark.parametrize(
    "names",
    [
        ("square", "large_triangle"),
        ("parallelogram", "square"),
        ("large_triangle", "square", "small_triangle"),
    ],
)
def test_tokens_that_touch_are_seen(names: tuple[str, ...]) -> None:
    layout, rng = layout_of(*names, scale=0.6), np.random.default_rng(2)
    every = []
    for _ in range(4):
        poses = sample_connected(layout, SimConfig(), rng)
        sides = np.zeros(layout.tokens, np.bool_)
        seen = see(shown(layout.corners(poses), layout, 128), layout, ARENA)
        off = errors(layout, poses, sides, seen)
        # What could as well lie otherwise is not told as sure.
        every.append((off < (0.01, 2.0)).all() or not seen.sure.all())
        assert np.isinf(off).any() or (off < (0.01, 2.0)).all()
    assert all(every)


def test_what_has_two_explanations_is_doubtful() -> None:
    """Two small triangles make a square: along which diagonal they meet, no picture tells."""
    layout = layout_of("small_triangle", "small_triangle", scale=0.6)
    other = layout_of("square", scale=0.6)
    picture = shown(other.corners(np.array([[0.1, 0.2, 0.5]])), other, 128)
    seen = see(picture, layout, ARENA)
    assert seen.known.all()
    assert not seen.sure.any()


def test_which_of_two_blobs_is_a_pile_is_doubtful() -> None:
    """Two small triangles make a medium one, and another medium one lies beside them."""
    layout = layout_of("medium_triangle", "small_triangle", "small_triangle", scale=0.6)
    other = layout_of("medium_triangle", "medium_triangle", scale=0.6)
    places = np.array([[0.4, 0.2, 0.5], [-0.4, 0.2, 2.0]])
    seen = see(shown(other.corners(places), other, 128), layout, ARENA)
    assert seen.known.all()
    assert not seen.sure.any()


PILES = {
    "what explains best is not found first": [
        *([-0.522, -0.041, -3.134], [-0.774, 0.705, 0.187], [-0.495, 0.3, -1.564]),
        *([-0.151, -0.661, -0.905], [-0.452, 0.171, 1.578], [-0.232, -0.5, -2.475]),
        [-0.394, -0.588, -0.905],
    ],
    "rough corners": [
        *([-0.186, 0.214, 0.95], [-0.665, 0.184, -0.316], [0.494, -0.228, -1.612]),
        *([0.123, 0.142, -2.977], [-0.013, 0.091, -2.192], [0.478, -0.021, 3.1]),
        [0.492, -0.428, 0.744],
    ],
}


@pytest.mark.parametrize("poses", PILES.values(), ids=PILES)
def test_seven_tokens_in_piles_are_seen(poses: list[list[float]]) -> None:
    layout, sides = layout_of(*SEVEN, scale=0.6), np.zeros(7, np.bool_)
    seen = see(shown(layout.corners(np.array(poses)), layout, 128), layout, ARENA)
    assert (errors(layout, np.array(poses), sides, seen) < (0.01, 2.0)).all()


@pytest.mark.parametrize("what", ["nothing", "half of it", "another shape"])
def test_what_is_not_to_be_seen_is_missing(what: str) -> None:
    layout, other = layout_of("square", scale=0.6), layout_of("large_triangle", scale=0.6)
    pictures = {
        "nothing": np.zeros((64, 64), np.float32),
        "half of it": shown(layout.corners(np.array([[1.0, 0.0, 0.3]])), layout, 64),
        "another shape": shown(other.corners(np.zeros((1, 3))), other, 64),
    }
    seen = see(pictures[what], layout, ARENA)
    assert not seen.sure.any()
    assert not seen.known[0]


@pytest.mark.parametrize("beyond", [1.0, 3.0])
@pytest.mark.parametrize("shape", TANS)
def test_what_reaches_the_edge_of_the_picture_is_seen(shape: str, beyond: float) -> None:
    """A camera that is shifted by 2 px cuts tokens that lie in the arena."""
    layout, rng = layout_of(shape, scale=0.8), np.random.default_rng(7)
    for _ in range(4):
        poses, flipped = scene(layout, rng, 0.0)
        edge = ARENA / 2.0 + beyond * ARENA / 128
        poses[0, 1] += edge - layout.corners(poses, flipped)[:, 1].max()
        seen = see(shown(layout.corners(poses, flipped), layout, 128), layout, ARENA)
        [[distance, turn]] = errors(layout, poses, flipped, seen)
        assert distance < 0.002
        assert turn < 0.6


def test_specks_as_large_as_a_token_end_nothing_however_many() -> None:
    speck = np.pad(np.ones((4, 4), np.float32), 2)
    side = 4.0 * ARENA / 320
    layout = layout_of({"name": "speck", "corners": [[0, 0], [side, 0], [side, side], [0, side]]})
    cover = np.tile(speck, (40, 40))
    assert 0 < len(find_blobs(cover, 1.0)) < 40 * 40
    assert see(cover, layout, ARENA).known.all()
