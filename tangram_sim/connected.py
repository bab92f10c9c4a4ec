"""Targets that hang together: each piece shares a part of an edge with one before it."""

import numpy as np

from tangram_sim.arrays import Complex, Floats
from tangram_sim.config import SimConfig
from tangram_sim.errors import SamplingError
from tangram_sim.geometry import pairs_overlap
from tangram_sim.layout import Layout

_CHUNK = 8  # candidates that are checked together
_ALIGNED = 0.7  # share of pieces that meet another corner to corner
_TOUCHING = 1e-7  # of overlap in squared units of the arena: rounding


def sample_connected(layout: Layout, sim: SimConfig, rng: np.random.Generator) -> Floats:
    """One layout (K, 3) whose pieces hang together edge to edge, no token on its other side.

    The pieces come in random order; each is laid with a random edge along a random edge of a
    random one before it, mostly corner to corner. The whole is turned and moved by chance.

    Raises:
        SamplingError: no such layout was found in `sim.max_tries` tries for one piece.
    """
    bodies = [layout.body[layout.corners_of(k)] @ (1.0, 1j) for k in range(layout.tokens)]
    order = rng.permutation(layout.tokens).tolist()
    poses = np.zeros((layout.tokens, 3))
    outlines: list[Complex] = []
    for token in order:
        angle, shift = (0.0, 0.0j)
        if outlines:
            angle, shift = _attached(bodies[token], outlines, sim, rng)
        poses[token] = shift.real, shift.imag, angle
        outlines.append(bodies[token] * np.exp(1j * angle) + shift)
    return _laid_out(layout, poses, sim, rng)


def _attached(
    body: Complex, outlines: list[Complex], sim: SimConfig, rng: np.random.Generator
) -> tuple[float, complex]:
    """Angle and shift of a piece that touches one of the others and overlaps none."""
    others = np.stack([_padded(outline, max(map(len, outlines))) for outline in outlines])
    for _ in range(-(-sim.max_tries // _CHUNK)):
        drawn = [_candidate(body, outlines, rng) for _ in range(_CHUNK)]
        angle, shift = np.array([d[0] for d in drawn]), np.array([d[1] for d in drawn])
        moved = body * np.exp(1j * angle)[:, None] + shift[:, None]
        own, rest = np.repeat(moved, len(others), axis=0), np.tile(others, (_CHUNK, 1))
        blocked = pairs_overlap(_points(own), _points(rest), _TOUCHING * sim.arena**2)
        free = ~blocked.reshape(_CHUNK, -1).any(axis=1) & (_extent(moved, others) < sim.arena)
        if free.any():
            first = int(np.argmax(free))
            return float(angle[first]), complex(shift[first])
    raise SamplingError(
        f"no connected target within an arena of width {sim.arena:g} in {sim.max_tries} tries: "
        "raise sim.arena or sim.max_tries, or lower tokens.scale"
    )


def _candidate(
    body: Complex, outlines: list[Complex], rng: np.random.Generator
) -> tuple[float, complex]:
    """A random edge of the piece along a random edge of the others, in the other direction."""
    other = outlines[rng.integers(len(outlines))]
    i, j = int(rng.integers(len(other))), int(rng.integers(len(body)))
    start, edge = other[i], other[(i + 1) % len(other)] - other[i]
    own = body[(j + 1) % len(body)] - body[j]
    turn = -(edge / abs(edge)) * (abs(own) / own)
    along = edge / abs(edge)
    # The piece's edge ends at `start + along * slide`, and lies from there on beside the other's.
    slack = abs(edge) - abs(own)
    slide = (0.0, slack)[int(rng.integers(2))]
    if rng.random() >= _ALIGNED:
        slide = rng.uniform(-0.8 * abs(own), abs(edge) - 0.2 * abs(own))
    shift = start + along * slide - body[(j + 1) % len(body)] * turn
    return float(np.angle(turn)), complex(shift)


def _laid_out(layout: Layout, poses: Floats, sim: SimConfig, rng: np.random.Generator) -> Floats:
    """The whole turned by any angle and moved to where all of it lies in the arena."""
    turn = rng.uniform(-np.pi, np.pi)
    centres = (poses[:, :2] @ (1.0, 1j)) * np.exp(1j * turn)
    turned = np.column_stack([centres.real, centres.imag, poses[:, 2] + turn])
    corners = layout.corners(turned)
    low, high = corners.min(axis=0), corners.max(axis=0)
    room = sim.arena - (high - low)
    turned[:, :2] += room * rng.random(2) - sim.arena / 2.0 - low
    turned[:, 2] = np.pi - np.mod(np.pi - turned[:, 2], 2.0 * np.pi)
    return turned


def _extent(moved: Complex, others: Complex) -> Floats:
    """(M,) the largest distance between corners of each outline (M, C) and of the others."""
    gaps: Floats = np.abs(moved[:, :, None] - others.ravel()).max(axis=(1, 2))
    return gaps


def _padded(outline: Complex, size: int) -> Complex:
    return np.concatenate([outline, np.repeat(outline[-1:], size - len(outline))])


def _points(outlines: Complex) -> Floats:
    return np.stack([outlines.real, outlines.imag], axis=-1)
