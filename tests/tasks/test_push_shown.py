"""What is made of pushes: by an arm, as a film, as a plan; and figures that they are to make."""

import json
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from tangram_core.arrays import Floats
from tangram_core.errors import ConfigError
from tangram_core.setup import make_setup
from tangram_core.store.checkpoints import save_checkpoint
from tangram_core.task import Played
from tangram_sim.geometry.layout import TokensConfig
from tangram_sim.puzzles.figures import library
from tangram_sim.world.arm import LIFTED, LOWERED, METRES, Motion, Panda
from tangram_tasks.push.env import PushEnv
from tangram_tasks.push.film import PARTS, Replayed, from_the_side
from tangram_tasks.push.places import figures_of
from tangram_tasks.push.rivals import Planner
from tangram_tasks.push.task import Push, PushConfig
from tests.cluster.processes import here
from tests.sim.builders import SEVEN
from tests.tasks.test_push import SQUARE, TWO, generators
from worker.play.rollout import play

pytestmark = pytest.mark.fast
HELD = replace(SQUARE, config=PushConfig(hand="panda"))


@pytest.fixture(scope="module")
def arm() -> Iterator[Panda]:
    made = Panda()
    yield made
    made.close()


def went(arm: Panda, begin: list[float], way: list[float]) -> Motion:
    found = arm.push(np.array(begin), np.array(way))
    assert found is not None
    return found


@pytest.mark.parametrize("begin", [[-0.19, 0.19], [0.19, -0.19], [0.0, 0.0]])
def test_an_arm_pushes_along_the_way_within_what_its_joints_can(
    arm: Panda, begin: list[float]
) -> None:
    arm.home()
    way = [-begin[0] / 2, 0.05]
    motion = went(arm, begin, way)
    assert np.abs(motion.pushed[-1] - np.add(begin, way)).max() < 1e-3
    steps = motion.pushed - begin
    across = steps[:, 0] * way[1] - steps[:, 1] * way[0]
    assert np.abs(across).max() / np.hypot(*way) < 2e-3
    assert ((motion.joints > arm.low) & (motion.joints < arm.high)).all()
    speeds = np.diff(motion.joints, axis=0) / np.diff(motion.seconds)[:, None]
    assert (np.abs(speeds) < arm.fastest * 1.01).all()
    pushed = motion.tips[[part == "push" for part in motion.parts], 2]
    assert np.abs(pushed - LOWERED).max() < 2e-3
    assert motion.tips[-1, 2] == pytest.approx(LIFTED, abs=2e-3)


def test_what_an_arm_cannot_reach_is_refused_and_it_goes_on(arm: Panda) -> None:
    assert arm.push(np.array([0.6, 0.0]), np.array([0.05, 0.0])) is None
    went(arm, [0.1, 0.0], [0.05, 0.0])


@pytest.mark.parametrize("limit", ["fastest", "high"])
def test_a_joint_beyond_its_limits_is_refused(
    arm: Panda, limit: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arm, limit, {"fastest": arm.fastest * 0.01, "high": arm.low}[limit])
    assert arm.push(np.array([0.1, 0.0]), np.array([0.05, 0.0])) is None


def by_planner(task: Push, count: int = 1) -> Played:
    with closing(task.make(count, "test")) as env:
        planner = Planner(task, env, 12)  # type: ignore[arg-type]
        return play(env, task.spec, planner, lambda i: generators(9)[i], count, facts=True)


def test_the_arm_pushes_as_the_finger_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """Up to what contacts make of a thousandth."""
    with closing(SQUARE.make(4)) as free, closing(HELD.make(4)) as held:
        rng = np.random.default_rng(0)
        for env in (free, held):
            env.reset(generators(4))
        actions = rng.uniform(-1.0, 1.0, (4, 4)).astype(np.float32)
        start = free.facts()["corners"]
        ends = [env.step(actions).seen["corners"] for env in (free, held)]
        moved = np.abs(ends[0] - start).max(axis=(1, 2))
        assert (moved > 0.05).any()
        assert np.abs(ends[0] - ends[1]).max() < 0.01
        monkeypatch.setattr(Panda, "push", lambda *_: None)
        step = held.step(actions)
        np.testing.assert_array_equal(step.seen["corners"], ends[1])
        assert held.refused[0] == "the arm cannot reach there"  # type: ignore[attr-defined]


def test_a_film_has_the_way_of_every_push_and_ends_where_it_was_recorded() -> None:
    played = by_planner(TWO, 2)
    one = Replayed(TWO, played, 0)
    frames = list(TWO.film(played))
    counts = [Replayed(TWO, played, e).count for e in range(2)]
    assert len(frames) == max(counts) * (PARTS + 1)
    assert not (frames[0] == frames[-1]).all()
    with closing(TWO.make(1)) as env:
        push = one.push(0)
        assert push is not None
        path = push.begin + np.linspace(0.0, 1.0, PARTS + 1)[:, None] * push.way
        found = one.followed(env.tables[0], 0, path)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(found[0], one.corners[0])
    np.testing.assert_allclose(found[-1], one.corners[1], atol=1e-9)


def test_a_plan_from_pictures_has_the_pushes_that_were_made(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    task, made = replace(TWO, config=replace(TWO.config, pixels=32)), list[np.ndarray]()
    push = PushEnv._push

    def noted(env: PushEnv, b: int, begin: np.ndarray, way: np.ndarray) -> str:
        made.append(np.concatenate([begin, way]))
        return push(env, b, begin, way)

    monkeypatch.setattr(PushEnv, "_push", noted)
    one = Replayed(task, by_planner(task), 0)
    again = [push for push in map(one.push, range(one.count)) if push is not None]
    assert len(again) > 3
    found = np.array([[*push.begin, *push.way] for push in again])
    np.testing.assert_allclose(found, made, atol=1e-6)


def test_a_film_of_an_arm_and_a_plan_with_its_joints(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tangram_tasks.push.film.FRAMES", 12)
    played = by_planner(HELD)
    shown = list(from_the_side(HELD, played))
    assert len(shown) == 12
    pictures = np.stack([np.asarray(one, int) for one in shown])
    assert (np.diff(pictures, axis=0) != 0).any((1, 2, 3)).sum() > 6
    one, plan = Replayed(HELD, played, 0), HELD.plan(played)
    pushes = [one.push(t) for t in range(one.count)]
    made = [push for push in pushes if push is not None]
    assert len(plan["pushes"]) == len(made)
    points = [point for push in plan["pushes"] for point in push["points"]]
    assert (np.diff([point["seconds"] for point in points]) > 0).all()
    assert all(len(point["joints"]) == 7 for point in points)
    for push, told in zip(made, plan["pushes"], strict=True):
        begin, end = (told["points"][i]["tip"][:2] for i in (1, 2))
        np.testing.assert_allclose(begin, push.begin * METRES, atol=1e-6)
        np.testing.assert_allclose(end, (push.begin + push.way) * METRES, atol=1e-6)
    assert "joints" not in SQUARE.plan(by_planner(SQUARE))["pushes"][0]["points"][0]
    json.dumps(plan)


def test_figures_are_the_targets_and_none_lies_flipped() -> None:
    task = Push(TokensConfig(tuple(SEVEN), 0.6), PushConfig(puzzle=("cat",)))
    with closing(task.make(3)) as env:
        env.reset(generators(3))
        goals = env.facts()["goals"]
    (cat,) = figures_of(task.layout, 0.6, ["cat"])

    def apart(corners: Floats) -> Floats:
        return np.linalg.norm(corners[:, None] - corners[None], axis=-1)

    for goal in goals:
        np.testing.assert_allclose(apart(goal), apart(task.layout.corners(cat)), atol=1e-9)
    assert not (task.layout.flipped(goals)).any()
    assert len(list(figures_of(task.layout, 0.6, ["test"]))) == len(library("test"))


@pytest.mark.parametrize(
    ("tokens", "settings", "reason"),
    [
        (TokensConfig(tuple(SEVEN), 0.6), {"puzzle": ("dodo",)}, "no puzzle 'dodo': choose from"),
        (
            TokensConfig(tuple(SEVEN), 0.6),
            {"puzzle": ("cat",), "count": 2},
            "task.puzzle needs all",
        ),
        (TokensConfig(("square",), 0.6), {"puzzle": ("cat",)}, "set tokens=tangram7"),
        (TokensConfig(tuple(SEVEN), 1.2), {"puzzle": ("cat",)}, "lower tokens.scale"),
    ],
)
def test_figures_that_cannot_be_made_are_refused(
    tokens: TokensConfig, settings: dict[str, Any], reason: str
) -> None:
    with pytest.raises(ConfigError, match=reason):
        Push(tokens, PushConfig(**settings)).check(plays=False)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of a run that learned nothing."""
    folder = tmp_path_factory.mktemp("run")
    tokens = {"shapes": [*SEVEN], "scale": 0.6}
    config = {"task": {"kind": "push"}, "tokens": tokens, "agent": {"kind": "push", "width": 8}}
    made = make_setup(config)
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    learned = made.agent.learner(made.task, 0, "cpu").broadcast()
    arrays = {"weights": learned, "learner": {"updates": np.array([1])}}
    save_checkpoint(folder / "checkpoints", 1, arrays, {}, keep=1)
    return folder


def test_play_takes_puzzles_of_pushes(run: Path, tmp_path: Path) -> None:
    told = [f"run_dir={run}", "puzzle=[cat]", "episodes=2"]
    for name in ("cat.png", "cat.json"):
        status, out, _ = here("tangram-play", *told, f"out={tmp_path / name}", cwd=tmp_path)
        assert (status, "solved (all in place) 0.000, tokens in place" in out) == (0, True)
    plan = json.loads((tmp_path / "cat.json").read_text())
    assert len(plan["tokens"]) == 7
    Image.open(tmp_path / "cat.png").verify()
    status, _, err = here("tangram-play", *told[:1], "puzzle=dodo", cwd=tmp_path)
    assert status == 2
    assert "no puzzle 'dodo': choose from" in err
    for wrong, reason in (
        ("turns=2", "without turns"),
        ("task.count=2", "needs all seven"),
        ("task.puzzle=[dog]", "leave one of them out"),
    ):
        status, _, err = here("tangram-play", *told, wrong, cwd=tmp_path)
        assert (status, reason in err) == (2, True), err


def test_without_a_figure_a_task_without_a_plan_writes_none(tmp_path: Path) -> None:
    told = ("run_dir=pretrained/square", f"out={tmp_path / 'x.json'}")
    status, _, err = here("tangram-play", *told, cwd=tmp_path)
    assert (status, list(tmp_path.iterdir())) == (2, [])
    assert "x.json is for positions of tokens in a figure, or a plan of pushes: name" in err


def test_an_arm_that_never_pushed_is_filmed_at_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Panda, "push", lambda *_: None)
    played = by_planner(HELD)
    assert played.facts["refused"][:, 1:].all()
    assert len(list(from_the_side(HELD, played))) == 1
    assert HELD.plan(played)["pushes"] == []
