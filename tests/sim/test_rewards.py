"""Rewards against tables, against brute force, and the user's own."""

import hashlib
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tangram_core.errors import ConfigError
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.geometry.layout import Layout
from tangram_sim.rewards import (
    RewardFn,
    TargetPictures,
    check_reward,
    closeness,
    make_reward,
    overlap,
    pinned,
    reward_bounds,
    reward_identity,
)
from tangram_sim.sight.pictures import BACKGROUND, TOKEN_GRAY, token_pixels
from tangram_sim.targets.sampling import sample_batch
from tests.sim.builders import TRIO, layout_of, random_poses

pytestmark = pytest.mark.fast

SIM = SimConfig(backend="kinematic")
REACH = 2.0 * math.sqrt(2.0)


def reward_of(name: str, layout: Layout) -> RewardFn:
    return make_reward(RewardConfig(name=name), layout, SIM)


@pytest.mark.parametrize(
    ("shape", "shares"),
    [
        ("square", {0: 1.0, 5: 0.920, 10: 0.853, 20: 0.753, 45: 0.657, 90: 1.0}),
        ("small_triangle", {5: 0.836, 10: 0.704, 20: 0.512, 45: 0.273}),
        ("parallelogram", {180: 1.0}),
    ],
)
def test_overlap_at_an_angle_error(shape: str, shares: dict[int, float]) -> None:
    layout, here = layout_of(shape), np.array([0.3, -0.2, 0.4])
    desired = layout.corners(here[None])[None]
    for degrees, expected in shares.items():
        achieved = layout.corners(here[None] + [0.0, 0.0, math.radians(degrees)])[None]
        got = reward_of("overlap", layout)(achieved, desired)
        assert got[0] == pytest.approx(expected, abs=6e-4)


@pytest.mark.parametrize(
    ("shape", "expected"), [("square", 0.765), ("small_triangle", 0.376), ("parallelogram", 0.264)]
)
def test_mean_overlap_of_a_right_place_at_any_angle(shape: str, expected: float) -> None:
    """What an agent gets that solves position only: the plateaus of the paper's figures."""
    layout, poses = layout_of(shape), np.zeros((9000, 1, 3))  # more than are cut at a time
    poses[:, 0, 2] = np.linspace(0.0, 2.0 * math.pi, 9000, endpoint=False)
    desired = np.broadcast_to(layout.corners(np.zeros((1, 3))), (9000, layout.corner_count, 2))
    got = reward_of("overlap", layout)(layout.corners(poses), desired)
    assert got.mean() == pytest.approx(expected, abs=6e-4)


SHARP = 200.0 * math.sqrt(2.0)
ZERO = (math.sqrt(1.0 + SHARP) - 1.0) / SHARP


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
@pytest.mark.parametrize("name", ["overlap", "dense"])
def test_no_reward_is_beyond_its_bounds(name: str, seed: int) -> None:
    """Wherever tokens lie within the bound of all coordinates."""
    rng, layout, sim = np.random.default_rng(seed), layout_of(*TRIO), SimConfig()
    config = RewardConfig(name)
    poses = random_poses(rng, 40, layout.tokens, 8.0)
    poses[::2, :, :2] = 8.0 * np.sign(poses[::2, :, :2])
    corners = layout.corners(poses)
    found = make_reward(config, layout, sim)(corners[:20], corners[20:])
    low, high = reward_bounds(config)
    assert low - 1e-9 <= found.min() <= found.max() <= high + 1e-9


def test_a_goal_that_the_camera_does_not_show_pays_nothing() -> None:
    layout, sim = layout_of("square"), SimConfig(pixels=64, view=2.5)
    found = make_reward(RewardConfig(source="camera"), layout, sim)
    poses = [
        [[2.6, 0.0, 0.0]],
        [[0.0, -2.75, 0.0]],
        [[2.75, 2.6, 0.0]],
    ]  # the second one is outside
    corners = layout.corners(np.array(poses))
    assert found(corners, corners).tolist() == pytest.approx([1.0, -1.0, -1.0])


def test_a_camera_too_coarse_for_a_token_is_refused_with_the_least_that_does() -> None:
    layout, config = layout_of("large_triangle", "square"), RewardConfig(source="camera")
    for sim in (SimConfig(pixels=19), SimConfig(pixels=49, view=2.5)):
        with pytest.raises(
            ConfigError, match=r"of at least 16 pixels, and square covers .*: raise"
        ) as told:
            make_reward(config, layout, sim)
        least = int(str(told.value).rpartition("sim.pixels to ")[2].split()[0])
        make_reward(config, layout, replace(sim, pixels=least))
        with pytest.raises(ConfigError, match="of at least 16 pixels"):
            make_reward(config, layout, replace(sim, pixels=least - 1))


def test_closeness() -> None:
    expected = {0: 1, 0.001: 0.911806, 0.01: 0.524662, ZERO: 0, 0.1: -0.195750, 1: -1, 1.5: -1}
    got = closeness(3.0 * np.array(list(expected)), 3.0)
    np.testing.assert_allclose(got, list(expected.values()), atol=1e-6)


def test_dense_is_the_mean_over_tokens_and_blind_to_the_angle() -> None:
    layout = layout_of("square", "small_triangle")
    goal, state = layout.corners(np.array([[[0, 0, 0], [0, 0, 0]], [[0.5, 0, 1.0], [0, 0, 2.0]]]))
    got = reward_of("dense", layout)(state[None], goal[None])[0]
    assert got == pytest.approx((closeness(np.array(0.5), REACH) + 1.0) / 2.0)


def test_picture_reward() -> None:
    target = np.full((4, 4), BACKGROUND, dtype=np.uint8)
    state = target.copy()
    assert token_pixels(target).sum() == 0
    target[0, :] = TOKEN_GRAY
    assert TargetPictures(target[None]).rewards(state[None])[0] == -1.0
    state[:, 0] = TOKEN_GRAY
    assert TargetPictures(target[None]).rewards(state[None])[0] == -0.5
    state[0, :] = 0  # any gray but the background's
    assert TargetPictures(target[None]).rewards(state[None])[0] == 1.0
    empty = np.full((1, 16, 16), BACKGROUND, dtype=np.uint8)
    with pytest.raises(ConfigError, match=r"no pixel of a picture of 16 x 16: raise sim\.pixels"):
        TargetPictures(empty)


OWN = """
import numpy as np

number = 3

def near(achieved, desired, layout):
    assert achieved.shape == desired.shape == (len(achieved), layout.corner_count, 2)
    return -np.abs(achieved - desired).mean(axis=(1, 2))

def table(achieved, desired, layout):
    return np.zeros((len(achieved), 1))

def text(achieved, desired, layout):
    return ["much"] * len(achieved)

def lost(achieved, desired, layout):
    return np.full(len(achieved), np.nan)

def large(achieved, desired, layout):
    return np.full(len(achieved), -1.1e6)

def writing(achieved, desired, layout):
    achieved -= desired
    return achieved[:, 0, 0]

def leaving(achieved, desired, layout):
    raise SystemExit(3)
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A user's file in the current folder, and one that cannot be loaded."""
    (tmp_path / "own.py").write_text(OWN)
    (tmp_path / "broken.py").write_text("import no_such_package")
    (tmp_path / "half.py").write_text("def near(")
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("own")
def test_a_reward_of_the_users_own() -> None:
    layout = layout_of("square")
    reward = reward_of("own.py:near", layout)
    corners = layout.corners(random_poses(np.random.default_rng(0), 5, 1, 1.0))
    np.testing.assert_allclose(reward(corners, corners + 0.25), -0.25)
    for name in ("overlap", "dense", "own.py:near"):
        check_reward(RewardConfig(name), layout_of("square", "small_triangle"), SimConfig())


@pytest.mark.usefixtures("own")
@pytest.mark.parametrize(
    ("function", "reason"),
    [
        ("table", r"one number per row, shape \(2,\), got shape \(2, 1\)"),
        ("text", "failed: ValueError: could not convert string"),
        ("lost", "must return numbers between -1e.06 and 1e.06, got"),
        ("large", "must return numbers between -1e.06 and 1e.06, got"),
        ("writing", "failed: ValueError: output array is read-only"),
        ("leaving", "failed: SystemExit: 3"),
    ],
)
def test_what_the_users_own_returns_is_checked_also_before_anything_starts(
    function: str, reason: str
) -> None:
    layout = layout_of("square")
    reward = reward_of(f"own.py:{function}", layout)
    corners = layout.corners(random_poses(np.random.default_rng(0), 2, 1, 1.0))
    with pytest.raises(ConfigError, match=reason):
        reward(corners, corners)
    with pytest.raises(ConfigError, match=reason):
        check_reward(RewardConfig(f"own.py:{function}"), layout, SimConfig())


@pytest.mark.usefixtures("own")
@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("no/such.py:near", r"cannot read 'no/such.py' on this machine \(No such file or"),
        ("no/such.py:near", r"put a copy there, or say where it lies with reward\.name=path/to/"),
        ("broken.py:near", r"cannot load 'broken.py' \(ModuleNotFoundError: No module named 'no"),
        ("half.py:near", r"cannot load 'half.py': SyntaxError"),
        ("own.py:far", "'own.py' has no 'far'"),
        ("own.py:number", "'number' is not a function"),
    ],
)
def test_an_own_reward_that_cannot_be_loaded(name: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        reward_of(name, layout_of("square"))


def test_an_own_reward_counts_by_its_content_wherever_the_file_lies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder, content in (("here", OWN), ("there", OWN), ("changed", f"{OWN}\n")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "own.py").write_text(content)
    monkeypatch.chdir(tmp_path / "here")
    here = reward_identity(RewardConfig("own.py:near"))
    assert reward_identity(RewardConfig(f"{tmp_path}/there/own.py:near")) == here
    assert reward_identity(RewardConfig(f"{tmp_path}/changed/own.py:near")) != here
    assert reward_identity(RewardConfig("own.py:text")) != here


def test_a_file_of_the_users_own_holds_in_every_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    Path("own.py").write_text(OWN)
    digest = hashlib.sha256(OWN.encode()).hexdigest()
    for name in ("own.py:near", "~/own.py:near", f"{tmp_path}/own.py:near"):
        assert pinned(RewardConfig(name)) == RewardConfig(f"{tmp_path}/own.py:near", sha256=digest)
    assert pinned(RewardConfig("dense")) == RewardConfig("dense")


@pytest.mark.usefixtures("own")
@pytest.mark.parametrize(
    "use", [pinned, reward_identity, lambda reward: check_reward(reward, layout_of("square"), SIM)]
)
def test_another_file_than_the_one_that_was_written_down_is_refused(
    use: Callable[[RewardConfig], Any],
) -> None:
    ours = pinned(RewardConfig("own.py:near"))
    use(ours)
    Path("own.py").write_text("raise SystemExit")
    found = hashlib.sha256(b"raise SystemExit").hexdigest()
    told = rf"sha256 {found}, and .* want {ours.sha256}: name the .*, or begin a new run"
    with pytest.raises(ConfigError, match=told):
        use(ours)


def test_files_with_one_name_are_different_rewards(tmp_path: Path) -> None:
    layout = layout_of("square")
    corners, got = layout.corners(np.zeros((1, 1, 3))), []
    for number in (1, 2):
        path = tmp_path / str(number) / "own.py"
        path.parent.mkdir()
        path.write_text(f"def same(achieved, desired, layout): return [{number}] * len(achieved)")
        got.append(reward_of(f"{path}:same", layout)(corners, corners)[0])
    assert got == [1, 2]


@pytest.mark.parametrize(("most", "reward"), [(2.0, 0.768), (2.0 * math.tanh(1.0), 0.69)])
def test_who_never_turns_has_what_docs_paper_tells(most: float, reward: float) -> None:
    """With moves as long as one tanh allows, and as tanh of tanh does."""
    square = layout_of("square", scale=0.8 * math.sqrt(2.0))
    drawn = [np.random.default_rng(n) for n in range(4_000)]
    starts, goals = (sample_batch(square, SimConfig(overhang=True), drawn) for _ in range(2))
    ends = starts.copy()
    ends[..., :2] += (goals - starts)[..., :2].clip(-most, most)
    found = overlap(square.corners(ends), square.corners(goals), square).mean()
    assert found == pytest.approx(reward, abs=0.01)
