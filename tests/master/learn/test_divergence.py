"""Updates that are not finite are undone, and end the run when they go on."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
import torch
from torch import nn

from master.learn import divergence as divergence_module
from master.learn.divergence import DivergenceGuard
from master.learn.trainer import Trainer
from tangram_core.agent import NotFiniteError
from tangram_core.errors import FailedError
from tests.agent.builders import random_episodes, setup
from tests.master.builders import AGENT, trainer

pytestmark = pytest.mark.fast

# Something bootstraps: there are target networks.
MADE = setup(agent=AGENT | {"gamma": 0.9}, actions_per_token=2)


@pytest.fixture
def learning() -> Trainer:
    """A trainer with all of its updates due."""
    made = trainer(MADE)
    made.insert(random_episodes(MADE, 60))
    return made


Guarded = Callable[[int], DivergenceGuard]


@pytest.fixture
def guarded(learning: Trainer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Guarded:
    """Makes a guard that keeps every good state, however fast the machine is."""
    monkeypatch.setattr(divergence_module, "KEEP_S", 0.0)
    return lambda limit: DivergenceGuard(learning, tmp_path / "bad", limit)


def fail(made: Trainer, times: int, part: str = "critic") -> None:
    """The next updates have a loss that is not a number."""
    losses = made.learner.losses
    left = [times]

    def failing(seen: Any) -> Any:
        left[0] -= 1
        for loss in losses(seen):
            bad = loss.part == part and left[0] >= 0
            yield replace(loss, value=loss.value * float("nan")) if bad else loss

    made.learner.losses = failing


def poison(module: nn.Module) -> None:
    with torch.no_grad():
        next(module.parameters()).view(-1)[0] = float("inf")


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(one[n], other[n]) for n in one)


@pytest.mark.parametrize("part", ["critic", "actor"])
def test_a_bad_update_is_undone_and_the_next_one_counts(
    learning: Trainer, guarded: Guarded, tmp_path: Path, part: str
) -> None:
    guard = guarded(3)
    for _ in range(2):
        assert guard.update(0.0)
    good, lag = learning.learner.state(), learning.rate_limiter.lag
    fail(learning, 1, part)
    assert guard.update(0.0) == {}
    assert same(learning.learner.state(), good)
    assert (learning.updates, learning.rate_limiter.lag, guard.undone) == (2, lag, 1)
    assert np.isfinite(list(guard.update(0.0).values())).all()
    assert (learning.updates, learning.rate_limiter.lag, guard.undone) == (3, lag - 1, 1)
    assert not (tmp_path / "bad").exists()


def test_updates_since_the_last_good_state_are_made_again(
    learning: Trainer, guarded: Guarded, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(divergence_module, "KEEP_S", 1000.0)
    guard, lag = guarded(3), learning.rate_limiter.lag
    first = learning.learner.state()
    for _ in range(4):
        guard.update(0.0)
    fail(learning, 1)
    guard.update(0.0)
    assert same(learning.learner.state(), first)
    assert (learning.updates, learning.rate_limiter.lag) == (0, lag)


def test_too_many_in_a_row_end_the_run_and_the_batch_is_kept(
    learning: Trainer, guarded: Guarded, tmp_path: Path
) -> None:
    guard = guarded(3)
    fail(learning, 2)
    assert [bool(guard.update(0.0)) for _ in range(3)] == [False, False, True]
    fail(learning, 99)
    assert [guard.update(0.0) for _ in range(2)] == [{}, {}]
    told = r"critic_loss=nan.*3 times in a row.*lower agent\.actor_lr.*or .*warm_start=RUN_DIR$"
    with pytest.raises(FailedError, match=told):
        guard.update(0.0)
    assert guard.undone == 5
    batch = safetensors.numpy.load_file(tmp_path / "bad")
    assert same(batch, learning.learner.evidence())


def test_weights_that_went_bad_without_a_loss_are_never_given_out(
    learning: Trainer, guarded: Guarded
) -> None:
    guard = guarded(2)
    guard.update(0.0)
    poison(learning.learner.acting)
    weights = guard.weights()
    assert all(np.isfinite(tensor).all() for tensor in weights.tensors.values())
    assert guard.undone == 1
    poison(learning.learner.acting)
    with pytest.raises(FailedError, match="the weights are not finite after 1 updates"):
        guard.weights()


@pytest.mark.parametrize("part", ["critic", "actor", "target_actor"])
def test_a_check_finds_what_no_worker_would_see(
    learning: Trainer, guarded: Guarded, part: str
) -> None:
    guard = guarded(2)
    guard.update(0.0)
    good = learning.learner.state()
    poison(learning.learner.parts[part])
    guard.check()
    assert (guard.undone, same(learning.learner.state(), good)) == (1, True)


def test_a_state_that_is_spoilt_already_is_refused(learning: Trainer, guarded: Guarded) -> None:
    poison(learning.learner.critic)
    with pytest.raises(NotFiniteError, match="the weights are not finite after 0 updates"):
        guarded(2)
