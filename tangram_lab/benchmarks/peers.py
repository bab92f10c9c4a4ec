"""Piece by piece against Stable-Baselines3: play, hindsight, acting, one update.

On the paper's square, with perceptrons of two layers of 64 and batches of 256 on both sides.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from tangram_agent.learner import Learner
from tangram_agent.policy import Policy
from tangram_agent.relabelling import with_relabelled
from tangram_agent.replay import ReplayBuffer
from tangram_agent.setup import Setup
from tangram_agent.types import Episodes, Past, Transitions
from tangram_lab.benchmarks.measure import Bound, Row, Work, compare
from tangram_lab.benchmarks.sb3 import Rival, label, make_envs, make_model, observation
from tangram_lab.benchmarks.setups import preset, with_agent, with_sim
from tangram_sim.arrays import Bools, Floats, Singles
from tangram_sim.batch import BatchedEnv
from tangram_sim.rewards import make_reward
from worker.rollout import Generators, Rollout, parts

STAGE = "peers"
ENVS, BATCH, FILLED = 16, 256, 4096
RIVAL = Rival(envs=ENVS, batch=BATCH, starts=FILLED)


def measure_peers(runs: int) -> list[Row]:
    """Each piece in turns with theirs; `runs` measurements of each."""
    against = label()
    setup, model = _setup(), _model()
    replay, episodes = _filled(setup)

    def row(case: str, unit: str, ours: Work, theirs: Work) -> Row:
        return compare((STAGE, case, unit), ours, (against, theirs), runs)

    return [
        row(f"play in {ENVS} environments", "steps/s", _our_play(setup), _their_play()),
        row(
            f"hindsight, one batch of {BATCH} a transition",
            "batches/s",
            _our_hindsight(setup, replay, episodes),
            _their_hindsight(model),
        ),
        row(f"acting for {ENVS}", "actions/s", _our_acting(setup), _their_acting(model)),
    ]


def compare_updates(stage: str, runs: int) -> list[Row]:
    """Updates of the same perceptron: ours leaves out target networks that decide nothing."""
    setup, model, against = _setup(), _model(), label()
    replay = _filled(setup)[0]
    cases: dict[str, tuple[tuple[Work, Work], Bound | None]] = {}
    for compiled in (False, True):
        whole, part = _batches(setup, replay, model, compiled)
        how = ", compiled" if compiled else ""
        cases[f"every transition final{how}"] = whole, Bound(least=2.0 if compiled else 1.5)
        cases[f"half of them{how}"] = part, None
    return [
        compare(
            (stage, f"perceptron [64, 64], batch {BATCH}, {case}", "updates/s"),
            ours,
            (against, theirs),
            runs,
            bound,
        )
        for case, ((ours, theirs), bound) in cases.items()
    ]


def _setup() -> Setup:
    return with_agent(preset("mlp"), batch_size=BATCH, readout="token")


def _model() -> Any:
    """Theirs, with a replay full of random play."""
    model = make_model(RIVAL)
    model.learn(FILLED)
    return model


def _filled(setup: Setup) -> tuple[ReplayBuffer, Episodes]:
    """A replay with random play and its twins, and one message of a worker."""
    rollout = _rollout(setup)
    size = setup.layout.corner_count, setup.layout.tokens, setup.action_size
    replay = ReplayBuffer(setup.agent.replay_capacity, *size)
    episodes = rollout.play(_random, FILLED // ENVS)
    _take_in(setup, replay)(episodes)
    return replay, next(parts(episodes, 2 * ENVS))


def _take_in(setup: Setup, replay: ReplayBuffer) -> Callable[[Episodes], None]:
    reward = make_reward(setup.reward, setup.layout, setup.sim)
    generator = np.random.default_rng(0)

    def take_in(episodes: Episodes) -> None:
        relabels = setup.agent.hindsight
        replay.add(with_relabelled(episodes, relabels, setup.layout, reward, generator))

    return take_in


def _rollout(setup: Setup) -> Rollout:
    env = BatchedEnv(setup.layout, setup.sim, setup.reward, ENVS)
    return Rollout(env, 0, "bench", 0, 0)


def _random(
    _corners: Floats, _placed: Bools, _goals: Floats, generators: Generators, _past: Past
) -> Singles:
    return generators[0].uniform(-1.0, 1.0, (len(generators), 3)).astype(np.float32)


def _our_play(setup: Setup) -> Work:
    """Whole episodes as a worker plays them; one step each."""
    rollout = _rollout(setup)
    return lambda: float(rollout.play(_random).transitions)


def _their_play() -> Work:
    """Their loop over environments, which begins an episode where one is over."""
    envs = make_envs(ENVS)
    envs.reset()
    generator = np.random.default_rng(0)

    def play() -> float:
        envs.step(generator.uniform(-1.0, 1.0, (ENVS, 3)).astype(np.float32))
        return float(ENVS)

    return play


def _our_hindsight(setup: Setup, replay: ReplayBuffer, episodes: Episodes) -> Work:
    """Other goals are made as episodes come in: a message of 32, then as many batches."""
    take_in, generator = _take_in(setup, replay), np.random.default_rng(0)

    def learn() -> float:
        take_in(episodes)
        for _ in range(episodes.transitions):
            replay.sample(BATCH, generator)
        return float(episodes.transitions)

    return learn


def _their_hindsight(model: Any) -> Work:
    """Their goals and rewards are relabelled while a batch is drawn."""
    envs = make_envs(ENVS)
    before, actions = envs.reset(), np.zeros((ENVS, 3), np.float32)
    after, rewards, dones, infos = envs.step(actions)

    def learn() -> float:
        model.replay_buffer.add(before, after, actions, rewards, dones, infos)
        for _ in range(ENVS):
            model.replay_buffer.sample(BATCH)
        return float(ENVS)

    return learn


def _our_acting(setup: Setup) -> Work:
    policy, env = Policy(setup), BatchedEnv(setup.layout, setup.sim, setup.reward, ENVS)
    env.reset([np.random.default_rng(0)] * ENVS)

    def act() -> float:
        return float(len(policy.act(env.seen, env.placed, env.seen_goals)))

    return act


def _their_acting(model: Any) -> Work:
    setup = preset()
    env = BatchedEnv(setup.layout, setup.sim, setup.reward, ENVS)
    env.reset([np.random.default_rng(0)] * ENVS)
    seen = observation(env.seen, env.placed, env.seen_goals)

    def act() -> float:
        return float(len(model.predict(seen, deterministic=True)[0]))

    return act


def _batches(
    setup: Setup, replay: ReplayBuffer, model: Any, compiled: bool
) -> tuple[tuple[Work, Work], tuple[Work, Work]]:
    """Updates on batches drawn before: of whole episodes, and with every second transition open.

    Ours does not ask the target networks where no transition goes on; theirs always does.
    """
    final = replay.sample(BATCH, np.random.default_rng(0))
    open_half = replace(final, done=np.arange(BATCH, dtype=np.uint8) % 2)
    theirs = model.replay_buffer.sample(BATCH)
    dones = theirs.dones.clone()
    dones[::2] = 0.0
    return (
        (_our_update(setup, final, compiled), _their_update(model, theirs)),
        (
            _our_update(with_sim(setup, actions_per_token=2), open_half, compiled),
            _their_update(model, theirs._replace(dones=dones)),
        ),
    )


def _our_update(setup: Setup, batch: Transitions, compiled: bool) -> Work:
    learner = Learner(setup, seed=0, compiled=compiled)

    def update() -> float:
        learner.update(batch)
        return 1.0

    return update


def _their_update(model: Any, batch: Any) -> Work:
    """As many updates in one call as environments step at a time, as in a training."""

    def update() -> float:
        drawn, model.replay_buffer.sample = model.replay_buffer.sample, lambda *_, **__: batch
        model.train(gradient_steps=ENVS, batch_size=BATCH)
        model.replay_buffer.sample = drawn
        return float(ENVS)

    return update
