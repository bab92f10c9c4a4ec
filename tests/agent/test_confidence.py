"""How surely tokens are seen: what agents that know it make of that, and the others."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
import torch

from tangram_agent.motion import motions_of
from tangram_agent.networks import Networks, initialise
from tangram_agent.pairs import PairGraph, Pairs
from tangram_agent.planning import Planner
from tangram_agent.relabelling import make_pairs
from tangram_agent.replay import ReplayBuffer
from tangram_agent.setup import Setup
from tangram_agent.steps import Stepping
from tangram_agent.types import AWAY, Episodes, Past, Transitions
from tangram_sim.actions import flips, make_actions
from tangram_sim.arrays import Floats, Singles
from tangram_sim.errors import ConfigError
from tests.agent.builders import SMALL, setup
from tests.agent.pair_scenes import (
    PERCEPTRON,
    PerfectCritic,
    PerfectNetworks,
    random_pairs,
    random_scene,
    seven,
    transitions,
)

pytestmark = pytest.mark.fast

KNOWS: dict[str, Any] = {"confidence": True}
DOUBTFUL = 0.4


def episodes(confidence: list[list[float]], named: list[int]) -> Episodes:
    """One episode of three tokens of which actions named these."""
    made = setup({"shapes": ["square"] * 3, "scale": 0.5})
    steps = len(named)
    ways = np.full((steps, 3), 0.1, np.float32)
    flip = np.zeros(steps, np.bool_)
    return Episodes(
        corners=np.zeros((1, steps + 1, 12, 2), np.float32),
        placed=np.zeros((1, steps + 1, 3), np.uint8),
        actions=make_actions(np.array(named), ways, flip, 3, made.sim)[None].astype(np.float32),
        rewards=np.zeros((1, steps), np.float32),
        goals=np.zeros((1, 12, 2), np.float32),
        confidence=np.array([confidence], np.float32),
        goals_confidence=np.ones((1, 3), np.float32),
    )


@pytest.mark.parametrize(
    ("confidence", "knows", "other"),
    [
        ([[1, 1, 1], [1, 1, 1], [1, 1, 1]], 1, 1),
        ([[DOUBTFUL, 1, 1], [1, 1, 1], [1, 1, 1]], 1, 0),  # what it did was seen
        ([[1, 1, DOUBTFUL], [1, 1, DOUBTFUL], [1, 1, 0]], 1, 0),  # nobody named it
        ([[1, 1, 1], [DOUBTFUL, 1, 1], [1, 1, 1]], 0, 0),  # named, and not surely seen after that
        ([[1, 1, 1], [AWAY, 1, 1], [AWAY, 1, 1]], 1, 1),  # it left the picture, as it was told
        ([[1, 1, 1], [1, 1, 1], [1, 0.49, 1]], 0, 0),
        ([[1, 1, 1], [1, 1, 1], [1, 0.5, 1]], 1, 1),
    ],
)
def test_which_episodes_are_learned_from(
    confidence: list[list[float]], knows: int, other: int
) -> None:
    played = episodes(confidence, [0, 1])
    assert played.learnable(True).count == knows
    assert played.learnable(False).count == other
    if knows:
        np.testing.assert_array_equal(played.learnable(True).confidence, played.confidence)
    unsure = replace(played, goals_confidence=np.full((1, 3), DOUBTFUL, np.float32))
    assert unsure.learnable(True).count == 0


def test_no_episodes_are_none() -> None:
    played = episodes([[1, 1, 1], [1, 1, 1], [0, 0, 0]], [0, 1])
    assert played.learnable(True).learnable(True).count == 0


def with_confidence(batch: Transitions, before: Floats, after: Floats) -> Transitions:
    shares = (np.asarray(part, np.float32) for part in (before, after))
    return replace(batch, **dict(zip(("confidence", "next_confidence"), shares, strict=True)))


@pytest.mark.parametrize("allow_flip", [False, True])
def test_a_doubtful_token_is_judged_by_where_it_was_told_to_go(allow_flip: bool) -> None:
    """A sure one by where it came to: the reward is that of where it is seen after the action."""
    made = seven(KNOWS, allow_flip=allow_flip)
    batch, full = transitions(made, 40), np.ones((40, 7))
    rng = np.random.default_rng(1)
    before = np.where(rng.random((40, 7)) < 0.5, DOUBTFUL, 1.0)
    known = make_pairs(with_confidence(batch, before, full), made, np.random.default_rng(0))
    plain = make_pairs(batch, made, np.random.default_rng(0))
    doubtful = known.confidence < 0.5
    assert 0 < doubtful.sum() < len(doubtful)
    told = plain.before + plain.velocity * (made.sim.arena, made.sim.arena, np.pi)
    expected = np.where(doubtful[:, None], told, plain.after)
    np.testing.assert_allclose(known.after, expected, atol=1e-12)
    each = len(plain.token) // 40
    turned = np.repeat(flips(batch.action.astype(float), made.layout, made.sim), each)
    assert turned[doubtful].any() == allow_flip
    sides = np.where(doubtful, plain.before_flipped ^ turned, plain.after_flipped)
    np.testing.assert_array_equal(known.after_flipped, sides)
    for name in ("reward", "goal", "start", "covered", "before", "token"):
        np.testing.assert_array_equal(vars(known)[name], vars(plain)[name], err_msg=name)
    assert (plain.confidence == 1.0).all()


def test_the_actor_is_asked_again_of_a_token_as_it_is_seen_then() -> None:
    made = seven(KNOWS)
    batch = transitions(made, 40)
    unsure = with_confidence(batch, np.full((40, 7), 0.25), np.full((40, 7), 0.75))
    pairs = make_pairs(unsure, made, np.random.default_rng(0))
    again = (pairs.start != pairs.before).any(axis=1)
    assert 0 < again.sum() < len(again)
    np.testing.assert_array_equal(pairs.start_confidence, np.where(again, 0.75, 0.25))
    steps = Stepping(made, torch.device("cpu"))(pairs)
    assert steps.view.confidence.unique().tolist() == [0.25]  # type: ignore[union-attr]
    assert steps.seen_after.confidence.unique().tolist() == [0.25]  # type: ignore[union-attr]
    assert steps.start.confidence.tolist() == pairs.start_confidence.tolist()  # type: ignore[union-attr]


def test_no_network_sees_less_than_none() -> None:
    made = seven(KNOWS)
    left = with_confidence(transitions(made, 8), np.full((8, 7), AWAY), np.full((8, 7), AWAY))
    pairs = make_pairs(left, made, np.random.default_rng(0))
    assert not pairs.confidence.any()
    assert not pairs.start_confidence.any()


@pytest.mark.parametrize("net", [SMALL, PERCEPTRON])
def test_only_networks_of_agents_that_know_it_see_it(net: dict[str, Any]) -> None:
    values = []
    for agent in ({}, KNOWS):
        made = seven(agent, net)
        networks = Networks(made)
        initialise(networks, torch.Generator().manual_seed(0))
        pairs, still = random_pairs(made.layout, 3), torch.zeros(49, 3)
        shares = None, torch.ones(49), torch.zeros(49)
        every = [replace(pairs, confidence=share) for share in shares]
        with torch.no_grad():
            values.append([networks.critic(one, still) for one in every])
        assert torch.equal(values[-1][0], values[-1][1])
    assert torch.equal(values[0][0], values[0][2])
    assert not torch.isclose(values[1][0], values[1][2]).any()


def seen(confidence: Singles, placed: np.ndarray) -> Past:
    """Before any action."""
    return Past(
        np.zeros((len(placed), 0, 23, 2), np.float32),
        np.zeros((len(placed), 0, 4), np.float32),
        confidence[:, None].astype(np.float32),
        placed.astype(np.uint8),
    )


def chosen(made: Setup, confidence: Singles, placed: np.ndarray, likes: Floats) -> list[int]:
    """What is played of random scenes by who likes tokens so; pictures have closed the unsure."""
    rng = np.random.default_rng(2)
    corners, goals = (made.layout.corners(*random_scene(made.layout, rng, 6)) for _ in range(2))
    graph = PairGraph(made.layout, made.sim.arena, made.agent)
    networks = PerfectNetworks(PerfectCritic(made.layout, likes), graph)
    closed = placed | (confidence < 0.5)
    closed = np.where(closed.all(axis=1, keepdims=True), placed, closed)  # as `BatchedEnv.closed`
    past = seen(confidence, placed)
    chooser = Planner(cast("Networks", networks), made)
    return chooser.choose(corners, closed, goals, past=past).token.tolist()


def test_who_knows_it_may_move_a_doubtful_token_and_never_one_that_is_gone() -> None:
    """The critic likes token 2 and no other."""
    likes = np.eye(7)[2]
    full, none = np.ones((6, 7)), np.zeros((6, 7), np.bool_)
    doubt, gone, left = full.copy(), full.copy(), none.copy()
    doubt[:, 2], gone[:, 2], left[:, 2] = DOUBTFUL, 0.0, True
    for agent, confidence, placed, moved in (
        ({}, full, none, True),
        ({}, doubt, none, False),
        (KNOWS, full, none, True),
        (KNOWS, doubt, none, True),
        (KNOWS, gone, none, False),
        (KNOWS, np.where(gone == 0.0, AWAY, 1.0), none, False),
        (KNOWS, doubt, left, False),
    ):
        played = chosen(seven(agent), confidence, placed, likes)
        assert {token == 2 for token in played} == {moved}


def test_where_nothing_is_seen_a_token_that_is_left_is_played() -> None:
    placed = np.zeros((6, 7), np.bool_)
    placed[:, 0] = True
    assert 0 not in chosen(seven(KNOWS), np.zeros((6, 7)), placed, np.ones(7))


def test_what_the_camera_is_sure_of_reaches_the_networks_in_play(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told = dict[int, float]()
    see = PairGraph.vectors

    def watched(graph: PairGraph, pairs: Pairs) -> torch.Tensor:
        assert pairs.confidence is not None
        told.update(zip(pairs.token.tolist(), pairs.confidence.tolist(), strict=True))
        return see(graph, pairs)

    monkeypatch.setattr(PairGraph, "vectors", watched)
    made = seven(KNOWS, PERCEPTRON)
    networks = Networks(made)
    initialise(networks, torch.Generator().manual_seed(0))
    rng = np.random.default_rng(2)
    corners, goals = (made.layout.corners(*random_scene(made.layout, rng, 1)) for _ in range(2))
    confidence, placed = np.linspace(0.25, 1.0, 7)[None], np.zeros((1, 7), np.bool_)
    chooser = Planner(networks.requires_grad_(False), made)
    chooser.choose(corners, confidence < 0.5, goals, past=seen(confidence, placed))
    expected = dict(enumerate(confidence[0].astype(np.float32).tolist()))
    assert told == pytest.approx(expected)


@pytest.mark.parametrize("delay", [False, True])
def test_what_is_not_surely_seen_tells_nothing_of_the_motion(delay: bool) -> None:
    made = seven(actions_per_token=1, delay=delay)
    batch, steps = transitions(made, 12), 3
    token = np.clip(np.floor((batch.action[:, 0] + 1.0) / 2.0 * 7), 0, 6).astype(np.int64)
    poses = np.repeat(made.layout.poses(batch.state.astype(np.float64))[:, None], steps + 1, axis=1)
    poses[np.arange(12), :, token, 0] += 0.1 * np.arange(steps + 1)  # the others lie still
    corners = made.layout.corners(poses)
    actions = np.repeat(batch.action[:, None], steps, axis=1)
    share = np.where(np.random.default_rng(0).random((12, steps + 1, 7)) < 0.5, DOUBTFUL, 1.0)
    past = Past(corners[:, :steps], actions, share.astype(np.float32))
    motions = motions_of(past, corners[:, steps].astype(np.float64), made.layout, made.sim)
    every = motions_of(
        replace(past, confidence=None), corners[:, steps].astype(np.float64), made.layout, made.sim
    )
    own = np.take_along_axis(share, token[:, None, None], axis=2)[..., 0] == 1.0
    sure = own[:, :-1] & own[:, 1:]
    expected = every.moved.numpy() * sure[:, delay:]
    assert 0 < expected.sum() < every.moved.sum()
    np.testing.assert_array_equal(motions.moved, expected)


def test_the_replay_keeps_it() -> None:
    made = seven(KNOWS)
    rng = np.random.default_rng(0)
    before, after = rng.random((2, 10, 7)).astype(np.float32)
    batch = with_confidence(transitions(made, 10), before, after)
    replay, other = (ReplayBuffer(10, 23, 7, made.action_size, True) for _ in range(2))
    replay.add(batch)
    other.load_state(replay.state())
    for one in (replay, other):
        drawn = one.sample(50, np.random.default_rng(1))
        same = (batch.state == drawn.state[:, None]).all(axis=(2, 3))
        row = same.argmax(axis=1)
        np.testing.assert_array_equal(drawn.confidence, before[row])
        np.testing.assert_array_equal(drawn.next_confidence, after[row])
        past, _ = one.sample_episodes(4, 5, np.random.default_rng(1))
        assert past.confidence is not None
        assert past.confidence.shape == (4, 6, 7)
        assert any((past.confidence[0, :5] == before[i : i + 5]).all() for i in (0, 5))
        assert any((past.confidence[0, 5] == after[i]).all() for i in (4, 9))


@pytest.mark.parametrize(
    ("tokens", "agent", "said"),
    [
        ({"shapes": ["square"], "scale": 1.0}, KNOWS, "changes nothing with one token"),
        (
            {},
            KNOWS | {"credit": "reward"},
            "confidence=true changes nothing with agent.credit",
        ),
    ],
)
def test_where_it_changes_nothing_it_is_refused(
    tokens: dict[str, Any], agent: dict[str, Any], said: str
) -> None:
    with pytest.raises(ConfigError, match=said):
        setup(tokens, agent) if tokens else seven(agent)


@pytest.mark.parametrize(
    ("sim", "said"),
    [
        (
            {},
            "changes nothing with sim.observe=corners: .* set sim.observe=pictures",
        ),
        ({"observe": "pictures", "pixels": 64, "bias": (0.1, 0.0, 0.0)}, "with sim.bias as set"),
        ({"observe": "pictures", "pixels": 64}, ""),
    ],
)
def test_it_is_learned_from_pictures_of_an_exact_world(sim: dict[str, Any], said: str) -> None:
    made = seven(KNOWS, **sim)
    if not said:
        made.check_learnable()
        return
    with pytest.raises(ConfigError, match=said):
        made.check_learnable()
