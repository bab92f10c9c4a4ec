"""tangram-play compare=[...]: several runs on the same starts, and pairs that cannot be."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tangram_agent.runs import load_run
from tangram_sim.errors import ConfigError, RunError
from tests.agent.builders import PAIR, SQUARE
from tests.worker.builders import write_run
from worker.cli import with_absolute_paths
from worker.config import PlayConfig, check_compare
from worker.play import compare_runs, distinct_names, equally_long, headed, play_episodes

pytestmark = pytest.mark.fast

PLAIN_AGENT = {"egocentric": False, "angle_head": "plain"}


def compared(folder: Path, *names: str, **more: object) -> PlayConfig:
    runs = tuple(str(folder / name) for name in names)
    settings = {"out": str(folder / "both.gif"), "episodes": 2} | more
    return PlayConfig(compare=runs, **settings)


@pytest.mark.parametrize("count", [2, 3, 4])
def test_every_run_has_a_column(tmp_path: Path, count: int) -> None:
    names = [f"run_{number}" for number in range(count)]
    for name in names:
        write_run(tmp_path / name)
    out = tmp_path / "ends.png"
    compare_runs(compared(tmp_path, *names, out=str(out), episodes=4))
    with Image.open(out) as picture:
        assert picture.format == "PNG"
        assert 1000 < picture.width < 1300


def test_all_have_the_same_starts_and_targets(tmp_path: Path) -> None:
    write_run(tmp_path / "first")
    write_run(tmp_path / "second", agent=PLAIN_AGENT, sim={"backend": "physics"})
    config = compared(tmp_path, "first", "second", episodes=3)
    plays = [play_episodes(load_run(run), config)[1] for run in config.run_dirs]
    np.testing.assert_allclose(plays[0].starts, plays[1].starts, atol=1e-6)
    np.testing.assert_array_equal(plays[0].goals, plays[1].goals)
    assert (plays[0].ends != plays[1].ends).any()


def test_a_shorter_episode_waits_for_the_longer_one(tmp_path: Path) -> None:
    write_run(tmp_path / "one")
    write_run(tmp_path / "three", sim={"backend": "kinematic", "actions_per_token": 3})
    config = compared(tmp_path, "one", "three", episodes=1)
    shown = [play_episodes(load_run(run), config) for run in config.run_dirs]
    films = equally_long(shown)
    assert len(films[0]) == len(films[1]) == 1 + 3 * 20
    np.testing.assert_array_equal(films[0][-1], films[0][20])


@pytest.mark.parametrize(
    ("other", "reason"),
    [
        ({"tokens": {"shapes": ["small_triangle"], "scale": 1.6}}, r"tokens is \[small_triangle\]"),
        ({"tokens": PAIR}, r"tokens is \[square, large_triangle\]"),
        ({"tokens": SQUARE | {"scale": 0.5}}, "of scale 0.5 here"),
        ({"sim": {"backend": "kinematic", "arena": 3.0}}, "sim.arena is 3 here and 2 there"),
    ],
)
def test_runs_of_another_task_are_refused(tmp_path: Path, other: dict, reason: str) -> None:
    write_run(tmp_path / "first")
    write_run(tmp_path / "second", **other)
    with pytest.raises(RunError, match=reason) as caught:
        compare_runs(compared(tmp_path, "first", "second"))
    assert str(tmp_path / "second") in str(caught.value)
    assert not (tmp_path / "both.gif").exists()


def test_shapes_of_one_name_with_other_corners_are_refused(tmp_path: Path) -> None:
    for name, side in (("first", 0.3), ("second", 0.4)):
        corners = [[0.0, 0.0], [side, 0.0], [0.0, 0.3]]
        write_run(tmp_path / name, {"shapes": [{"name": "own", "corners": corners}], "scale": 1.0})
    with pytest.raises(RunError, match="their tokens have other corners"):
        compare_runs(compared(tmp_path, "first", "second"))


@pytest.mark.parametrize(
    ("folders", "names"),
    [
        (["runs/a", "runs/b"], ["a", "b"]),
        (["paper/seed_0", "mlp/seed_0"], ["paper/seed_0", "mlp/seed_0"]),
        (["x/a/s", "x/b/s", "y/b/s"], ["x/a/s", "x/b/s", "y/b/s"]),
        (["square", "pretrained/square"], ["square", "pretrained/square"]),
    ],
)
def test_labels_tell_the_runs_apart(folders: list[str], names: list[str]) -> None:
    assert distinct_names([Path(folder) for folder in folders]) == names


def test_a_long_name_stays_inside_its_column() -> None:
    panel = Image.new("RGB", (200, 50), "white")
    picture = np.asarray(headed(panel, "a_long_name/" * 20, "score").convert("L"))
    assert (picture[:, -4:] > 200).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "say which run: run_dir=.*compare=\\[runs/a,runs/b\\]"),
        ({"run_dir": "a", "compare": ("b", "c")}, "run_dir=a and compare do not go together"),
        ({"run_dir": " "}, "run_dir must name"),
        ({"compare": ()}, "compare must list 2 to 4"),
        ({"compare": ("a",)}, "compare must list 2 to 4"),
        ({"compare": ("a", "b", "c", "d", "e")}, "compare must list 2 to 4"),
        ({"compare": ("a", "")}, "compare must list 2 to 4"),
        ({"compare": ("a", "a")}, "different runs"),
    ],
)
def test_exactly_one_of_run_dir_and_compare(settings: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        PlayConfig(**settings)


@pytest.mark.parametrize("value", ["a,b", {"a": 1}, 3, [1, 2]])
def test_what_is_no_list_of_folders_is_refused(value: object) -> None:
    with pytest.raises(ConfigError, match="set compare=\\[runs/a,runs/b\\]"):
        check_compare(value)


def test_paths_are_seen_from_the_callers_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pretrained" / "mine").mkdir(parents=True)
    settings = {
        "run_dir": None,
        "compare": ["runs/a", "/b", "pretrained/square", "pretrained/mine"],
        "out": "pretrained/x.png",
    }
    assert with_absolute_paths(settings) == {
        "run_dir": None,
        "compare": [
            str(tmp_path / "runs/a"),
            "/b",
            "pretrained/square",
            str(tmp_path / "pretrained/mine"),
        ],
        "out": str(tmp_path / "pretrained/x.png"),
    }
    assert with_absolute_paths({"run_dir": "pretrained/x"}) == {"run_dir": "pretrained/x"}
