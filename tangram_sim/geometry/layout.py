"""A token set: which corners belong to which token, the order of nodes, and the edges.

All tokens' corners are stacked into one array (V, 2), token after token; the target uses the same
order. The graph of Sec. IV-A has N = 2V + K nodes: token corners (V), bases (K), target corners
(V). Only corners and flags are ever sent or stored; the rest of the graph follows from them.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tangram_core.arrays import Bools, Floats, Ints
from tangram_core.errors import ConfigError
from tangram_core.settings import Settings, declared
from tangram_sim.geometry.shapes import MAX_COORDINATE, Shape, polygon, tan

MAX_TOKENS = 16


@dataclass(frozen=True)
class TokensConfig(Settings, section="tokens"):
    """Settings of the token set."""

    shapes: tuple[Any, ...] = field(
        metadata=declared(
            "names of tans, or mappings {name, corners} of convex polygons with 3 to 16 corners"
        )
    )
    scale: float = field(
        metadata=declared(
            "side of the full square that tans are cut from, or factor for a polygon's corners",
            low=1.0 / MAX_COORDINATE,
            high=MAX_COORDINATE,
            unit="arena units",
        )
    )

    def __post_init__(self) -> None:
        if not 1 <= len(self.shapes) <= MAX_TOKENS:
            raise ConfigError(
                f"tokens.shapes must list 1 to {MAX_TOKENS} shapes, got {len(self.shapes)}"
            )
        super().__post_init__()


def make_layout(config: TokensConfig) -> "Layout":
    """The layout of a token set; ConfigError if a shape is unknown or not convex."""
    return Layout([_shape(entry).scaled(config.scale) for entry in config.shapes])


def _shape(entry: object) -> Shape:
    if isinstance(entry, str):
        return tan(entry)
    if not isinstance(entry, Mapping) or set(entry) != {"name", "corners"}:
        raise ConfigError(
            f"a shape is a name or a mapping with the keys name and corners, got {entry!r}"
        )
    return polygon(str(entry["name"]), entry["corners"])


class Layout:
    """The fixed structure of a token set, and the maps between poses, corners and nodes.

    Attributes:
        shapes: the K scaled shapes.
        body: (V, 2) corners of all tokens in their body frames.
        starts: (K + 1,) token k owns the corners starts[k]:starts[k + 1].
        token_of_corner: (V,) index of the owning token.
        padded_corners: (K, C) indices of each token's corners, padded to the C of the largest by
            repeating the last one.
        areas: (K,) of the tokens, squared arena units.
        radii: (K,) largest distance from a token's centre to a corner, arena units.
        symmetries: (K,) number of rotations within a full turn that map a token onto itself.
        chiral: (K,) tokens that no rotation maps onto their mirror image: they have two sides.
        base_weights: (K, V) weights of the corners whose sum is the centre of token k.
        adjacency: (N, N) edges of the graph, E(i, i) = 0.
    """

    def __init__(self, shapes: Sequence[Shape]) -> None:
        self.shapes = tuple(shapes)
        sizes = [len(shape.corners) for shape in self.shapes]
        self.starts: Ints = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        self.body: Floats = np.concatenate([shape.corners for shape in self.shapes])
        self.token_of_corner: Ints = np.repeat(np.arange(len(sizes)), sizes)
        steps = np.minimum(np.arange(max(sizes)), np.array(sizes)[:, None] - 1)
        self.padded_corners: Ints = self.starts[:-1, None] + steps
        self.areas: Floats = np.array([shape.area for shape in self.shapes])
        self.radii: Floats = np.array([shape.radius for shape in self.shapes])
        self.symmetries: Ints = np.array([shape.symmetry for shape in self.shapes])
        self.chiral: Bools = np.array([shape.mirror is None for shape in self.shapes])
        self.any_chiral = bool(self.chiral.any())
        self._centred = np.concatenate(
            [(shape.corners - shape.corners.mean(axis=0)) @ (1.0, 1j) for shape in self.shapes]
        )
        self.base_weights: Floats = self._base_weights()
        self.adjacency: Bools = self._adjacency()

    @property
    def tokens(self) -> int:
        """K, the number of tokens."""
        return len(self.shapes)

    @property
    def corner_count(self) -> int:
        """V, the number of corners of all tokens."""
        return len(self.body)

    @property
    def nodes(self) -> int:
        """N = 2V + K, the number of nodes of the graph."""
        return 2 * self.corner_count + self.tokens

    def corners_of(self, token: int) -> slice:
        """The slice of the V corners that belongs to one token."""
        return slice(int(self.starts[token]), int(self.starts[token + 1]))

    def corners(self, poses: Floats, flipped: Bools | None = None) -> Floats:
        """Corners (..., V, 2) of tokens in poses (..., K, 3).

        Args:
            poses: x, y and angle in radians of each token.
            flipped: (..., K) tokens that are turned over about their body's x axis, before rotation
                and shift; their corners then run clockwise. None: no token is.
        """
        pose = np.asarray(poses)[..., self.token_of_corner, :]
        cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
        x, y = self.body.T
        if flipped is not None:
            y = np.where(np.asarray(flipped)[..., self.token_of_corner], -y, y)
        return np.stack(
            [pose[..., 0] + cos * x - sin * y, pose[..., 1] + sin * x + cos * y], axis=-1
        )

    def bases(self, corners: Floats) -> Floats:
        """Centres of area (..., K, 2) of tokens with corners (..., V, 2)."""
        centres: Floats = self.base_weights @ corners
        return centres

    def flipped(self, corners: Floats) -> Bools:
        """(..., K) which tokens with corners (..., V, 2) are turned over.

        Always False for a token that is not chiral: turning it over looks like a rotation.
        """
        if not self.any_chiral:
            return np.zeros((*corners.shape[:-2], self.tokens), dtype=np.bool_)
        # The side that fits all corners better, so that noise does not decide.
        placed = corners @ (1.0, 1j)
        own = np.add.reduceat(self._centred.conj() * placed, self.starts[:-1], axis=-1)
        other = np.add.reduceat(self._centred * placed, self.starts[:-1], axis=-1)
        return np.asarray((np.abs(other) > np.abs(own)) & self.chiral)

    def poses(self, corners: Floats) -> Floats:
        """Poses (..., K, 3) for corners (..., V, 2): least-squares rotation, angle in (-pi, pi].

        The method `flipped` gives the tokens' sides.
        """
        centres = self.bases(corners)
        offset = corners - centres[..., self.token_of_corner, :]
        x, y = self.body.T
        if self.any_chiral:
            y = np.where(self.flipped(corners)[..., self.token_of_corner], -y, y)
        dot = x * offset[..., 0] + y * offset[..., 1]
        cross = x * offset[..., 1] - y * offset[..., 0]
        angle = np.arctan2(
            np.add.reduceat(cross, self.starts[:-1], axis=-1),
            np.add.reduceat(dot, self.starts[:-1], axis=-1),
        )
        return np.concatenate([centres, angle[..., None]], axis=-1)

    def mirrored(self, poses: Floats, flipped: Bools) -> tuple[Floats, Bools]:
        """The mirror image (x, -y) of poses (..., K, 3) and sides (..., K).

        A chiral token changes its side; any other token changes its angle only.
        """
        turns = np.array([shape.mirror or 0.0 for shape in self.shapes])
        image = np.asarray(poses) * (1.0, -1.0, -1.0)
        image[..., 2] += turns
        return image, np.asarray(flipped) ^ self.chiral

    def fingerprint(self) -> str:
        """A short digest of the shapes: processes with equal digests agree on every index."""
        content = [[s.name, s.symmetry, np.round(s.corners, 9).tolist()] for s in self.shapes]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]

    def _base_weights(self) -> Floats:
        """Minimum-norm weights with sum 1 that give the origin from the body corners.

        A rigid motion is affine, so the weights give the centre of area in every pose, even where
        it is not the mean of the corners.
        """
        weights = np.zeros((self.tokens, self.corner_count))
        for k, shape in enumerate(self.shapes):
            system = np.vstack([shape.corners.T / shape.radius, np.ones(len(shape.corners))])
            weights[k, self.corners_of(k)] = np.linalg.pinv(system) @ np.array([0.0, 0.0, 1.0])
        return weights

    def _adjacency(self) -> Bools:
        """Edges of Sec. IV-A: within a token, corner to its base, base to every target node."""
        v, k = self.corner_count, self.tokens
        same = self.token_of_corner[:, None] == self.token_of_corner[None, :]
        edges = np.zeros((self.nodes, self.nodes), dtype=np.bool_)
        edges[:v, :v] = same
        edges[v + k :, v + k :] = same
        own = np.arange(k)[:, None] == self.token_of_corner[None, :]
        edges[v : v + k, :v] = own
        edges[v : v + k, v + k :] = True
        edges |= edges.T
        np.fill_diagonal(edges, False)
        return edges
