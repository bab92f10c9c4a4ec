"""tangram-eval and tangram-play on run folders with random weights."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tangram_sim.errors import ConfigError, RunError
from tests.agent.builders import PAIR, setup
from tests.worker.builders import write_run
from worker.config import EvalConfig, PlayConfig
from worker.evaluate import evaluate_run
from worker.film import frames_per_action
from worker.play import motion, play_run

pytestmark = pytest.mark.fast

SCORES = {
    "mean_reward",
    "mean_reward_camera",
    "raw_overlap",
    "raw_overlap_p10",
    "angle_error_deg_median",
    "angle_error_deg_p90",
    "position_error_median",
    "position_error_p90",
    "episodes",
}


def test_evaluation_writes_scores_and_prints_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_run(tmp_path / "run")
    out = tmp_path / "scores.json"
    assert evaluate_run(EvalConfig(str(tmp_path / "run"), episodes=40, out=str(out))) == 0
    report = json.loads(out.read_text())
    assert set(report) >= SCORES | {"seconds", "baselines"}
    assert report["episodes"] == 40
    assert report["actions"] == 1
    assert report["updates"] == 7
    assert report["tokens"] == ["square"]
    assert report["agent"] == "tangram"
    assert set(report["baselines"]) == {"exact", "position only", "random"}
    assert report["baselines"]["position only"]["position_error_median"] < 1e-6
    assert (
        report["baselines"]["random"]["mean_reward"]
        < report["baselines"]["position only"]["mean_reward"]
    )
    printed = capsys.readouterr().out
    assert f"{report['mean_reward']:.3f}" in printed
    assert "run after 7 updates" in printed
    assert "position only" in printed
    assert "40 fixed tests, 1 action a token" in printed


def test_evaluation_repeats_itself_and_other_tests_differ(tmp_path: Path) -> None:
    write_run(tmp_path / "run")

    def scores(**more: int) -> dict:
        out = tmp_path / "scores.json"
        evaluate_run(EvalConfig(str(tmp_path / "run"), episodes=5, out=str(out), **more))
        return {name: json.loads(out.read_text())[name] for name in SCORES}

    assert scores() == scores()
    assert scores() != scores(seed=1)
    assert scores() != scores(actions=3)


def test_the_number_of_actions_is_written_down(tmp_path: Path) -> None:
    write_run(tmp_path / "run", PAIR)
    out = tmp_path / "scores.json"
    evaluate_run(EvalConfig(str(tmp_path / "run"), episodes=2, actions=4, out=str(out)))
    assert json.loads(out.read_text())["actions"] == 4


def test_a_picture_shows_all_episodes(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    sizes = []
    for episodes in (1, 4, 12):
        out = tmp_path / f"{episodes}.png"
        play_run(PlayConfig(str(tmp_path / "run"), str(out), episodes=episodes))
        with Image.open(out) as picture:
            assert picture.format == "PNG"
            sizes.append(picture.size)
    assert sizes[0][0] < sizes[1][0]
    assert sizes[0][1] < sizes[1][1]
    assert max(sizes[2]) < 900


def test_another_seed_shows_other_episodes(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    pictures = []
    for seed in (0, 0, 1):
        out = tmp_path / "ends.png"
        play_run(PlayConfig(str(tmp_path / "run"), str(out), episodes=2, seed=seed))
        pictures.append(out.read_bytes())
    assert pictures[0] == pictures[1] != pictures[2]


def test_motion_is_even_and_ends_where_the_episode_did() -> None:
    """A token moved by (0.4, -0.2) and turned by 170 degrees past the cut of the angle."""
    layout = setup().layout
    start, end = np.array([[0.0, 0.0, 2.0]]), np.array([[0.4, -0.2, 2.0 + np.radians(170.0)]])
    corners = layout.corners(np.stack([start, end, end])[None])
    frames = motion(layout, corners, count=4)
    assert len(frames) == 1 + 2 * 4
    for i, frame in enumerate(frames):
        share = min(i / 4, 1.0)
        expected = layout.corners(start + share * (end - start))
        np.testing.assert_allclose(frame[0], expected, atol=1e-9)


@pytest.mark.parametrize(("horizon", "count"), [(1, 20), (5, 20), (6, 16), (50, 2), (500, 1)])
def test_long_episodes_get_fewer_frames_for_each_action(horizon: int, count: int) -> None:
    assert frames_per_action(horizon) == count


@pytest.mark.parametrize(
    "use",
    [
        lambda run: evaluate_run(EvalConfig(str(run), out=str(run.with_name("out.json")))),
        lambda run: play_run(PlayConfig(str(run), out=str(run.with_name("out.gif")))),
    ],
    ids=["eval", "play"],
)
@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda run: run.rename(run.with_name("gone")), "no run folder"),
        (lambda run: (run / "config.yaml").unlink(), "is this a run folder"),
        (lambda run: (run / "checkpoints" / "00000007").rename(run / "x"), "no checkpoint"),
        (
            lambda run: (run / "checkpoints" / "00000007" / "weights.safetensors").write_bytes(b""),
            "is corrupt",
        ),
    ],
)
def test_a_run_that_cannot_be_used(
    tmp_path: Path, use: Callable, spoil: Callable, reason: str
) -> None:
    run = tmp_path / "run"
    write_run(run)
    spoil(run)
    with pytest.raises(RunError, match=reason):
        use(run)
    assert list(tmp_path.glob("out*")) == []


def test_a_run_of_another_setup_is_refused(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    text = (tmp_path / "run" / "config.yaml").read_text()
    (tmp_path / "run" / "config.yaml").write_text(text.replace("width: 16", "width: 32"))
    with pytest.raises((RunError, ConfigError), match="another"):
        evaluate_run(EvalConfig(str(tmp_path / "run")))
