"""Acting on outlines: places are taken exactly, the stuck do their best."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import shapely
import torch
from torch import nn

from tangram_agent.agents.outline.filler import Filler
from tangram_agent.agents.outline.filling import Filling
from tangram_agent.agents.outline.values import Corners
from tangram_agent.base.config import NetConfig
from tangram_core.errors import ConfigError
from tangram_core.setup import Setup
from tangram_sim.config import RewardConfig
from tangram_sim.geometry.dissections import Place
from tangram_sim.puzzles.figures import library
from tangram_sim.targets.targets import placement
from tests.agent.agents.outline.outlines import ALL, TWO, outline_setup
from tests.agent.builders import SCENE, Policy, setup

pytestmark = pytest.mark.fast


class Indifferent(nn.Module):
    """Values every state alike, so the first place is taken."""

    def forward(self, corners: Corners) -> torch.Tensor:
        return torch.zeros(len(corners.points))


class Last(nn.Module):
    """Holds the last place for the best one."""

    def forward(self, corners: Corners) -> torch.Tensor:
        return torch.arange(len(corners.points)).float()


def overlaps(made: Setup, value: nn.Module, targets: Any = None, count: int = 6) -> np.ndarray:
    """Raw overlap of some episodes, played by these values."""
    policy = Policy(made)
    policy.actor._filler = Filler(value, made.task)
    with closing(made.task.make(count).world) as env:
        env.reset([np.random.default_rng(i) for i in range(count)], targets)
        for _ in range(env.horizon):
            result = env.step(policy.act(env.seen, env.closed, env.seen_goals))
            assert not result.blocked.any()
            assert not result.refused.any()
    return np.asarray(result.coverage)


def test_a_place_is_taken_exactly() -> None:
    """Two triangles, glued by chance: in some outlines one fits where the other then does not."""
    raw = overlaps(outline_setup(), Indifferent())
    assert raw.max() == pytest.approx(1.0, abs=1e-4)
    assert raw.min() < 0.9


def test_values_decide_between_places() -> None:
    made = outline_setup()
    filling, layout = Filling(made.task.layout), made.task.layout
    leg = float(np.sqrt(2.0 * layout.areas[0]))
    square = np.array([[0, 0], [leg, 0], [leg, leg], [0, leg], [0, 0]])
    rows = np.concatenate([square, np.zeros((made.task.goal_rows - 5, 2))])[None]
    corners = layout.corners(np.array([[0.9, 0.9, 0.0], [-0.9, 0.9, 0.0]]))[None]
    places = filling.places(filling.rest(rows[0], corners[0], np.zeros(2, np.bool_)), (2,))
    open_ = [place for place in places if not place.filled]
    assert len(open_) > 1
    for value, wanted in ((Indifferent(), places[0]), (Last(), open_[-1])):
        nowhere, own = np.zeros((1, 2), np.bool_), Filler(value, made.task)
        step = own.choose(corners, nowhere, rows, np.zeros(1, np.bool_))
        went = layout.poses(corners)[0, step.token[0], :2]
        went = went + step.velocity[0, :2] * made.task.sim.arena
        assert went == pytest.approx(wanted.laid.pose[:2], abs=1e-5)


def test_where_nothing_fits_a_token_still_covers_what_it_can() -> None:
    """A strip of the area of two triangles has no corner for them."""
    made = outline_setup()
    filling, layout = Filling(made.task.layout), made.task.layout
    leg = float(np.sqrt(2.0 * layout.areas[0]))
    strip = np.array([[0, 0], [2 * leg, 0], [2 * leg, leg / 2], [0, leg / 2], [0, 0]])
    rows = np.concatenate([strip, np.zeros((made.task.goal_rows - 5, 2))])[None]
    corners = layout.corners(np.array([[0.9, 0.9, 0.0], [-0.9, 0.9, 0.0]]))[None]
    placed = np.zeros((1, 2), np.bool_)
    filler = Filler(Indifferent(), made.task)
    assert filling.places(filling.rest(rows[0], corners[0], placed[0]), (2,)) == []
    step = filler.choose(corners, placed, rows, np.zeros(1, np.bool_))
    went = layout.poses(corners)[0, step.token[0], :2] + step.velocity[0, :2] * made.task.sim.arena
    assert went == pytest.approx([leg, leg / 4], abs=1e-5)  # the strip's middle
    # Exploring nothing is learned from where it lies, and it stays.
    one = [np.random.default_rng(0)]
    for anything in (np.zeros(1, np.bool_), np.ones(1, np.bool_)):
        assert (filler.choose(corners, placed, rows, anything, one).velocity == 0).all()


@pytest.mark.parametrize("larger", [1.0, 1.2])
def test_who_has_a_token_left_lets_it_lie_where_it_would_lie_on_another(larger: float) -> None:
    """A placed triangle covers an outline, or all of it but a rim."""
    made = outline_setup()
    corners = made.task.layout.corners(np.array([[0.3, 0.2, 0.0], [-0.9, 0.9, 0.0]]))[None]
    first = corners[0, made.task.layout.corners_of(0)]
    middle = first.mean(axis=0)
    target = middle + larger * (np.concatenate([first, first[:1]]) - middle)
    rows = np.concatenate([target, np.zeros((made.task.goal_rows - len(target), 2))])[None]
    placed = np.array([[True, False]])
    filling = Filling(made.task.layout)
    rest = filling.rest(rows[0], corners[0], placed[0])
    assert rest.is_empty == (larger == 1.0)
    assert filling.places(rest, (2,)) == []
    step = Filler(Indifferent(), made.task).choose(corners, placed, rows, np.zeros(1, np.bool_))
    assert step.token.tolist() == [1]
    assert (step.velocity == 0).all()


def test_exploring_takes_any_place_that_is_not_dead() -> None:
    made = outline_setup(ALL, {"uniform_share": 1.0}, arena=2.0)
    policy = Policy(made)
    with closing(made.task.make(12).world) as env:
        figure = placement(library("test", 0.6)[0], made.task.layout)
        targets = tuple(np.stack([part] * 12) for part in figure)
        generators = [np.random.default_rng(i) for i in range(12)]
        env.reset(generators, targets)
        actions = policy.explore(env.seen, env.closed, env.seen_goals, generators)
        tokens = {tuple(np.round(env.goals[0, 0] + action[1:3], 2)) for action in actions}
        env.step(actions)
        ends = Filling(made.task.layout)
        inside = [ends.inside(env.corners[i], env.seen_goals[i]).sum() for i in range(12)]
    assert len(tokens) > 1
    assert min(inside) == 1


def test_corners_of_pieces_are_no_outline() -> None:
    made = outline_setup()
    corners = made.task.layout.corners(np.zeros((1, 2, 3)))
    with pytest.raises(ConfigError, match=r"got \(1, 6, 2\): give rows that .*as_rows makes"):
        Policy(made).act(corners, np.zeros((1, 2)), corners)


def test_filled_is_surer_than_any_value() -> None:
    made = outline_setup()
    filler = Filler(Indifferent(), made.task)
    filling = Filling(made.task.layout)
    leg = float(np.sqrt(2.0 * made.task.layout.areas[0]))
    first: Sequence[Place] = filling.places(shapely.box(0, 0, leg, leg), (2,))
    last = filling.places(first[0].rest, first[0].left)
    assert filler.values([*first, *last]).tolist() == [0.0, 0.0, np.inf]
    angles = np.linspace(0.0, 2.0 * np.pi, 101)[:-1]
    star = (1.0 + 0.5 * (-1.0) ** np.arange(100)) * np.exp(1j * angles)
    rugged = shapely.Polygon(np.column_stack([star.real, star.imag]))
    assert filler.values([first[0]._replace(rest=rugged)]).tolist() == [-np.inf]


@pytest.mark.parametrize(
    ("agent", "sim", "reason"),
    [
        ({}, {"observe": "corners"}, "shows outlines, got sim.observe=corners: set sim=silhouette"),
        ({}, {"starts": "anywhere"}, r"sim.starts=anywhere: .* set sim.starts=outside"),
        ({}, {"actions_per_token": 2}, r"actions_per_token=2: .* set sim.actions_per_token=1"),
    ],
)
def test_what_an_agent_of_outlines_cannot_use_is_refused(
    agent: dict[str, Any], sim: dict[str, Any], reason: str
) -> None:
    with pytest.raises(ConfigError, match=reason):
        outline_setup(TWO, agent, **sim)


def test_a_lone_token_a_perceptron_and_one_side_are_refused() -> None:
    with pytest.raises(ConfigError, match="a set of several tokens"):
        outline_setup({"shapes": ["small_triangle"], "scale": 1.0})
    made = outline_setup(ALL)
    with pytest.raises(ConfigError, match="sim.allow_flip=true"):
        made.task.with_sim(allow_flip=False)
    with pytest.raises(ConfigError, match="reward.name=dense changes nothing .* set task=place"):
        replace(made.task, reward=RewardConfig(name="dense")).check(plays=False)
    with pytest.raises(ConfigError, match="net.kind=mlp"):
        replace(made, agent=replace(made.agent, net=NetConfig(kind="mlp")))


def test_values_are_for_outlines_alone() -> None:
    made, other = outline_setup(), setup()
    with pytest.raises(ConfigError, match="agent.kind=outline fills outlines: set task=fill, or"):
        replace(made, task=other.task)
    for shown in (other, setup(agent=SCENE)):
        with pytest.raises(ConfigError, match=f"agent.kind={shown.agent_kind} needs tokens"):
            replace(shown, task=made.task)
