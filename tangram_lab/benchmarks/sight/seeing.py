"""How exactly, how surely and how fast tokens are found in pictures of the engine's camera."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

from tangram_core.arrays import Bools, Floats, Pixels
from tangram_lab.benchmarks.measure import show, write
from tangram_sim.config import SimConfig
from tangram_sim.geometry.fitting import overlap_depths
from tangram_sim.geometry.layout import Layout, TokensConfig, make_layout
from tangram_sim.geometry.overlap import outlines
from tangram_sim.sight.lens import Lens
from tangram_sim.targets.connected import sample_piles
from tangram_sim.targets.sampling import sample_batch
from tangram_sim.world.world import World, make_world
from tangram_vision.pictures.seeing import Seen, see

SCALE, ARENA = 0.6, 2.0  # as in the game
SEVEN = (
    *("large_triangle", "large_triangle", "medium_triangle", "small_triangle"),
    *("small_triangle", "square", "parallelogram"),
)
NEAR, TURNED = 0.01, 2.0  # arena units and degrees within which a token counts as found
APART = 2.0  # pixels between tokens that do not touch
CAMERAS = ((128, "grey"), (128, "binary"), (64, "grey"), (64, "binary"))
DISTURBED = (0.0, 0.5, 1.0)  # strengths of what disturbs the camera
# Share of what tokens cover that may differ in another arrangement of one outline: less than what a
# wrong pose of the smallest makes.
SAME = 0.01

Scene = tuple[Floats, Bools]  # poses (K, 3) and sides (K,)
Draw = Callable[[np.random.Generator], Scene]


@dataclass
class Looks:
    """What was seen of N scenes of K tokens.

    Attributes:
        off: (N, K, 2) distance and degrees of each token; infinite where it is not surely seen.
        ms: (N,) CPU time of one look.
        same: (N,) scenes of which what was seen gives the same picture.
    """

    off: Floats
    ms: Floats
    same: Bools

    def row(self, what: str, camera: str) -> dict[str, Any]:
        """A row of the table."""
        found = ((self.off[..., 0] < NEAR) & (self.off[..., 1] < TURNED)).all(axis=1)
        sure = np.isfinite(self.off[..., 0])
        wrong = (sure & (self.off >= (NEAR, TURNED)).any(axis=2)).any(axis=1)
        seen = self.off[np.isfinite(self.off[..., 0])].reshape(-1, 2)
        position, angle = seen.T if len(seen) else np.full((2, 1), np.nan)
        return {
            "what": what,
            "pictures": camera,
            "scenes": len(self.ms),
            "all found": float(found.mean()),
            "same picture": float((self.same | found).mean()),
            "sure but wrong": float(wrong.mean()),
            "position, median": float(np.median(position)),
            "95th perc.": float(np.percentile(position, 95)),
            "angle (°), median": float(np.median(angle)),
            "95th perc. (°)": float(np.percentile(angle, 95)),
            "ms, median": float(np.median(self.ms)),
            "ms, 95th perc.": float(np.percentile(self.ms, 95)),
        }


def run_seeing(scenes: int, seed: int, out: Path | None) -> int:
    """Print the tables; returns the exit status, 0 whatever was found."""
    rows = [*_one_token(scenes, seed), *_scenes(scenes, seed)]
    show("tokens found in the engine's pictures, one core", rows)
    disturbed = _disturbed(scenes, seed)
    show("one token in grey pictures of 128 px, by sim.disturbance", disturbed)
    write(out, {"scenes": scenes, "seed": seed, "rows": rows, "disturbed": disturbed})
    return 0


def _one_token(scenes: int, seed: int) -> Iterator[dict[str, Any]]:
    each = -(-scenes // len(set(SEVEN)))
    for pixels, picture in CAMERAS:
        parts = []
        for shape in sorted(set(SEVEN)):
            layout = make_layout(TokensConfig((shape,), SCALE))
            sim = SimConfig(arena=ARENA, pixels=pixels, picture=picture)
            parts.append(_looks(layout, sim, _anywhere(layout, sim, 0.0), each, seed))
        yield _joined(parts).row("one token, five shapes", f"{pixels} {picture}")


def _scenes(scenes: int, seed: int) -> Iterator[dict[str, Any]]:
    layout = make_layout(TokensConfig(SEVEN, SCALE))
    for pixels, picture in CAMERAS:
        sim = SimConfig(arena=ARENA, pixels=pixels, picture=picture)
        gap = APART * ARENA / pixels
        kinds = {f"seven tokens, {APART:g} px apart": _anywhere(layout, sim, gap)}
        if pixels == 128:
            kinds["piles of two or three, edge to edge"] = _piled(layout, sim)
            kinds["pairs that touch by chance"] = _touching(layout, sim, gap)
        for what, draw in kinds.items():
            yield _looks(layout, sim, draw, scenes, seed).row(what, f"{pixels} {picture}")


def _disturbed(scenes: int, seed: int) -> list[dict[str, Any]]:
    """One token under noise, blur and uneven light; the camera stands where it should.

    Seen from elsewhere, a token that is found would not lie where it is.
    """
    each, rows = -(-scenes // len(set(SEVEN))), []
    for strength in DISTURBED:
        parts = []
        for shape in sorted(set(SEVEN)):
            layout = make_layout(TokensConfig((shape,), SCALE))
            sim = SimConfig(arena=ARENA, pixels=128, picture="grey", disturbance=strength)
            parts.append(_looks(layout, sim, _anywhere(layout, sim, 0.0), each, seed))
        rows.append(_joined(parts).row(f"disturbed by {strength:g}", "128 grey"))
    return rows


def _joined(parts: Sequence[Looks]) -> Looks:
    names = ("off", "ms", "same")
    return Looks(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _looks(layout: Layout, sim: SimConfig, draw: Draw, scenes: int, seed: int) -> Looks:
    off, ms, same = [], [], []
    with _world(layout, sim) as world:
        for number in range(scenes):
            generator = np.random.default_rng([seed, number])
            poses, flipped = draw(generator)
            lens = Lens(sim)
            lens.begin([generator])
            world.place(poses, flipped)
            picture = lens.taken(0, world.picture(), generator)
            began = time.process_time()
            seen = see(picture, layout, ARENA)
            ms.append(1e3 * (time.process_time() - began))
            off.append(_off(layout, poses, flipped, seen))
            same.append(_same(world, seen, world.picture()))
    return Looks(np.array(off), np.array(ms), np.array(same))


@contextmanager
def _world(layout: Layout, sim: SimConfig) -> Iterator[World]:
    world = make_world(layout, sim)
    with closing(world):
        yield world


def _same(world: World, seen: Seen, picture: Pixels) -> bool:
    """Whether all tokens, where they were seen, give the same picture."""
    if not seen.known.all():
        return False
    world.place(seen.poses, seen.flipped)
    ground = picture.max().astype(float)
    differs = np.abs(world.picture().astype(float) - picture).sum()
    return bool(differs < SAME * (ground - picture).sum())


def _off(layout: Layout, poses: Floats, flipped: Bools, seen: Seen) -> Floats:
    """(K, 2) distance and degrees; of tokens that look alike each the one that it fits best."""
    off = np.full((layout.tokens, 2), np.inf)
    names = np.array([shape.name for shape in layout.shapes])
    for name in set(names.tolist()):
        own = np.flatnonzero(names == name)
        tries = [
            np.array(
                [
                    _one_off(layout, poses, flipped, seen, *pair)
                    for pair in zip(own.tolist(), order, strict=True)
                ]
            )
            for order in permutations(own.tolist())
        ]
        off[own] = min(tries, key=lambda one: float(np.minimum(one[:, 0], ARENA).sum()))
    return off


def _one_off(
    layout: Layout, poses: Floats, flipped: Bools, seen: Seen, token: int, as_token: int
) -> tuple[float, float]:
    if not seen.sure[as_token]:
        return np.inf, np.inf
    if seen.flipped[as_token] != flipped[token]:
        return ARENA, 180.0
    half = np.pi / layout.symmetries[token]
    x, y, turn = seen.poses[as_token] - poses[token]
    return float(np.hypot(x, y)), float(np.degrees(abs((turn + half) % (2.0 * half) - half)))


def _gap(layout: Layout, scene: Scene, together: Floats | None = None) -> float:
    """The least distance of two tokens, of different groups (K,) if there are such."""
    depth, _ = overlap_depths(outlines(layout.corners(*scene)[None], layout)[0])
    if together is not None:
        depth = np.where(together[:, None] == together, -np.inf, depth)
    return float(-depth.max(initial=-np.inf))


def _anywhere(layout: Layout, sim: SimConfig, gap: float) -> Draw:
    """Tokens anywhere, at least so far apart."""

    def draw(generator: np.random.Generator) -> Scene:
        while True:
            flipped = (generator.random(layout.tokens) < 0.5) & layout.chiral
            scene = sample_batch(layout, sim, [generator], flipped[None])[0], flipped
            if _gap(layout, scene) >= gap:
                return scene

    return draw


def _piled(layout: Layout, sim: SimConfig) -> Draw:
    """One to three tokens edge to edge in each pile, as with sim.starts=piles."""

    def draw(generator: np.random.Generator) -> Scene:
        return sample_piles(layout, sim, generator), np.zeros(layout.tokens, np.bool_)

    return draw


def _touching(layout: Layout, sim: SimConfig, gap: float) -> Draw:
    """Scenes in which one token was pushed against another until less than half a pixel is left."""
    half_pixel = gap / APART / 2.0
    apart = _anywhere(layout, sim, gap)

    def draw(generator: np.random.Generator) -> Scene:
        while True:
            poses, flipped = apart(generator)
            one, two = generator.permutation(layout.tokens)[:2]
            way = poses[two, :2] - poses[one, :2]
            group = np.arange(layout.tokens, dtype=float)
            group[one] = group[two]
            for share in np.linspace(0.0, 1.0, 400):
                moved = poses.copy()
                moved[one, :2] += share * way
                left = _gap(layout, (moved, flipped))
                if left < half_pixel:
                    break
            if left > 0.0 and _gap(layout, (moved, flipped), group) >= gap:
                return moved, flipped

    return draw
