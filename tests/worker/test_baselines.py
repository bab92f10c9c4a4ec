"""The perfect hand: exact in every world, at the smallest turn, with one action or several."""

from contextlib import closing

import numpy as np
import pytest

from tangram_sim.kinematics import wrap
from tests.agent.builders import PAIR, SQUARE, setup
from worker.baselines import exact_policy
from worker.trials import Trials

pytestmark = pytest.mark.fast

SHAPES = ("square", "small_triangle", "parallelogram")


@pytest.mark.parametrize("backend", ["kinematic", "physics"])
@pytest.mark.parametrize("tokens", [SQUARE, PAIR], ids=["one", "two"])
@pytest.mark.parametrize("actions", [1, 3])
def test_the_exact_policy_scores_one(backend: str, tokens: dict, actions: int) -> None:
    made = setup(tokens, backend=backend, actions_per_token=actions)
    with closing(Trials(made, 5, 5)) as trials:
        scores = trials.scores(trials.play(exact_policy(made.layout, made.sim.arena)))
    assert scores["raw_overlap_p10"] > 0.9999
    assert scores["position_error_p90"] < 1e-4
    assert scores["angle_error_deg_p90"] < 1e-2


@pytest.mark.parametrize("shape", SHAPES)
def test_it_turns_no_further_than_the_symmetry_asks_for(shape: str) -> None:
    made = setup({"shapes": [shape], "scale": 1.0})
    layout, rng = made.layout, np.random.default_rng(0)
    starts, goals = rng.uniform(-3.1, 3.1, (2, 200, 1, 3)) * [0.1, 0.1, 1.0]
    placed = np.zeros((200, 1), bool)
    policy = exact_policy(layout, made.sim.arena)
    actions = policy(layout.corners(starts), placed, layout.corners(goals), [])
    assert actions.dtype == np.float32
    symmetry = layout.shapes[0].symmetry
    assert (np.abs(actions[:, 2]) <= 1.0 / symmetry + 1e-6).all()
    rest = wrap((starts[:, 0, 2] + np.pi * actions[:, 2] - goals[:, 0, 2]) * symmetry)
    np.testing.assert_allclose(rest, 0.0, atol=1e-5)
