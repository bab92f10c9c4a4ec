"""What a token that slides does to others, learned from short pushes in the engine.

A network sees two tokens: one goes a short way and comes to lie on the other. It tells how that one
is shifted and turned. A longer way is many short ones, and what is pushed pushes others in turn.
No engine is needed here: `tangram_lab.experiments.contacts` played the pushes in it.

Legend: N tokens that move, each with another one; M ways, S short pushes of each; K tokens.
Indices of tokens that lie somewhere are places in `TOKENS`.
"""

from dataclasses import dataclass, replace
from importlib.resources.abc import Traversable

import numpy as np
from torch import nn

from tangram_agent.coverage import Lying
from tangram_agent.foresight import EngineWorlds, Foresight, Table
from tangram_agent.networks import perceptron
from tangram_agent.pretrained import CONTACTS, PACKAGED, PREFIX, read_agent
from tangram_agent.setup import Setup
from tangram_agent.stored import load_settings
from tangram_agent.weights import load_arrays
from tangram_sim.arrays import Bools, Complex, Floats, Ints, Singles
from tangram_sim.config import SimConfig
from tangram_sim.errors import ConfigError, RunError
from tangram_sim.geometry import separations, shared_area
from tangram_sim.kinematics import wrap
from tangram_sim.layout import Layout, TokensConfig, make_layout
from tangram_sim.settings import told
from tangram_sim.shapes import Shape

TOKENS = TokensConfig(
    ("large_triangle", "medium_triangle", "small_triangle", "square", "parallelogram"), 0.6
)
LAYOUT = make_layout(TOKENS)
SIM = SimConfig(motion="slide")
WORLD = ("arena", "friction", "substeps")  # settings that a push depends on
PUSH = 0.06  # longest way of any point of a token in one push, arena units
SCALE = np.array([0.02, 0.02, 0.06])  # of what the network tells: shift, and turn
HIDDEN = (128, 128, 128)
_TOUCH = 1e-5  # depth from which on tokens push each other
_SHARP = 2e-3  # so much less deep a corner counts for a third
_GONE = 0.6  # radii: a piece that was pushed so far is lost
_MISSES = 2  # pushes without a touch after which a way has left a piece behind
_ROUNDS = 3  # a token pushes another one, that a third, and that a fourth
_REMEDY = "set agent.lookahead=engine"


def network() -> nn.Sequential:
    """The layers, without weights."""
    still = Lying(np.zeros(1, np.int64), np.zeros((1, 3)), np.zeros(1, np.bool_))
    return perceptron(features(still, np.zeros((1, 3)), still).shape[1], HIDDEN, 3)


def features(movers: Lying, way: Floats, others: Lying) -> Singles:
    """(N, F): tokens that others come onto by ways (N, 3), as these see them at first."""
    kinds, first = np.eye(len(TOKENS.shapes)), movers.pose
    ahead = np.exp(-1j * first[:, 2])
    ends, corners = (
        _complex(lying.outlines(LAYOUT)) for lying in (replace(movers, pose=first + way), others)
    )
    depth, out = separations(_points(ends), _points(corners))
    centre = _complex(others.pose[:, :2])
    # Where they touch: corners of the one that are deepest in the other, and the other way round.
    touching = _deepest(ends, out) - centre, _deepest(corners, -out) - centre
    turn = np.exp(1j * others.pose[:, 2]) * ahead
    seen = [
        (centre - _complex(first[:, :2])) * ahead / 0.3,
        turn,
        *((corners - _complex(first[:, :2])[:, None]) * ahead[:, None] / 0.3).T,
        _complex(way[:, :2]) * ahead / 0.03,
        out * ahead,
        out * ahead * depth / 0.02,
        *(point * ahead / 0.2 for point in touching),
    ]
    plain = [movers.flipped, others.flipped, way[:, 2] / 0.1, depth / 0.02]
    parts = np.column_stack([*(part.real for part in seen), *(part.imag for part in seen), *plain])
    return np.hstack([kinds[movers.index], kinds[others.index], parts]).astype(np.float32)


class Contacts:
    """The model that comes with the package, for the tokens of one layout.

    Attributes:
        kinds: (K,) their places in `TOKENS`.
    """

    def __init__(self, kinds: Ints, folder: Traversable = PACKAGED / CONTACTS) -> None:
        """Read it.

        Raises:
            RunError: a file is missing or damaged, or of another version.
        """
        self.kinds = kinds
        shown = f"{PREFIX}/{CONTACTS}"
        agent = read_agent(folder, shown)
        other = RunError(f"{shown} was learned by another version: install tangram-rl again")
        if load_settings(agent.config, shown) != world():
            raise other
        layers = network()
        try:
            load_arrays(layers, agent.weights.tensors)
        except RunError:
            raise other from None
        # Torch takes several times as long for a few rows.
        self._layers = [
            (layer.weight.detach().numpy().T, layer.bias.detach().numpy())
            for layer in layers
            if isinstance(layer, nn.Linear)
        ]

    def shifts(self, movers: Lying, way: Floats, others: Lying) -> Floats:
        """(N, 3) shift and turn of tokens that others come onto by ways (N, 3) of one push."""
        rows = features(movers, way, others)
        for weight, bias in self._layers[:-1]:
            rows = np.maximum(rows @ weight + bias, 0.0)
        weight, bias = self._layers[-1]
        return _turned((rows @ weight + bias) * SCALE, movers.pose[:, 2])

    def pushed(self, movers: Lying, end: Floats, pieces: Lying) -> Floats:
        """(M, K) share of pieces (K,) in place that tokens on ways to poses (M, 3) push away."""
        way, count = end - movers.pose, len(pieces.index)
        way[:, 2] = wrap(way[:, 2])
        path, last = _path(movers, way)
        m, k = np.nonzero(_passing(movers, way, pieces))
        places = path[m], movers.index[m, None], pieces.pose[k][:, None], pieces.index[k, None]
        n, s = np.nonzero(_near(*places) & _between(1, last[m], path))
        m, k = m[n], k[n]
        meet = _meet(replace(_at(movers, m), pose=path[m, s]), _at(pieces, k))
        # The first of its pushes by which each token comes onto a piece.
        pair, first = np.unique(m[meet] * count + k[meet], return_index=True)
        m, k, step = pair // count, pair % count, s[meet][first]
        mover, lies, home = _at(movers, m), _at(pieces, k), _at(pieces, k)
        going, missed = np.arange(len(pair)), np.zeros(len(pair), np.int64)
        far = np.zeros(len(pair))
        while len(going):
            start, to = path[m[going], step[going] - 1], path[m[going], step[going]]
            rows = np.flatnonzero(_meet(replace(_at(mover, going), pose=to), _at(lies, going)))
            hit = going[rows]
            begin = replace(_at(mover, hit), pose=start[rows])
            lies.pose[hit] += self.shifts(begin, (to - start)[rows], _at(lies, hit))
            step[going] += 1
            missed[going] += 1
            missed[hit] = 0
            far[hit] = np.hypot(*(lies.pose - home.pose)[hit, :2].T) / LAYOUT.radii[lies.index[hit]]
            ends = (far >= _GONE) | (missed >= _MISSES) | (step > last[m])
            going = going[~ends[going]]
        stays = shared_area(lies.outlines(LAYOUT), home.outlines(LAYOUT))
        share = np.zeros((len(end), count))
        lost = np.clip(1.0 - stays / LAYOUT.areas[lies.index], 0.0, 1.0)
        share[m, k] = np.where(far < _GONE, lost, 1.0)
        return share


class ContactWorlds:
    """See `tangram_agent.foresight.Foresight`: what the model foresees, without an engine."""

    def __init__(self, contacts: Contacts) -> None:
        self._contacts = contacts

    def slid(self, table: Table, token: Ints, way: Floats) -> Floats:
        """See `Foresight.slid`."""
        scenes = _Scenes(self._contacts.kinds, table.poses.copy(), table.flipped)
        rows = np.arange(len(token))
        path, last = _path(scenes.at(rows, token), way)
        step = self._first(scenes, rows, token, path, _between(1, last, path))
        while len(rows := np.flatnonzero(step <= last)):
            scenes.pose[rows, token[rows]] = path[rows, step[rows]]
            met = self._push(scenes, rows, token[rows], path[rows, step[rows] - 1])
            step[rows] += 1
            off = rows[~met]
            steps = _between(step[off], last[off], path)
            step[off] = self._first(scenes, off, token[off], path[off], steps)
        ends = scenes.pose
        ends[np.arange(len(token)), token] = path[:, -1]
        ends[..., 2] = wrap(ends[..., 2])
        return ends

    def _first(
        self, scenes: "_Scenes", rows: Ints, token: Ints, path: Floats, steps: Bools
    ) -> Ints:
        """The first of steps (N, S) of paths (N, S, 3) that meets a token; S where none does."""
        kinds = scenes.kinds
        near = _near(path[:, :, None], kinds[token][:, None, None], scenes.pose[rows, None], kinds)
        near &= steps[..., None]
        near[np.arange(len(rows)), :, token] = False
        n, s, other = np.nonzero(near)
        there = replace(scenes.at(rows[n], token[n]), pose=path[n, s])
        meet = _meet(there, scenes.at(rows[n], other))
        first = np.full(len(rows), path.shape[1])
        np.minimum.at(first, n[meet], s[meet])
        return first

    def _push(self, scenes: "_Scenes", rows: Ints, token: Ints, start: Floats) -> Bools:
        """Shift what tokens (N,) came onto from poses (N, 3), what that comes onto, and so on.

        Returns:
            (N,) whether there was any.
        """
        first, count = rows, len(scenes.kinds)
        met = np.zeros(len(scenes.pose), dtype=np.bool_)
        left = np.ones(scenes.pose.shape[:2], dtype=np.bool_)
        for number in range(_ROUNDS):
            left[rows, token] = False
            by, other = np.nonzero(left[rows])
            meet = _meet(scenes.at(rows[by], token[by]), scenes.at(rows[by], other))
            by, other = by[meet], other[meet]
            # By the first one alone where several tokens come onto one.
            _, once = np.unique(rows[by] * count + other, return_index=True)
            by, other = by[once], other[once]
            if number == 0:
                met[rows[by]] = True
            if not len(by):
                break
            moved = scenes.at(rows[by], token[by])
            way = moved.pose - start[by]
            lying = scenes.at(rows[by], other)
            shift = self._contacts.shifts(replace(moved, pose=start[by]), way, lying)
            rows, token, start = rows[by], other, lying.pose
            scenes.pose[rows, token] += shift
        return met[first]


@dataclass(frozen=True, eq=False)
class _Scenes:
    """B scenes of the same tokens.

    Attributes:
        kinds: (K,) of the tokens.
        pose: (B, K, 3).
        flipped: (K,).
    """

    kinds: Ints
    pose: Floats
    flipped: Bools

    def at(self, rows: Ints, token: Ints) -> Lying:
        """Copies of some tokens."""
        return Lying(self.kinds[token], self.pose[rows, token], self.flipped[token])


def kinds_of(layout: Layout, sim: SimConfig) -> Ints:
    """(K,) places of a layout's tokens in `TOKENS`.

    Raises:
        ConfigError: the model knows nothing of such tokens, or of such a world.
    """
    known = "agent.lookahead=learned was learned with"
    for name in WORLD:
        wanted, given = getattr(SIM, name), getattr(sim, name)
        if told(given) != told(wanted):
            raise ConfigError(f"{known} sim.{name}={told(wanted)}, got {told(given)}: {_REMEDY}")
    kinds = [_kind(shape) for shape in layout.shapes]
    if -1 in kinds:
        raise ConfigError(
            f"{known} the tans at tokens.scale={TOKENS.scale:g}, got another "
            f"{layout.shapes[kinds.index(-1)].name}: {_REMEDY}"
        )
    return np.array(kinds)


def known_contacts(setup: Setup) -> Contacts | None:
    """What is known of contacts, where an agent looks ahead.

    Raises:
        ConfigError: it looks ahead by nothing else, and was learned in another world.
        RunError: see `Contacts`.
    """
    if setup.agent.lookahead == "none":
        return None
    try:
        return Contacts(kinds_of(setup.layout, setup.sim))
    except ConfigError:
        if setup.agent.lookahead == "learned":
            raise
        return None


def foreseen(setup: Setup, known: Contacts | None) -> Foresight:
    """The worlds in which a look ahead tries actions."""
    if setup.agent.lookahead == "engine" or known is None:
        return EngineWorlds(setup.layout, setup.sim)
    return ContactWorlds(known)


def _kind(shape: Shape) -> int:
    same = [
        len(own.corners) == len(shape.corners) and np.allclose(own.corners, shape.corners)
        for own in LAYOUT.shapes
    ]
    return same.index(True) if any(same) else -1


def world() -> dict[str, object]:
    """What the model is learned in, for its config.yaml."""
    return {
        "tokens": {"shapes": list(TOKENS.shapes), "scale": TOKENS.scale},
        "sim": {name: getattr(SIM, name) for name in WORLD},
        "push": PUSH,
    }


def seen(movers: Lying, moved: Floats) -> Floats:
    """Shifts and turns (N, 3) as tokens see them at first."""
    return _turned(moved, -movers.pose[:, 2])


def _turned(moved: Floats, angle: Floats) -> Floats:
    """Shifts and turns (N, 3), in axes that are turned by angles (N,)."""
    shift = _complex(moved[:, :2]) * np.exp(1j * angle)
    return np.column_stack([shift.real, shift.imag, moved[:, 2]])


def _meet(one: Lying, other: Lying) -> Bools:
    """(N,) whether tokens overlap."""
    meet = _near(one.pose, one.index, other.pose, other.index)
    rows = np.flatnonzero(meet)
    first, second = (_at(lying, rows).outlines(LAYOUT) for lying in (one, other))
    meet[rows] = separations(first, second)[0] > _TOUCH
    return meet


def _near(pose: Floats, index: Ints, others: Floats, other: Ints) -> Bools:
    """(...,) whether tokens at poses (..., 3) may touch others, by their radii."""
    off = (pose - others)[..., :2]
    return np.asarray((off**2).sum(axis=-1) < (LAYOUT.radii[index] + LAYOUT.radii[other]) ** 2)


def _passing(movers: Lying, way: Floats, pieces: Lying) -> Bools:
    """(M, K) whether a token that goes a way (M, 3) comes near a piece, (K,), anywhere on it."""
    along, to = _complex(way)[:, None], _complex(pieces.pose) - _complex(movers.pose)[:, None]
    share = (to * along.conj()).real / np.maximum(np.abs(along) ** 2, _TOUCH**2)
    off = np.abs(to - np.clip(share, 0.0, 1.0) * along)
    return np.asarray(
        off < LAYOUT.radii[movers.index][:, None] + LAYOUT.radii[pieces.index] + _TOUCH
    )


def _path(movers: Lying, way: Floats) -> tuple[Floats, Ints]:
    """(M, S + 1, 3) where tokens are after 0 to S pushes, and (M,) the number of pushes of each."""
    longest = np.hypot(way[:, 0], way[:, 1]) + np.abs(way[:, 2]) * LAYOUT.radii[movers.index]
    pushes = np.maximum(np.ceil(longest / PUSH), 1.0)
    share = np.minimum(np.arange(pushes.max(initial=0.0) + 1.0) / pushes[:, None], 1.0)
    path: Floats = movers.pose[:, None] + share[..., None] * way[:, None]
    return path, pushes.astype(np.int64)


def _between(first: Ints | int, last: Ints, path: Floats) -> Bools:
    """(M, S + 1) steps of paths from first ones to last ones, both (M,)."""
    step = np.arange(path.shape[1])
    return np.asarray((step >= np.reshape(first, (-1, 1))) & (step <= last[:, None]))


def _deepest(corners: Complex, direction: Complex) -> Complex:
    """(N,) the corner of (N, C) that is farthest along a direction (N,); between those alike."""
    far = (corners * direction.conj()[:, None]).real
    weight = np.exp((far - far.max(axis=1, keepdims=True)) / _SHARP)
    point: Complex = (weight * corners).sum(axis=1) / weight.sum(axis=1)
    return point


def _complex(points: Floats) -> Complex:
    """Points (..., 2) as x + iy."""
    numbers: Complex = points[..., 0] + 1j * points[..., 1]
    return numbers


def _points(numbers: Complex) -> Floats:
    return np.stack([numbers.real, numbers.imag], axis=-1)


def _at(lying: Lying, rows: Ints) -> Lying:
    """Copies of some of them."""
    return Lying(lying.index[rows], lying.pose[rows], lying.flipped[rows])
