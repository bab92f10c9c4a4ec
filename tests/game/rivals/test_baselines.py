"""The perfect hand: exact in every world, at the smallest turn, with one action or several.

And chance, which plays by the rules.
"""

from contextlib import closing

import numpy as np
import pytest
from shapely import Polygon

from tangram_core.task import Chooser, History
from tangram_sim.geometry.dissections import Dissection
from tangram_sim.motion.kinematics import wrap
from tangram_tasks.played import Played
from tangram_tasks.rivals.baselines import exact_policy, random_policy
from tangram_tasks.rivals.search import search_policy
from tangram_vision.silhouettes.silhouettes import Filled
from tests.agent.agents.outline.outlines import outline_setup
from tests.agent.builders import PAIR, SQUARE, setup
from tests.sim.builders import SEVEN
from worker.score.test_set import FixedTests

pytestmark = pytest.mark.slow

GAME = {"shapes": list(SEVEN), "scale": 0.6}
SHAPES = ("square", "small_triangle", "parallelogram")
NOTHING = History({}, np.zeros((1, 0, 3), np.float32))


def chosen(
    policy: Chooser, corners: np.ndarray, placed: np.ndarray, goals: np.ndarray
) -> np.ndarray:
    return policy({"corners": corners, "placed": placed, "goals": goals}, NOTHING, [])


@pytest.mark.parametrize("backend", ["kinematic", "physics"])
@pytest.mark.parametrize("tokens", [SQUARE, PAIR], ids=["one", "two"])
@pytest.mark.parametrize("actions", [1, 3])
def test_the_exact_policy_scores_one(backend: str, tokens: dict, actions: int) -> None:
    made = setup(tokens, backend=backend, actions_per_token=actions).task
    with closing(FixedTests(made, 5, 5)) as tests:
        scores = made.score(tests.play(exact_policy(made.layout, made.sim)))
    assert scores["coverage_p10"] > 0.9999
    assert scores["position_error_p90"] < 1e-4
    assert scores["angle_error_deg_p90"] < 1e-2


@pytest.mark.parametrize("shape", SHAPES)
def test_it_turns_no_further_than_the_symmetry_asks_for(shape: str) -> None:
    made = setup({"shapes": [shape], "scale": 1.0}).task
    layout, rng = made.layout, np.random.default_rng(0)
    starts, goals = rng.uniform(-3.1, 3.1, (2, 200, 1, 3)) * [0.1, 0.1, 1.0]
    placed = np.zeros((200, 1), bool)
    policy = exact_policy(layout, made.sim)
    actions = chosen(policy, layout.corners(starts), placed, layout.corners(goals))
    assert actions.dtype == np.float32
    symmetry = layout.shapes[0].symmetry
    assert (np.abs(actions[:, 2]) <= 1.0 / symmetry + 1e-6).all()
    rest = wrap((starts[:, 0, 2] + np.pi * actions[:, 2] - goals[:, 0, 2]) * symmetry)
    np.testing.assert_allclose(rest, 0.0, atol=1e-5)


@pytest.mark.parametrize("backend", ["kinematic", "physics"])
@pytest.mark.parametrize("targets", ["figures", "uniform"])
@pytest.mark.parametrize("allow_flip", [False, True])
def test_the_exact_policy_solves_the_game(backend: str, targets: str, allow_flip: bool) -> None:
    sim = {"targets": targets, "starts": "outside", "mirrored": 0.5, "allow_flip": allow_flip}
    made = setup(GAME, backend=backend, pixels=16, **sim).task
    with closing(FixedTests(made, 8, 8)) as tests:
        scores = made.score(tests.play(exact_policy(made.layout, made.sim)))
    assert scores["coverage_p10"] > 0.999
    assert (scores["solved"], scores["wrong"], scores["refused"]) == (1.0, 0.0, 0.0)
    assert scores["angle_error_deg_p90"] < 0.1


def test_it_makes_room_before_it_sets_down() -> None:
    """The first token's place is under the second: the second goes first."""
    made = setup({"shapes": ["square", "large_triangle"], "scale": 0.8}).task
    starts = np.array([[[-0.6, 0.0, 0.0], [0.6, 0.0, 0.0]]])
    goals = np.array([[[0.6, 0.0, 0.0], [0.0, 0.6, 0.0]]])
    policy, placed = exact_policy(made.layout, made.sim), np.zeros((1, 2), bool)
    corners, wanted = made.layout.corners(starts), made.layout.corners(goals)
    assert chosen(policy, corners, placed, wanted)[0, 0] > 0.0
    assert chosen(policy, corners, np.array([[False, True]]), wanted)[0, 0] < 0.0
    free = made.layout.corners(starts - [0.0, 0.6, 0.0])
    assert chosen(policy, free, placed, wanted)[0, 0] < 0.0


def test_equal_tokens_take_the_nearer_places() -> None:
    made = setup({"shapes": ["square", "square"], "scale": 0.6}).task
    starts = made.layout.corners(np.array([[[-0.6, 0.0, 0.0], [0.6, 0.0, 0.0]]]))
    goals = made.layout.corners(np.array([[[0.5, 0.1, 0.0], [-0.5, 0.1, 0.0]]]))
    policy, placed = exact_policy(made.layout, made.sim), np.zeros((1, 2), bool)
    action = chosen(policy, starts, placed, goals)
    np.testing.assert_allclose(action[0, 1:], [0.05, 0.05, 0.0], atol=1e-6)


@pytest.mark.parametrize("allow_flip", [False, True])
def test_chance_names_tokens_that_are_left_and_stays_in_the_arena(
    allow_flip: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tangram_sim.batch.MAX_OVERLAP", 1.0)
    made = setup(GAME, allow_flip=allow_flip, pixels=16).task
    with closing(FixedTests(made, 20, 20)) as tests:
        played = Played.of(tests.play(random_policy(made.layout, made.sim)))
    assert not played.refused.any()
    assert played.episodes["placed"][:, -1].all()
    centres = made.layout.poses(played.ends)[..., :2]
    assert 0.9 < np.abs(centres).max() <= 1.0 + 1e-6
    turned = made.layout.flipped(played.ends) != made.layout.flipped(played.starts)
    assert turned.any() == allow_flip


def test_the_search_fills_outlines() -> None:
    made = outline_setup(GAME).task
    with closing(FixedTests(made, 3, 3)) as tests:
        scores = made.score(tests.play(search_policy(made.layout, made.sim)))
    assert (scores["solved"], scores["blocked"], scores["refused"]) == (1.0, 0.0, 0.0)


def test_the_search_lays_what_has_a_place_and_looks_once_in_an_episode(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made, asked = outline_setup(GAME).task, []
    lies, poses = np.zeros(7, bool), np.zeros((7, 3))
    lies[[2, 4]], poses[4] = True, (0.1, 0.2, 0.3)
    attempt = Dissection(poses, np.zeros(7, bool), lies)

    def fill(area: Polygon, *_: object) -> Filled:
        asked.append(area)
        return Filled(None, 0.5, 0.0, 1, complete=True, attempt=attempt)

    monkeypatch.setattr("tangram_tasks.rivals.search.fill_outline", fill)
    policy, goals = search_policy(made.layout, made.sim), np.zeros((1, made.goal_rows, 2))
    corners, later = made.layout.corners(np.zeros((1, 7, 3))), History({}, np.zeros((1, 1, 5)))
    placed = np.zeros((1, 7), bool)
    placed[0, :3] = True
    seen = {"corners": corners, "placed": placed, "goals": goals}
    action = policy(seen, NOTHING, [])[0]
    token = np.arange(7)[lies & ~placed[0]]
    assert int((action[0] + 1.0) / 2.0 * 7) == token
    np.testing.assert_allclose(action[-3:], [0.1 / 2.0, 0.2 / 2.0, 0.3 / np.pi], atol=1e-6)
    placed[0, 4] = True  # what has no place stays
    stuck = policy(seen, later, [])[0]
    assert int((stuck[0] + 1.0) / 2.0 * 7) == 3
    np.testing.assert_array_equal(stuck[-4:], [-1.0, 0.0, 0.0, 0.0])
    assert len(asked) == 1
    policy(seen, NOTHING, [])
    assert len(asked) == 2
