"""tangram-play on puzzles: which run, which puzzles, what is written, and no window without X."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tangram_agent.runs import load_run
from tangram_sim.errors import ConfigError, TangramError
from tangram_sim.geometry import outlines, pairs_overlap
from tests.worker.builders import write_run
from tests.worker.puzzle_files import GAME, SIM, drawn, write_puzzles
from worker import film as film_module
from worker.cli import with_absolute_paths
from worker.config import PlayConfig, check_puzzle
from worker.film import Frame, film_pictures
from worker.play import make_show, play_run

pytestmark = pytest.mark.fast


def config(folder: Path, **settings: Any) -> PlayConfig:
    if not (folder / "run").exists():
        write_run(folder / "run", GAME, sim=SIM)
    return PlayConfig(str(folder / "run"), **settings)


def test_puzzles_by_name_start_beside_their_figures(tmp_path: Path) -> None:
    made = config(tmp_path, puzzle=("cat", "sun_over_mountains"))
    show = make_show(load_run(made.run_dirs[0]), made)
    assert show.titles == ["cat", "sun over mountains"]
    layout = show.setup.layout
    for start, goal in zip(show.played.starts, show.played.goals, strict=True):
        tokens, pieces = outlines(start[None], layout)[0], outlines(goal[None], layout)[0]
        assert not pairs_overlap(np.repeat(tokens, 7, axis=0), np.tile(pieces, (7, 1, 1))).any()


@pytest.mark.parametrize(
    ("names", "titles"), [(None, ["my cat", "my fish"]), (("my_fish",), ["my fish"])]
)
def test_puzzles_of_a_file(tmp_path: Path, names: tuple[str] | None, titles: list[str]) -> None:
    path = write_puzzles(tmp_path / "mine.json", drawn("cat"), drawn("fish"))
    made = config(tmp_path, puzzles=str(path), puzzle=names)
    assert make_show(load_run(made.run_dirs[0]), made).titles == titles


def test_another_seed_starts_elsewhere(tmp_path: Path) -> None:
    starts = []
    for seed in (0, 0, 1):
        made = config(tmp_path, puzzle=("cat",), seed=seed)
        starts.append(make_show(load_run(made.run_dirs[0]), made).played.starts)
    assert (starts[0] == starts[1]).all()
    assert (starts[0] != starts[2]).all()


def test_unknown_and_too_many_puzzles(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no puzzle 'unicorn' in the library: choose from square"):
        play_run(config(tmp_path, puzzle=("unicorn",), out=str(tmp_path / "x.png")))
    many = [drawn("cat") | {"name": f"cat_{i}"} for i in range(101)]
    path = write_puzzles(tmp_path / "many.json", *many)
    with pytest.raises(ConfigError, match="there are 101 puzzles, at most 100 .* puzzle=.cat_0"):
        play_run(config(tmp_path, puzzles=str(path), out=str(tmp_path / "x.png")))
    assert not (tmp_path / "x.png").exists()


def test_a_picture_shows_the_ends(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "two.png"
    assert play_run(config(tmp_path, puzzle=("cat", "dog"), out=str(out))) == 0
    assert f"{out}: 2 puzzles, covered 0." in capsys.readouterr().out
    with Image.open(out) as picture:
        assert picture.format == "PNG"
        assert picture.width > 1.5 * picture.height


def test_random_targets_of_several_tokens(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "random.png"
    assert play_run(config(tmp_path, episodes=3, out=str(out))) == 0
    assert f"{out}: 3 episodes, raw overlap 0." in capsys.readouterr().out


def test_a_film_has_a_picture_for_each_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("worker.film.MAX_FRAMES", 14)  # drawing takes its time
    monkeypatch.setattr("worker.film.WIDTH", 120)
    made = config(tmp_path, puzzle=("cat",))
    pictures = film_pictures(make_show(load_run(made.run_dirs[0]), made))
    assert len(pictures) == 1 + 14 + 1
    changes = [(np.asarray(a) != np.asarray(b)).any() for a, b in pairwise(pictures)]
    assert all(changes)


class StandIn:
    """A window that notes what it is shown."""

    def __init__(self, closes_after: int = 10**6) -> None:
        self.shown: list[tuple[np.ndarray, np.ndarray]] = []
        self.targets, self.left, self.closed = 0, closes_after, False

    @property
    def is_open(self) -> bool:
        return len(self.shown) < self.left

    def show(self, poses: np.ndarray, rolls: np.ndarray, heights: np.ndarray) -> None:
        assert poses.shape == (7, 3)
        assert rolls.shape == heights.shape == (7,)
        self.shown.append((poses, heights))

    def show_target(self, poses: np.ndarray, flipped: np.ndarray) -> None:
        self.targets += 1

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("FRAME_S", "PAUSE_S"):
        monkeypatch.setattr(film_module, name, 0.0)
    clock = iter(range(10**6))
    monkeypatch.setattr(film_module.time, "monotonic", lambda: -next(clock))


@pytest.mark.parametrize(("left", "targets"), [(10**6, 2), (5, 1)])
def test_a_window_shows_one_puzzle_after_the_other_until_it_is_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_waiting: None, left: int, targets: int
) -> None:
    window = StandIn(left)
    monkeypatch.setattr("tangram_sim.physics.open_window", lambda *_: window)
    monkeypatch.setattr(film_module.time, "sleep", lambda _: None)
    assert play_run(config(tmp_path, puzzle=("cat", "dog"), live=True)) == 0
    assert (window.targets, window.closed) == (targets, True)
    assert len(window.shown) == min(left, 2 * (1 + 1 + 7 * 14 + 1))
    assert max(heights.max() for _, heights in window.shown) <= film_module.CARRIED


@pytest.mark.parametrize("display", [None, ":399"])
def test_no_window_without_a_display(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, display: str | None
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    if display is not None:
        monkeypatch.setenv("DISPLAY", display)
    with pytest.raises(TangramError, match="live=true needs a display .*write a film"):
        play_run(config(tmp_path, puzzle=("cat",), live=True))


def test_a_frame_knows_who_is_held() -> None:
    off = np.zeros(1, dtype=np.bool_)
    frame = Frame(np.zeros((1, 7, 3)), np.zeros((1, 7)), np.array([3]), 0.5, off, 2)
    rested = frame.at_rest()
    assert (rested.held.tolist(), rested.height, rested.done) == ([-1], 0.0, 2)


# Settings


@pytest.mark.parametrize(
    ("value", "names"),
    [(None, None), ("cat", ("cat",)), (8, ("8",)), (["cat", "dog"], ("cat", "dog"))],
)
def test_one_puzzle_or_several(value: object, names: tuple[str, ...] | None) -> None:
    assert check_puzzle(value) == names


@pytest.mark.parametrize("value", ["", [], {"a": 1}, [["cat"]]])
def test_what_names_no_puzzle_is_refused(value: object) -> None:
    with pytest.raises(ConfigError, match="set puzzle=cat or puzzle=.cat,dog."):
        check_puzzle(value)


@pytest.mark.parametrize(
    ("settings", "run_dir"),
    [
        ({"tokens": "square"}, "pretrained/square"),
        ({"tokens": "square", "run_dir": "a"}, "a"),
        ({"puzzle": ("cat",)}, "pretrained/tangram7"),
        ({"puzzles": "test"}, "pretrained/tangram7"),
        ({"puzzles": "test", "tokens": "tangram3"}, "pretrained/tangram3"),
    ],
)
def test_which_run_is_played(monkeypatch: pytest.MonkeyPatch, settings: dict, run_dir: str) -> None:
    monkeypatch.setattr("worker.config.agent_names", lambda: ["tangram7"])
    assert PlayConfig(**settings).run_dirs == (run_dir,)


def test_puzzles_without_an_agent_of_the_game_need_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("worker.config.agent_names", lambda: ["square"])
    with pytest.raises(ConfigError, match="say which run"):
        PlayConfig(puzzle=("cat",))


@pytest.mark.parametrize(
    "other", [{"tokens": "square"}, {"puzzle": ("cat",)}, {"puzzles": "test"}, {"live": True}]
)
def test_runs_are_compared_on_random_targets_only(other: dict) -> None:
    (name,) = other
    with pytest.raises(ConfigError, match=f"^{name}=.* and compare do not go together"):
        PlayConfig(compare=("a", "b"), **other)


def test_files_of_puzzles_are_seen_from_the_callers_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert with_absolute_paths({"puzzles": "mine.json"}) == {"puzzles": f"{tmp_path}/mine.json"}
    assert with_absolute_paths({"puzzles": "test"}) == {"puzzles": "test"}
    assert with_absolute_paths({"sheet": "a.png"}) == {"sheet": f"{tmp_path}/a.png"}
