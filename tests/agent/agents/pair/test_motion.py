"""The motion model: exact at first, right after it has seen, and never surer than it may be."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from tangram_agent.agents.pair.motion import Fit, MotionModel, Motions, features, motions_of
from tangram_agent.base.replay import ReplayBuffer
from tangram_agent.base.types import Transitions
from tangram_agent.nets.weights import load_arrays, to_arrays
from tangram_core.errors import ConfigError, RunError
from tangram_tasks.played import Past
from tests.agent.agents.pair.pair_scenes import SEVEN
from tests.agent.builders import PAIR, SQUARE, Policy, history, learner_of, random_episodes, setup

pytestmark = pytest.mark.fast

LEARNED = {"motion": "learned"}
SCALE = np.array([2.0, 2.0, np.pi])


def commands(count: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(-1, 1, (count, 3))).float()


def seen(ways: torch.Tensor, told: torch.Tensor) -> Motions:
    """Motions of one episode (T, 3)."""
    return Motions(told[None], ways[None], torch.ones(1, len(told)))


def at_first() -> MotionModel:
    """As sure of the exact motion as a deviation of 0.3, with little noise."""
    torch.manual_seed(0)  # the learned features decide how near four actions come
    model = MotionModel()
    model.log_noise.fill_(2.0 * np.log(1e-3))
    model.log_variance.fill_(2.0 * np.log(0.3))
    return model


def test_before_anything_is_learned_the_motion_is_exact() -> None:
    model, told = MotionModel(), commands(64)
    belief = model.prior(64)
    torch.testing.assert_close(model.predict(belief, told)[0], told)
    torch.testing.assert_close(model.command(belief, told), told)
    far = torch.tensor([[2.0, -3.0, 0.5]])
    torch.testing.assert_close(model.command(model.prior(1), far), far.clamp(-1.0, 1.0))


def test_a_belief_equals_the_regression_in_closed_form() -> None:
    torch.manual_seed(0)
    model, told = at_first(), commands(7)
    ways = 0.8 * told + 0.05 * torch.randn(7, 3)
    belief = model.belief(seen(ways, told))
    phi = features(told)
    for row in range(3):
        precision = torch.diag(1.0 / model.log_variance[row].double().exp())
        scale = (-model.log_noise[row].double()).exp()
        covariance = torch.linalg.inv(precision + scale * phi.T @ phi)
        told_by = scale * phi.T @ ways[:, row].double()
        mean = covariance @ (precision @ model.mean[row].double() + told_by)
        torch.testing.assert_close(belief.mean[0, row], mean)
        torch.testing.assert_close(belief.covariance[0, row], covariance)


@pytest.mark.parametrize("moved", [0.0, 1.0])
def test_what_did_not_move_tells_nothing(moved: float) -> None:
    model, told = at_first(), commands(3)
    motions = Motions(told[None], torch.zeros(1, 3, 3), torch.full((1, 3), moved))
    after, before = model.belief(motions), model.prior(1)
    for found, usual in zip(vars(after).values(), vars(before).values(), strict=True):
        assert torch.equal(found, usual) == (moved == 0.0)


def test_it_grows_surer_where_it_has_seen_and_finds_the_command() -> None:
    """A world with a gain and a bias of each axis, from four actions."""
    model, told = at_first(), commands(4)
    gain, bias = torch.tensor([0.8, 1.2, 0.9]), torch.tensor([0.03, -0.02, 0.05])
    before = model.predict(model.prior(4), told)[1]
    belief = model.belief(seen(gain * told + bias, told))
    after = model.predict(belief.at(torch.zeros(4, dtype=torch.int64)), told)[1]
    assert (after < 0.1 * before).all()
    wanted = torch.tensor([[0.1, -0.2, 0.15]])
    command = model.command(belief, wanted)
    torch.testing.assert_close(gain * command + bias, wanted, atol=0.02, rtol=0.0)


@pytest.mark.parametrize("gain", [0.5, 1.9, 2.0, 3.0])
@pytest.mark.parametrize("bias", [0.0, 0.3])
def test_the_command_is_found_whatever_the_gain(gain: float, bias: float) -> None:
    model = at_first()
    model.mean[:, :3] *= gain
    model.mean[:, 3] = bias
    wanted = bias + 0.9 * gain * commands(50) * torch.tensor([1.0, 1.0, 0.3])
    belief = model.prior(50)
    found = model.predict(belief, model.command(belief, wanted))[0]
    off = (found - wanted).abs()
    off[:, 2] = torch.remainder(off[:, 2] + 1.0, 2.0) - 1.0
    assert off.abs().max() < 1e-3


def test_a_turn_that_falls_short_is_made_the_other_way_round() -> None:
    model = at_first()
    model.mean[2, 3] = 0.5  # it turns a quarter further, whatever it is told
    belief, wanted = model.prior(1), torch.tensor([[0.0, 0.0, -0.9]])
    command = model.command(belief, wanted)
    assert command[0, 2] == pytest.approx(0.6, abs=1e-3)  # to 1.1, which is -0.9


def test_turns_are_compared_by_the_shorter_way() -> None:
    model = at_first()
    told = torch.tensor([[0.0, 0.0, 0.99]])
    belief = model.belief(seen(torch.tensor([[0.0, 0.0, -0.99]]), told))
    expected = model.predict(belief, told)[0][0, 2]
    assert expected == pytest.approx(1.01, abs=1e-3)  # it went 0.02 further, not back


def fitted(
    ways: Callable[[torch.Tensor], torch.Tensor], steps: int, updates: int, screened: bool = False
) -> MotionModel:
    """A model after so many updates with 256 motions each."""
    model = MotionModel()
    fit = Fit(model, screened)
    for update in range(updates):
        told = commands(256, seed=update).view(-1, steps, 3)
        fit.step(Motions(told, ways(told), torch.ones(told.shape[:2])))
    return model


def test_what_others_stopped_does_not_spoil_what_is_usual() -> None:
    """One motion of twenty ends anywhere on its way."""

    def world(told: torch.Tensor) -> torch.Tensor:
        chance = torch.Generator().manual_seed(int(1e6 * told.abs().sum()))
        met = torch.rand(told.shape[:2], generator=chance) < 0.05
        share = torch.rand(told.shape[:2], generator=chance) * met
        return told * (1.0 - share[..., None]) * torch.tensor([1.0, 0.5, 1.0])

    model, told = fitted(world, 8, 60, screened=True), commands(500, seed=1000)
    off = (model.predict(model.prior(500), told)[0] - told * torch.tensor([1.0, 0.5, 1.0])).abs()
    assert off.max() < 0.01
    assert model.noise.sqrt().max() < 0.005


def test_a_world_that_turns_too_little_is_known_after_a_few_updates() -> None:
    """A shift is shortened by its length and a turn cut, as one step of the engine has it."""

    def world(told: torch.Tensor) -> torch.Tensor:
        shift = (0.96 - 0.08 * told[..., :2].norm(dim=-1, keepdim=True)) * told[..., :2]
        turn = torch.where(told[..., 2:].abs() < 0.25, told[..., 2:], torch.sin(told[..., 2:]))
        return torch.cat([shift, turn], dim=-1)

    model = fitted(world, steps=1, updates=20)
    wanted = 0.5 * commands(50, seed=99)
    reached = world(model.command(model.prior(50), wanted))
    torch.testing.assert_close(reached, wanted, atol=2e-3, rtol=0.0)


def test_what_differs_between_episodes_is_told_from_noise() -> None:
    """Gains and biases drawn for each episode, and noise: their deviations are found."""
    rng = np.random.default_rng(0)

    def world(told: torch.Tensor) -> torch.Tensor:
        gain, bias = (torch.from_numpy(rng.normal(0.0, 1.0, (len(told), 1, 3))) for _ in range(2))
        noise = 0.02 * torch.from_numpy(rng.normal(0.0, 1.0, told.shape))
        return (0.9 + 0.2 * gain) * told + 0.05 * bias + noise

    model = fitted(world, steps=8, updates=400)
    gain, bias = model.mean[:, :3].diagonal(), model.mean[:, 3]
    torch.testing.assert_close(gain, torch.full((3,), 0.9), atol=0.03, rtol=0.0)
    torch.testing.assert_close(bias, torch.zeros(3), atol=0.02, rtol=0.0)
    deviation = (0.5 * model.log_variance).exp()
    torch.testing.assert_close(
        deviation[:, :3].diagonal(), torch.full((3,), 0.2), atol=0.04, rtol=0
    )
    torch.testing.assert_close(deviation[:, 3], torch.full((3,), 0.05), atol=0.02, rtol=0.0)
    torch.testing.assert_close(
        model.log_noise, torch.full((3,), np.log(4e-4)).float(), atol=0.2, rtol=0
    )


def test_sums_of_another_model_are_refused() -> None:
    whole = Fit(MotionModel())
    whole.step(seen(commands(3), commands(3)))
    for name in whole.slots:
        for made in (lambda one: one[1:], lambda one: one * float("nan")):
            with pytest.raises(RunError, match="not those of this version"):
                Fit(MotionModel()).load(whole.slots | {name: list(map(made, whole.slots[name]))})
        wrong = whole.slots | {"squares": [-one for one in whole.slots["squares"]]}
        with pytest.raises(RunError, match="not those of this version: start a new run"):
            Fit(MotionModel()).load(wrong)


@pytest.mark.parametrize("delay", [False, True])
@pytest.mark.parametrize("tokens", [SQUARE, PAIR])
def test_motions_are_those_of_the_token_that_each_action_named(tokens: dict, delay: bool) -> None:
    made = setup(tokens, actions_per_token=2, world="delayed" if delay else "plain")
    layout = made.task.layout
    poses = np.zeros((1, 3, layout.tokens, 3))
    poses[0, :, -1] = [[0.1, 0.2, 3.0], [0.3, 0.1, -3.0], [0.3, 0.1, -3.0]]
    corners = layout.corners(poses)
    named = [1.0] if layout.tokens > 1 else []
    actions = np.array([[[*named, 0.1, 0.2, 0.3], [*named, 0.0, 0.0, 0.4]]], np.float32)
    if delay:  # what is told first is carried out second, and of the last one nothing is seen yet
        corners = corners[:, [0, 0, 1]]
    motions = motions_of(
        Past(corners[:, :2].astype(np.float32), actions), corners[:, 2], layout, made.task.sim
    )
    turned = (2.0 * np.pi - 6.0) / np.pi
    np.testing.assert_allclose(motions.way[0, 0], [0.1, -0.05, turned], atol=1e-5)
    np.testing.assert_allclose(motions.command[0], actions[0, : 2 - delay, -3:])
    assert motions.moved.tolist() == [[1.0, 0.0][: 2 - delay]]


@pytest.mark.parametrize(
    ("motion", "other", "tells"),
    [("lift", 0.0, 1.0), ("lift", 1e-9, 1.0), ("lift", 1e-4, 0.0), ("slide", 1e-4, 1.0)],
)
def test_a_motion_that_shifted_another_token_tells_nothing(
    motion: str, other: float, tells: float
) -> None:
    """One that is set down on others comes to lie elsewhere than told; one that slides is held."""
    made = setup(PAIR, motion=motion, backend="physics")
    poses = np.zeros((1, 2, 2, 3))
    poses[0, 1] = [[0.0, other, 0.0], [0.1, 0.2, 0.3]]
    corners = made.task.layout.corners(poses)
    past = Past(corners[:, :1], np.array([[[1.0, 0.1, 0.2, 0.3]]], np.float32))
    assert motions_of(past, corners[:, 1], made.task.layout, made.task.sim).moved.tolist() == [
        [tells]
    ]


def test_noise_on_the_corners_of_small_tokens_is_no_contact() -> None:
    layout = setup(SEVEN, corner_noise=0.01).task.layout
    rng = np.random.default_rng(0)
    before = rng.uniform(-0.5, 0.5, (50, layout.tokens, 3))
    after = before.copy()
    after[:, 0, :2] += 0.6
    shape = 50, layout.corner_count, 2
    seen = [layout.corners(p) + 0.02 * rng.standard_normal(shape) for p in (before, after)]
    action = np.array([-1.0, 0.3, 0.3, 0.0], np.float32)
    past = Past(seen[0][:, None], np.tile(action, (50, 1, 1)))
    assert motions_of(past, seen[1], layout, setup(SEVEN, corner_noise=0.01).task.sim).moved.all()


@pytest.mark.parametrize(
    ("tokens", "sim", "screened"),
    [
        (PAIR, {}, True),
        (SQUARE, {}, False),  # it meets nothing
        (PAIR, {"observe": "corners"}, False),
        (PAIR, {"world": "drawn"}, False),  # far from usual may be what that world does
    ],
)
def test_motions_are_screened_only_where_the_world_is_exact_and_seen(
    tokens: dict, sim: dict, screened: bool
) -> None:
    made = setup(tokens, {"motion": "learned"}, **{"observe": "pictures", "pixels": 64} | sim)
    assert learner_of(made).optimisers["motion"]._screened == screened


def test_what_lies_still_in_pictures_was_refused() -> None:
    """Poses that are seen differ a little from picture to picture."""
    made = setup(PAIR, observe="pictures", pixels=64)
    poses = np.zeros((2, 2, 2, 3))
    poses[:, 1, 1] = [[0.004, -0.004, 0.01], [0.03, 0.0, 0.0]]
    corners = made.task.layout.corners(poses)
    past = Past(corners[:, :1].astype(np.float32), np.full((2, 1, 4), 0.5, np.float32))
    seen = motions_of(past, corners[:, 1], made.task.layout, made.task.sim)
    assert seen.moved.tolist() == [[0.0], [1.0]]
    exact = motions_of(past, corners[:, 1], made.task.layout, setup(PAIR).task.sim)
    assert exact.moved.tolist() == [[1.0], [1.0]]


@pytest.mark.parametrize("capacity", [7, 12, 100])
def test_the_replay_gives_whole_episodes(capacity: int) -> None:
    made = setup(actions_per_token=3)
    buffer = ReplayBuffer(capacity, made.task.layout.corner_count, 1, 3)
    for first in range(0, 18, 6):
        number = np.arange(first, first + 6, dtype=np.float32)
        points = np.broadcast_to(number[:, None, None], (6, 4, 2))
        flags, action = np.zeros((6, 1), np.uint8), np.repeat(number[:, None], 3, axis=1)
        buffer.add(
            Transitions(points, flags, action, number, points + 1.0, flags, flags[:, 0], points)
        )
    past, ends = buffer.sample_episodes(50, 3, np.random.default_rng(0))
    first = past.actions[:, 0, 0]
    assert set(first) == {float(n) for n in range(0, 18, 3) if n >= 18 - capacity}
    np.testing.assert_array_equal(past.actions[..., 0], first[:, None] + np.arange(3))
    np.testing.assert_array_equal(past.corners[:, :, 0, 0], past.actions[..., 0])
    np.testing.assert_array_equal(ends[:, 0, 0], first + 3.0)


def test_a_replay_that_cannot_hold_an_episode_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"must hold an episode, 9 actions, got 8"):
        setup(agent={"replay_capacity": 8, "batch_size": 4}, actions_per_token=9)


def test_an_agent_corrects_itself_by_what_it_has_seen() -> None:
    """In a world that goes half as far as it is told: the second command is longer."""
    made = setup(agent=LEARNED, actions_per_token=2)
    learner = learner_of(made, 0)
    for part in (learner.motion, learner.acting.motion):  # type: ignore[union-attr]
        part.load_state_dict(at_first().state_dict())  # type: ignore[union-attr,operator]
    policy = Policy(made)
    policy.load(learner.broadcast())
    episodes = random_episodes(made, 5)
    start, goals, placed = episodes["corners"][:, 0], episodes["goals"], episodes["placed"][:, 0]
    first = policy.act(start, placed, goals)
    poses = made.task.layout.poses(start.astype(np.float64))
    poses[:, 0] += 0.5 * first * SCALE
    now = made.task.layout.corners(poses).astype(np.float32)
    past = history(np.stack([start, now], axis=1), first[:, None])
    blind, told = policy.act(now, placed, goals), policy.act(now, placed, goals, past=past)
    short = np.abs(blind) < 0.5
    assert short.sum() > 5
    assert (np.abs(told) > np.abs(blind))[short].mean() > 0.8


def test_with_a_delay_it_plays_for_where_the_action_before_will_have_taken_the_token() -> None:
    """Told the same again where the token seems not to have moved, it would go twice as far."""
    made = setup(agent=LEARNED, actions_per_token=3, world="delayed")
    policy = Policy(made)
    learner = learner_of(made, 0)
    policy.load(learner.broadcast())
    episodes = random_episodes(made, 5)
    start, goals, placed = episodes["corners"][:, 0], episodes["goals"], episodes["placed"][:, 0]
    first = policy.act(start, placed, goals)
    poses = made.task.layout.poses(start.astype(np.float64))
    poses[:, 0] += first * SCALE
    there = made.task.layout.corners(poses)
    past = history(np.stack([start, start], axis=1), first[:, None])
    late = policy.act(start, placed, goals, past=past)
    np.testing.assert_allclose(late, policy.act(there, placed, goals), atol=1e-5)


def test_with_noise_what_was_blocked_has_not_moved() -> None:
    """A lone token is never blocked: there the smallest way counts."""
    for tokens, counts in ((PAIR, False), (SQUARE, True)):
        made = setup(tokens, corner_noise=0.01)
        rng = np.random.default_rng(0)
        shape = 8, 1, made.task.layout.corner_count, 2
        before = made.task.layout.corners(rng.uniform(-0.5, 0.5, (8, made.task.layout.tokens, 3)))[
            :, None
        ]
        noise = 0.01 * made.task.sim.arena * rng.standard_normal((2, *shape))
        actions = rng.uniform(-1.2, 1.2, (8, 1, made.task.action_size)).astype(np.float32)
        past = Past((before + noise[0]).astype(np.float32), actions)
        seen_of = motions_of(past, (before + noise[1])[:, 0], made.task.layout, made.task.sim)
        assert bool(seen_of.moved.any()) == counts
        assert seen_of.command.abs().max() == 1.0  # as far as it is carried out


@pytest.mark.parametrize("value", [np.nan, np.inf, 3e38, 1e7])
def test_damaged_weights_are_refused(value: float) -> None:
    model = MotionModel()
    arrays = to_arrays(model)
    arrays["mean"][0, 0] = value
    with pytest.raises(RunError, match="damaged weights: 'mean' must hold finite numbers"):
        load_arrays(model, arrays)


def test_whatever_variances_are_told_commands_are_finite() -> None:
    model, told = MotionModel(), commands(4)
    for variance, noise in ((800.0, 0.02), (-1e5, -1e5), (1e5, 1e5)):
        model.log_variance.fill_(variance)
        model.log_noise.fill_(noise)
        belief = model.belief(seen(told, told)).at(torch.zeros(4, dtype=torch.int64))
        assert model.command(belief, told).isfinite().all()


def test_what_a_world_never_varied_may_still_be_learned_in_another() -> None:
    """First of all how far a command goes: half or twice as far is believed from one action."""
    model = MotionModel()
    fit, told = Fit(model), commands(64)
    for _ in range(300):
        fit.step(seen(told, told))
    assert model.variance.min() >= 1e-4**2 * 0.99
    for gain in (0.5, 2.0):
        once = torch.tensor([[0.4, -0.3, 0.2]])
        belief = model.belief(seen(gain * once, once))
        others = 0.3 * commands(16, seed=1)
        believed = model.predict(belief.at(torch.zeros(16, dtype=torch.int64)), others)[0]
        torch.testing.assert_close(believed, gain * others, atol=0.03, rtol=0.0)
