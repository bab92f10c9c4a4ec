"""Edges of tokens that lie against each other, as silhouettes have them: without a gap, parallel.

Such edges show in no picture of a silhouette; that they touch tells where they are. Points are
complex numbers, in pixels. Legend: n tokens, m contacts.
"""

from collections.abc import Sequence
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from tangram_core.arrays import Floats
from tangram_vision.pictures.kinds import Kind

_GAP = 1.2  # pixels between edges that touch
_PARALLEL = np.radians(14.0)
_SHORT = 1.0  # pixels of an edge that touch


class Contact(NamedTuple):
    """The number of a token and of its edge, and those of the edge that it lies against."""

    one: int
    edge: int
    other: int
    against: int


class _Gap(NamedTuple):
    """Two edges, as they lie.

    Attributes:
        middle: the point in the middle of what is shared of the first edge.
        shared: its length.
        out: the direction away from the second edge.
        wide: how far the middle lies out of it.
        turn: radians by which the first is turned from lying along the second.
        reach: half of the shorter edge.
    """

    middle: complex
    shared: float
    out: complex
    wide: float
    turn: float
    reach: float


def touching(kinds: Sequence[Kind], poses: Floats) -> list[Contact]:
    """The contacts of tokens with poses (n, 3)."""
    found = []
    radii = [float(np.hypot(*kind.corners.T).max()) for kind in kinds]
    for one, other in combinations(range(len(kinds)), 2):
        apart = float(np.hypot(*(poses[one, :2] - poses[other, :2])))
        if apart > radii[one] + radii[other] + _GAP:
            continue
        edges = (range(len(kinds[token].corners)) for token in (one, other))
        for edge, against in product(*edges):
            contact = Contact(one, edge, other, against)
            gap = _gap(kinds, poses, contact)
            near = abs(gap.wide) < _GAP and abs(gap.turn) < _PARALLEL
            if near and gap.shared > _SHORT:
                found.append(contact)
    return found


def closing(
    kinds: Sequence[Kind], poses: Floats, contacts: Sequence[Contact]
) -> tuple[Floats, Floats]:
    """How far edges that touch are from that.

    Args:
        kinds: n.
        poses: (n, 3).
        contacts: m.

    Returns:
        Pixels (2 m,) that are missing to lie along and without a gap, and how these change
        (2 m, 3 n) where tokens move by x, y (pixels) and turn (rad).
    """
    missing, change = np.zeros((len(contacts), 2)), np.zeros((len(contacts), 2, len(kinds), 3))
    for row, contact in enumerate(contacts):
        gap = _gap(kinds, poses, contact)
        missing[row] = -gap.turn * gap.reach, -gap.wide
        for token, sign in ((contact.one, 1.0), (contact.other, -1.0)):
            arm = (gap.out.conjugate() * 1j * (gap.middle - complex(*poses[token, :2]))).real
            change[row, 0, token] = 0.0, 0.0, sign * gap.reach
            change[row, 1, token] = sign * gap.out.real, sign * gap.out.imag, sign * arm
    return missing.ravel(), change.reshape(2 * len(contacts), -1)


def _gap(kinds: Sequence[Kind], poses: Floats, contact: Contact) -> _Gap:
    start, end = _edge(kinds[contact.one], poses[contact.one], contact.edge)
    first, last = _edge(kinds[contact.other], poses[contact.other], contact.against)
    length, along = abs(end - start), (end - start) / abs(end - start)
    way = (last - first) / abs(last - first)
    there = sorted(((point - start) * along.conjugate()).real for point in (first, last))
    low, high = max(0.0, there[0]), min(length, there[1])
    middle, out = start + along * (low + high) / 2.0, -1j * way
    wide = ((middle - first) * out.conjugate()).real
    turn = float(np.angle(-along / way))
    return _Gap(middle, high - low, out, wide, turn, min(length, abs(last - first)) / 2.0)


def _edge(kind: Kind, pose: Floats, number: int) -> tuple[complex, complex]:
    corners = kind.corners[[number, (number + 1) % len(kind.corners)]] @ (1.0, 1j)
    start, end = corners * np.exp(1j * pose[2]) + complex(pose[0], pose[1])
    return complex(start), complex(end)
