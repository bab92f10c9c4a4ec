"""Random targets and starts of episodes; `SimConfig.targets` gives the kind of targets.

Legend: B environments, K tokens. Targets and starts are poses (B, K, 3) and sides (B, K): which
tokens are turned over.
"""

from functools import lru_cache
from itertools import combinations

import numpy as np

from tangram_core.arrays import Bools, Floats
from tangram_core.errors import ConfigError
from tangram_core.settings import refuse_ignored, told
from tangram_sim.config import SimConfig
from tangram_sim.geometry.fitting import kind_of
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import outlines
from tangram_sim.geometry.prisms import thickness
from tangram_sim.geometry.shapes import Shape, mirror_image, tan, turn_onto
from tangram_sim.motion.kinematics import wrap
from tangram_sim.puzzles.assembly import COUNTS, Puzzle, PuzzleRules
from tangram_sim.puzzles.figures import library
from tangram_sim.targets.connected import MAX_PILE, sample_connected
from tangram_sim.targets.sampling import Generators, sample_batch

Sides = tuple[Floats, Bools]
_NO_TURN = 1e-6  # radians
MIN_THICKNESS = 1e-3  # of a token, as a share of the arena's width


def sample_targets(layout: Layout, sim: SimConfig, generators: Generators) -> Sides:
    """One random target per generator: poses (B, K, 3) and sides (B, K).

    Raises:
        SamplingError: the arena has no room for a token.
        ConfigError: the targets are figures, but the tokens are not all seven tans.
    """
    kinds = [_kind(sim, rng) for rng in generators]
    flipped = _sides(layout, sim, generators)
    poses = np.empty((len(generators), layout.tokens, 3))
    apart = [b for b, kind in enumerate(kinds) if kind == "uniform"]
    if apart:
        rngs = [generators[b] for b in apart]
        poses[apart] = sample_batch(layout, sim, rngs, flipped[apart])
    for b, kind in enumerate(kinds):
        if kind == "connected":
            one = sample_connected(layout, sim, generators[b])
            sides = np.zeros(layout.tokens, dtype=np.bool_)
            poses[b], flipped[b] = layout.mirrored(one, sides) if flipped[b].any() else (one, sides)
        elif kind == "figures":
            poses[b], flipped[b] = _figure(layout, bool(flipped[b].any()), generators[b])
    return poses, flipped


def sample_starts(layout: Layout, sim: SimConfig, targets: Sides, generators: Generators) -> Sides:
    """One random start per generator: poses (B, K, 3) and sides (B, K).

    Sides are those of the target, or random with `allow_flip`.

    Raises:
        SamplingError: the arena has no room for a token.
    """
    flipped = targets[1]
    if sim.allow_flip:
        drawn = [rng.random(layout.tokens) < 0.5 for rng in generators]
        flipped = np.stack(drawn) & layout.chiral
    goals = layout.corners(*targets)
    avoid = outlines(goals, layout) if sim.starts == "outside" else None
    return sample_batch(layout, sim, generators, flipped, avoid), flipped


def check_targets(layout: Layout, sim: SimConfig) -> None:
    """Check that settings of the world suit these tokens; ConfigError names a wrong setting."""
    if sim.allow_flip and not layout.any_chiral:
        raise ConfigError(
            "sim.allow_flip=true needs a token that is not its own mirror image, got tokens "
            f"{', '.join(shape.name for shape in layout.shapes)}: set sim.allow_flip=false"
        )
    if sim.mirrored and not layout.any_chiral:
        alike, chiral = "tokens that are their own mirror images", "take a set with a parallelogram"
        refuse_ignored(f"sim.mirrored={told(sim.mirrored)}", alike, chiral, 0.0)
    _check_thick(layout, sim)
    if sim.looks:
        _check_names(layout, sim.observe)
    if sim.observe == "pictures" and sim.targets != "uniform" and layout.tokens > MAX_PILE:
        raise ConfigError(
            f"sim.observe=pictures can tell at most {MAX_PILE} touching tokens apart, got "
            f"{layout.tokens} with sim.targets={sim.targets}: set sim.targets=uniform, or "
            "sim.observe=corners"
        )
    _check_figures(layout, sim)


def _check_names(layout: Layout, observe: str) -> None:
    """Check that tokens of one name are equal and others differ: pictures show no names."""
    for one, other in combinations(layout.shapes, 2):
        turn = _turn_of(one, other)
        if one.name == other.name:
            if turn is None or turn[1] or abs(turn[0]) > _NO_TURN:
                remedy = "different names" if turn is None else "the same corners"
                raise ConfigError(
                    f"sim.observe={observe} needs equal corners for tokens of one name, and two "
                    f"tokens {one.name} differ: give them {remedy}"
                )
        elif turn is not None:
            raise ConfigError(
                f"sim.observe={observe} cannot tell {one.name} from {other.name}, which may look "
                "alike: leave one out, give own equal tokens one name, or set sim.observe=corners"
            )


def _check_thick(layout: Layout, sim: SimConfig) -> None:
    """Raise ConfigError if a token is too thin for its arena."""
    shape = min(layout.shapes, key=lambda one: thickness(one.corners))
    thin = thickness(shape.corners)
    if thin < MIN_THICKNESS * sim.arena:
        raise ConfigError(
            f"token '{shape.name}' must be at least {MIN_THICKNESS * sim.arena:g} thick (twice its "
            f"area / perimeter) in an arena of width {sim.arena:g}, got {thin:.3g}: raise "
            "tokens.scale, or lower sim.arena"
        )


def placement(puzzle: Puzzle, layout: Layout) -> Sides:
    """Poses (K, 3) and sides (K,) of a layout's tokens in a puzzle.

    Equal pieces are taken in order. A mirrored parallelogram is a parallelogram turned over.

    Raises:
        ConfigError: the layout's tokens are not the puzzle's pieces, or have another size.
    """
    left = list(range(len(puzzle.pieces)))
    poses, flipped = np.empty((layout.tokens, 3)), np.zeros(layout.tokens, dtype=np.bool_)
    for token, shape in enumerate(layout.shapes):
        turns = ((k, _turn_of(shape, puzzle.layout.shapes[k])) for k in left)
        piece, turn = next((one for one in turns if one[1] is not None), (-1, None))
        if turn is None:
            raise ConfigError(
                f"puzzle '{puzzle.name}' has the pieces {', '.join(puzzle.pieces)} of scale "
                f"{puzzle.scale:g}: it cannot be assembled from the tokens "
                f"{', '.join(s.name for s in layout.shapes)}; set tokens=tangram7 "
                f"tokens.scale={puzzle.scale:g}"
            )
        left.remove(piece)
        poses[token] = puzzle.poses[piece]
        poses[token, 2] += turn[0]
        flipped[token] = turn[1]
    if left:
        raise ConfigError(
            f"puzzle '{puzzle.name}' has {len(puzzle.pieces)} pieces, and there are "
            f"{layout.tokens} tokens: set tokens=tangram7"
        )
    return poses, flipped


def _turn_of(shape: Shape, other: Shape) -> tuple[float, bool] | None:
    """Angle and side at which a shape equals another one; None if it does not."""
    for flipped, corners in ((False, shape.corners), (True, mirror_image(shape.corners))):
        turn = turn_onto(corners, other.corners)
        if turn is not None:
            return turn, flipped
    return None


def _kind(sim: SimConfig, rng: np.random.Generator) -> str:
    if sim.targets != "touching":
        return sim.targets
    return "figures" if rng.random() < 0.5 else "connected"


def _sides(layout: Layout, sim: SimConfig, generators: Generators) -> Bools:
    """(B, K) sides: in a share `mirrored` of episodes all chiral tokens are turned over."""
    flipped = np.zeros((len(generators), layout.tokens), dtype=np.bool_)
    if sim.mirrored > 0.0 and layout.any_chiral:
        flipped[:] = np.array([rng.random() < sim.mirrored for rng in generators])[:, None]
    return np.asarray(flipped & layout.chiral)


def _figure(layout: Layout, mirrored: bool, rng: np.random.Generator) -> Sides:
    """A random figure of the train split at a random angle, in the middle of the arena."""
    figures = _figures(layout)
    poses, flipped = figures[int(rng.integers(len(figures)))]
    if mirrored:
        poses, flipped = layout.mirrored(poses, flipped)
    return turned_figure(layout, (poses, flipped), rng.uniform(-np.pi, np.pi)), flipped


def turned_figure(layout: Layout, figure: Sides, angle: float) -> Floats:
    """Poses (K, 3) of a figure rotated by an angle (rad) and centred in the arena.

    The angles of the poses are in (-pi, pi].
    """
    poses, flipped = figure
    centres = (poses[:, :2] @ (1.0, 1j)) * np.exp(1j * angle)
    turned = np.column_stack([centres.real, centres.imag, wrap(poses[:, 2] + angle)])
    corners = layout.corners(turned, flipped)
    turned[:, :2] -= (corners.min(axis=0) + corners.max(axis=0)) / 2.0
    return turned


@lru_cache(maxsize=4)
def _figures(layout: Layout) -> list[Sides]:
    scale = round(_scale(layout), 9)
    return [placement(puzzle, layout) for puzzle in library("train", scale)]


def _scale(layout: Layout) -> float:
    """Side of the full square that tans are cut from."""
    shape = layout.shapes[0]
    return float(np.sqrt(shape.area / tan(shape.name).area))


def _check_figures(layout: Layout, sim: SimConfig) -> None:
    """Raise unless the tokens make every figure, and it fits into the arena at any angle."""
    if sim.targets not in ("figures", "touching"):
        return
    if not has_all_tans(layout):
        raise ConfigError(
            f"sim.targets={sim.targets} needs all seven tans, got tokens "
            f"{', '.join(_tans(layout))}: set tokens=tangram7, or another kind of targets"
        )
    extent = PuzzleRules().max_extent * _scale(layout)
    if extent > sim.arena:
        raise ConfigError(
            f"sim.targets={sim.targets} needs an arena of width {extent:g} for tokens.scale="
            f"{_scale(layout):g}, got {sim.arena:g}: raise sim.arena, or lower tokens.scale"
        )


def has_all_tans(layout: Layout) -> bool:
    """Whether the tokens are the seven tans, so that they can make every figure."""
    return _tans(layout) == sorted(name for name, count in COUNTS.items() for _ in range(count))


def _tans(layout: Layout) -> list[str]:
    """Names of the tokens, sorted; sides do not matter."""
    return sorted(kind_of(shape.name) for shape in layout.shapes)
