"""Making the model of contacts that comes with the package, in about two minutes of one core.

`python -m tangram_lab.experiments.contacts` plays short pushes of two tokens in the engine, learns
from them how the pushed one is shifted and turned, and puts the model with a card that tells its
errors into `tangram_agent/pretrained/contacts`.

Legend: N pushes of one kind of token against one of another.
"""

import argparse
import hashlib
import json
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import safetensors.numpy
import torch
import yaml
from torch import Tensor, nn

from master.result import commit, versions
from tangram_agent.adam import Adam
from tangram_agent.contacts import (
    LAYOUT,
    PUSH,
    SCALE,
    SIM,
    TOKENS,
    WORLD,
    features,
    network,
    seen,
    world,
)
from tangram_agent.coverage import Lying
from tangram_agent.files import check_writable, write_whole
from tangram_agent.networks import initialise
from tangram_agent.pretrained import CARD, CARD_TEXT, CONFIG, CONTACTS, FORMAT, PREFIX, WEIGHTS
from tangram_agent.weights import to_arrays
from tangram_lab.experiments.pretrained import PACKAGE
from tangram_sim.arrays import Floats, Singles
from tangram_sim.errors import TangramError
from tangram_sim.geometry import separations
from tangram_sim.kinematics import wrap
from tangram_sim.layout import TokensConfig, make_layout
from tangram_sim.settings import check_range
from tangram_sim.world import make_world

PUSHES, UPDATES, BATCH, RATE = 60_000, 10_000, 512, 2e-3
TESTED = 0.05  # share of the pushes that nothing is learned from
_HALVINGS = 14  # until tokens touch
_TOUCHING = 1e-4  # so far apart are tokens that touch


class Pushes(NamedTuple):
    """Two tokens each: one went a way (N, 3), and the other one was moved by (N, 3)."""

    movers: Lying
    way: Floats
    others: Lying
    moved: Floats


def play(count: int, seed: int = 0) -> Iterator[Pushes]:
    """About so many pushes, in a world of its own for each two kinds of tokens."""
    generator = np.random.default_rng(seed)
    kinds = range(len(TOKENS.shapes))
    for one in kinds:
        for other in kinds:
            yield _played(*_drawn(one, other, count // len(kinds) ** 2, generator))


def _drawn(
    one: int, other: int, count: int, generator: np.random.Generator
) -> tuple[Lying, Floats, Lying]:
    """Tokens that touch, nearly touch or overlap a little, and short ways."""
    towards, angle, own = generator.uniform(-np.pi, np.pi, (3, count))
    chiral, sides = LAYOUT.chiral, generator.random((2, count)) < 0.5
    lies = np.column_stack([np.zeros((count, 2)), own])
    others = Lying(np.full(count, other), lies, sides[0] & chiral[other])
    movers = Lying(np.full(count, one), np.zeros((count, 3)), sides[1] & chiral[one])
    unit = np.column_stack([np.cos(towards), np.sin(towards)])

    def away(distance: Floats) -> Lying:
        return replace(movers, pose=np.column_stack([distance[:, None] * unit, angle]))

    low, high = np.zeros(count), np.full(count, LAYOUT.radii[one] + LAYOUT.radii[other])
    for _ in range(_HALVINGS):
        middle = (low + high) / 2.0
        depth, _ = separations(away(middle).outlines(LAYOUT), others.outlines(LAYOUT))
        low, high = np.where(depth > 0.0, middle, low), np.where(depth > 0.0, high, middle)
    apart = generator.choice([0.0, 1.0, -0.5], count, p=[0.5, 0.25, 0.25])
    apart *= generator.uniform(0.0, 0.5 * PUSH, count)
    direction = towards + np.pi + generator.normal(0.0, 0.9, count)
    length = generator.uniform(0.0, 1.2 * PUSH, count)
    turns = generator.random(count) < 0.7
    turn = turns * generator.normal(0.0, 0.5 * PUSH / LAYOUT.radii[one], count)
    way = np.column_stack([length * np.cos(direction), length * np.sin(direction), turn])
    return away(high + _TOUCHING + apart), way, others


def _played(movers: Lying, way: Floats, others: Lying) -> Pushes:
    names = tuple(TOKENS.shapes[int(lying.index[0])] for lying in (movers, others))
    layout = make_layout(TokensConfig(names, TOKENS.scale))
    # In steps as long as those of a long way, which a short push is a part of.
    with closing(make_world(layout, replace(SIM, substeps=1))) as engine:
        ends = []
        for poses, sides, velocity in zip(
            np.stack([movers.pose, others.pose], axis=1),
            np.stack([movers.flipped, others.flipped], axis=1),
            way,
            strict=True,
        ):
            engine.place(poses, sides)
            engine.move(0, velocity)
            ends.append(engine.poses()[1])
    moved = np.array(ends).reshape(-1, 3) - others.pose
    moved[:, 2] = wrap(moved[:, 2])
    return Pushes(movers, way, others, moved)


def learn(rows: Tensor, wanted: Tensor, updates: int, seed: int = 0) -> nn.Sequential:
    """The layers, fitted to features (N, F) and what came of them, (N, 3), scaled."""
    generator = torch.Generator().manual_seed(seed)
    layers = network()
    initialise(layers, generator)
    parameters = list(layers.parameters())
    optimiser = Adam(parameters)
    for update in range(updates):
        rate = RATE * (1.0 + np.cos(np.pi * update / updates)) / 2.0
        drawn = torch.randint(len(rows), (BATCH,), generator=generator)
        loss = nn.functional.smooth_l1_loss(layers(rows[drawn]), wanted[drawn], beta=0.1)
        optimiser.step(torch.autograd.grad(loss, parameters), float(rate))
    return layers


def make(pushes: int = PUSHES, updates: int = UPDATES) -> tuple[nn.Sequential, dict[str, Any]]:
    """The layers, and what the card says of them."""
    parts = list(play(pushes))
    rows, wanted = _learnable(parts)
    order = torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))
    tested = int(TESTED * len(rows))
    test, train = order[:tested], order[tested:]
    layers = learn(rows[train], wanted[train], updates)
    with torch.no_grad():
        off = (layers(rows[test]) - wanted[test]).numpy() * SCALE
    moved = wanted[test].numpy() * SCALE
    return layers, {
        "pushes": sum(len(part.way) for part in parts),
        "learned_from": len(train),
        "tested_on": len(test),
        "shift_error_median": _median_shift(off),
        "shift_median": _median_shift(moved),
        "turn_error_deg_median": _median_turn(off),
        "turn_deg_median": _median_turn(moved),
    }


def _learnable(parts: list[Pushes]) -> tuple[Tensor, Tensor]:
    """Features and what came of them, where a token would come to lie on the other."""
    rows, wanted = list[Singles](), list[Singles]()
    for movers, way, others, moved in parts:
        ends = replace(movers, pose=movers.pose + way).outlines(LAYOUT)
        touch = separations(ends, others.outlines(LAYOUT))[0] > 0.0
        rows.append(features(movers, way, others)[touch])
        wanted.append((seen(movers, moved) / SCALE)[touch].astype(np.float32))
    return torch.from_numpy(np.concatenate(rows)), torch.from_numpy(np.concatenate(wanted))


def _median_shift(moved: Floats) -> float:
    return round(float(np.median(np.hypot(*moved[:, :2].T))), 6)


def _median_turn(moved: Floats) -> float:
    return round(float(np.degrees(np.median(np.abs(moved[:, 2])))), 4)


def publish(folder: Path, pushes: int = PUSHES, updates: int = UPDATES) -> dict[str, Any]:
    """Make the model and write its folder; the card says what it is.

    Raises:
        TangramError: the folder cannot be written, which is seen first.
    """
    check_writable("--out", folder.absolute() / CARD)
    layers, told = make(pushes, updates)
    weights: bytes = safetensors.numpy.save(dict(sorted(to_arrays(layers).items())))
    card = {
        "format": FORMAT,
        "name": CONTACTS,
        "licence": "MIT",
        "data": "short pushes of two tokens in PyBullet, drawn at random; nothing was played",
        **told,
        "updates": updates,
        "commit": commit(),
        "versions": versions(),
        "sha256": hashlib.sha256(weights).hexdigest(),
    }
    write_whole(folder / CONFIG, yaml.safe_dump(world(), sort_keys=False).encode())
    write_whole(folder / WEIGHTS, weights)
    write_whole(folder / CARD_TEXT, _card_text(card).encode())
    write_whole(folder / CARD, (json.dumps(card, indent=1) + "\n").encode())
    return card


def _card_text(card: dict[str, Any]) -> str:
    sim = ", ".join(f"sim.{name}={getattr(SIM, name):g}" for name in WORLD)
    return f"""\
# {PREFIX}/{CONTACTS}

No agent: what a token that slides does to another one, for `agent.lookahead=learned`. Learned in
{card["updates"]:,} updates from {card["learned_from"]:,} short pushes of two tokens in PyBullet,
drawn at random; no puzzle was played. It knows {", ".join(TOKENS.shapes)}
at tokens.scale={TOKENS.scale:g}, with {sim}. Licence: MIT.

On {card["tested_on"]:,} other pushes, medians: the pushed token's shift is off by
{card["shift_error_median"]:.4f} (it is {card["shift_median"]:.4f}), its turn by \
{card["turn_error_deg_median"]:.2f}° (it is {card["turn_deg_median"]:.2f}°).

Made by `python -m tangram_lab.experiments.contacts`, at commit {card["commit"] or "unknown"}.
"""


def main() -> int:
    """`python -m tangram_lab.experiments.contacts`."""
    program = "python -m tangram_lab.experiments.contacts"
    parser = argparse.ArgumentParser(prog=program, description=__doc__)
    parser.add_argument("--out", type=Path, default=PACKAGE / CONTACTS, help="its folder")
    parser.add_argument("--pushes", type=int, default=PUSHES, help=f"played ({PUSHES})")
    parser.add_argument("--updates", type=int, default=UPDATES, help=f"learned in ({UPDATES})")
    given = parser.parse_args()
    torch.set_num_threads(1)
    try:
        check_range("--pushes", given.pushes, 100)
        check_range("--updates", given.updates, 1)
        card = publish(given.out, given.pushes, given.updates)
    except TangramError as error:
        sys.stderr.write(f"contacts: {error}\n")
        return 2
    sys.stdout.write(json.dumps(card, indent=1) + f"\n{given.out}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
