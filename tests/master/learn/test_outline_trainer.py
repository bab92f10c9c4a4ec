"""A master whose agent fills outlines: taking in what was played, learning, going on."""

from contextlib import closing

import numpy as np
import pytest

from tangram_core.errors import WireError
from tangram_core.setup import Setup
from tangram_core.spec import Episodes
from tangram_core.wire.messages import EpisodeBatch, decode_from_worker
from tangram_sim.motion.actions import corner_bound
from tests.agent.agents.outline.outlines import outline_setup
from tests.agent.builders import Policy
from tests.master.builders import trainer
from worker.play.rollout import Rollout

pytestmark = pytest.mark.fast

MADE = outline_setup(
    agent={"replay_capacity": 64, "batch_size": 8, "learning_starts": 4, "uniform_share": 0.5}
)


def rolled_out(made: Setup, count: int = 2, seed: int = 0) -> Episodes:
    """What a worker of four environments plays."""
    with closing(made.task.make(4)) as env:
        return Rollout(env, made.spec, seed, "player", 0, 1).play(Policy(made).actor.act, count)


def test_what_workers_play_is_learned_from() -> None:
    made = trainer(MADE)
    played = rolled_out(MADE)
    made.insert(played)
    assert (played["goals"].shape, made.transitions) == ((8, MADE.task.goal_rows, 2), 16)
    numbers = made.update(0.0)
    assert set(numbers) == {"critic_loss", "q", "critic_gradient"}
    assert made.updates == 1
    assert len(made.learner.evidence()["ends"]) == 4  # what a failure would be looked for in
    policy = Policy(MADE)
    policy.follow(made.weights())
    assert policy.version == 1


def test_a_worker_that_plays_nonsense_asks_for_no_update() -> None:
    """Nothing is placed, so hindsight has no state, and there is nothing to sample."""
    made, played = trainer(MADE), rolled_out(MADE)
    played["placed"][:] = 0
    for _ in range(20):
        made.insert(played)
    assert (len(made.learner.replay), made.rate_limiter.may_update()) == (0, False)
    made.insert(rolled_out(MADE))
    assert made.rate_limiter.may_update()
    made.update(0.0)


def test_a_replay_of_another_size_keeps_the_newest() -> None:
    one = trainer(MADE)
    one.insert(rolled_out(MADE))
    smaller = trainer(outline_setup(agent={"replay_capacity": 8, "batch_size": 8}))
    smaller.load_state(*one.state())
    kept, found = (made.learner.memory() for made in (one, smaller))
    assert len(kept["ends"]) > len(found["ends"]) == 8
    assert (found["played"], found["filled"]) == (kept["played"], kept["filled"])
    assert sorted(found["ends"].tolist()) == sorted(kept["ends"][-8:].tolist())


def test_outlines_travel_and_other_sizes_are_refused() -> None:
    spec = MADE.spec
    played = rolled_out(MADE, count=1)
    frames = EpisodeBatch(1, 0, played).encode(spec)
    got = decode_from_worker(frames, spec)
    assert isinstance(got, EpisodeBatch)
    assert (got.episodes["goals"] == played["goals"]).all()
    pieces = Episodes({**played.arrays, "goals": played["corners"][:, 0]})
    with pytest.raises(WireError, match="goals must have the shape"):
        EpisodeBatch(1, 0, pieces).encode(spec)


def test_nonsense_that_keeps_its_bounds_harms_nobody() -> None:
    """Whoever has the keys may send any numbers: the master learns nonsense, and goes on."""
    made, generator = trainer(MADE), np.random.default_rng(0)
    played = rolled_out(MADE)
    for high in (0.0, 1e-3, 0.5, corner_bound(MADE.task.layout.tokens, MADE.task.sim)):
        noise = generator.uniform(-high, high, played["goals"].shape).astype(np.float32)
        corners = generator.uniform(-high, high, played["corners"].shape).astype(np.float32)
        made.insert(Episodes({**played.arrays, "goals": noise}))
        made.insert(Episodes({**played.arrays, "corners": corners}))
        made.insert(Episodes({**played.arrays, "corners": corners, "goals": noise}))
        flags = generator.integers(0, 2, played["placed"].shape).astype(np.uint8)
        made.insert(Episodes({**played.arrays, "placed": flags}))
    assert np.isfinite(list(made.update(0.0).values())).all()
    made.learner.load_memory(made.learner.memory())  # checks each number
