"""tangram-play: which episodes are shown, and what is drawn of them."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import tangram_game.show.film as film_module
from tangram_agent.runs import load_changed, load_run
from tangram_core.errors import ConfigError
from tangram_game.config import PlayConfig
from tangram_game.play import (
    make_show,
    motion,
    play_episodes,
    play_run,
)
from tangram_game.show.film import Show, film_pictures
from tangram_game.show.views import beside, camera_sheets
from tangram_sim.geometry.overlap import outlines, pairs_overlap
from tests.agent.builders import PAIR, SQUARE, setup
from tests.game.figures.puzzle_files import GAME, SIM, drawn, write_puzzles
from tests.worker.builders import write_run

pytestmark = pytest.mark.fast


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes its time."""
    monkeypatch.setattr(film_module, "FRAMES_PER_ACTION", 6)
    monkeypatch.setattr(film_module, "WIDTH", 120)


ANYWHERE = SIM | {"starts": "anywhere"}  # a run may have trained with other starts
PLAIN_AGENT = {"reapply": 2}


def of_square(folder: Path, run_of: dict[str, Any] = SQUARE, **settings: Any) -> PlayConfig:
    if not (folder / "run").exists():
        write_run(folder / "run", run_of, **({"sim": ANYWHERE} if run_of is GAME else {}))
    return PlayConfig(str(folder / "run"), **settings)


def of_game(folder: Path, **settings: Any) -> PlayConfig:
    return of_square(folder, GAME, **settings)


def shown(config: PlayConfig) -> Show:
    return make_show(load_run(config.run), config)


# What the camera sees beside it

OBSERVED = {"observe": "pictures", "pixels": 64}


def test_the_cameras_view_stands_beside_the_table(tmp_path: Path) -> None:
    for suffix, frames in ((".png", 1), (".gif", 6)):
        sizes = []
        for sim in ({}, OBSERVED):
            out = tmp_path / f"it{suffix}"
            play_run(of_square(tmp_path, out=str(out), episodes=2, changes={"sim": sim}))
            with Image.open(out) as picture:
                sizes.append(picture.size)
                assert getattr(picture, "n_frames", 1) >= frames
        assert sizes[1][0] > 2 * sizes[0][0]
        assert sizes[1][1] == sizes[0][1]


def test_only_what_was_found_is_drawn_over_the_cameras_view(tmp_path: Path) -> None:
    write_run(tmp_path / "run", SQUARE)
    run = load_changed(tmp_path / "run", {"sim": OBSERVED})
    played = play_episodes(run, PlayConfig(str(tmp_path / "run"), episodes=2))

    def coloured() -> int:
        (first, _) = camera_sheets(run.task, played, 1, 60)
        red, _, blue = np.asarray(first, np.int64).transpose(2, 0, 1)
        return np.count_nonzero(blue > red + 30)

    both, confidence = coloured(), played.episodes["seen"]
    confidence[1] = 0
    one = coloured()
    confidence[0] = 0
    assert both > one > coloured() == 0
    assert camera_sheets(run.task, replace(played, pictures=None), 1, 60) == []


def test_every_frame_has_the_view_of_its_moment() -> None:
    views: Any = list("abcd")
    frames: Any = range(1 + 3 * 6)
    assert "".join(map(str, beside(frames, views))) == "aaaaaabbbbbbccccccd"
    assert beside([*frames, 19], views)[-2:] == ["d", "d"]  # a game's film has its end once more


# Episodes of one run


def test_a_picture_shows_all_episodes(tmp_path: Path) -> None:
    sizes = []
    for episodes in (1, 4, 12):
        out = tmp_path / f"{episodes}.png"
        play_run(of_square(tmp_path, out=str(out), episodes=episodes))
        with Image.open(out) as picture:
            assert picture.format == "PNG"
            sizes.append(picture.size)
    assert sizes[0][0] < sizes[1][0]
    assert sizes[0][1] < sizes[1][1]
    assert max(sizes[2]) < 900


def test_motion_is_even_and_ends_where_the_episode_did() -> None:
    """A token moved by (0.4, -0.2) and turned by 170 degrees past the cut of the angle."""
    layout = setup().task.layout
    start, end = np.array([[0.0, 0.0, 2.0]]), np.array([[0.4, -0.2, 2.0 + np.radians(170.0)]])
    corners = layout.corners(np.stack([start, end, end])[None])
    frames = motion(layout, corners, count=4)
    assert len(frames) == 1 + 2 * 4
    for i, frame in enumerate(frames):
        expected = layout.corners(start + min(i / 4, 1.0) * (end - start))
        np.testing.assert_allclose(frame[0], expected, atol=1e-9)


@pytest.mark.parametrize("tokens", [SQUARE, PAIR], ids=["one", "two"])
def test_an_animation_has_frames_that_move(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], tokens: dict[str, Any]
) -> None:
    out = tmp_path / "film.gif"
    changes = {"sim": {"actions_per_token": 2}}
    made = of_square(tmp_path, run_of=tokens, out=str(out), episodes=2, changes=changes)
    assert play_run(made) == 0
    with Image.open(out) as film:
        assert film.format == "GIF"
        assert film.n_frames > 10
        first = np.asarray(film.convert("RGB"))
        film.seek(film.n_frames - 1)
        assert (np.asarray(film.convert("RGB")) != first).any()
    assert f"{out}: 2 episodes, coverage 0." in capsys.readouterr().out
    assert list(tmp_path.glob(".film*")) == []


def test_a_film_as_mp4_shows_the_same_for_as_long(tmp_path: Path) -> None:
    """The GIF keeps a picture that stays as one, for longer."""
    av = pytest.importorskip("av", reason="pip install '.[video]'")
    for name in ("film.gif", "film.mp4"):
        made = of_square(tmp_path, run_of=PAIR, out=str(tmp_path / name), episodes=2)
        assert play_run(made) == 0
    with av.open(str(tmp_path / "film.mp4")) as film:
        stream = film.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")
        shown = [frame.to_ndarray(format="rgb24") for frame in film.decode(stream)]
        seconds = float(stream.duration * stream.time_base)
    with Image.open(tmp_path / "film.gif") as gif:
        lasts, ends = [], []
        for index in range(gif.n_frames):
            gif.seek(index)
            lasts.append(gif.info["duration"])
            ends.append(np.asarray(gif.convert("RGB")).astype(int))
    assert seconds == pytest.approx(sum(lasts) / 1000)
    height, width, _ = ends[0].shape
    assert [side % 2 for side in shown[0].shape[:2]] == [0, 0]
    for own, other in ((shown[0], ends[0]), (shown[-1], ends[-1])):
        assert np.abs(own[:height, :width].astype(int) - other).mean() < 4
    assert (tmp_path / "film.mp4").stat().st_size < 2 * (tmp_path / "film.gif").stat().st_size


def test_without_pyav_one_line_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tangram_game.config.find_spec", lambda _: None)
    with pytest.raises(ConfigError, match=r"out=a.mp4 needs PyAV, .*: pip install av"):
        PlayConfig("run", out="a.mp4")


# Puzzles, and random targets of several tokens


def test_puzzles_by_name_start_beside_their_figures_and_elsewhere_with_another_seed(
    tmp_path: Path,
) -> None:
    names = ("cat", "sun_over_mountains")
    shows = [shown(of_game(tmp_path, puzzle=names, seed=seed)) for seed in (0, 0, 1)]
    assert shows[0].titles == ["cat", "sun over mountains"]
    starts, layout = [show.played.starts for show in shows], shows[0].task.layout
    assert (starts[0] == starts[1]).all()
    assert (starts[0] != starts[2]).all()
    for start, goal in zip(starts[0], shows[0].played.goals, strict=True):
        tokens, pieces = outlines(start[None], layout)[0], outlines(goal[None], layout)[0]
        assert not pairs_overlap(np.repeat(tokens, 7, axis=0), np.tile(pieces, (7, 1, 1))).any()


def test_too_many_puzzles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tangram_game.play.MAX_SHOWN", 2)
    out = tmp_path / "x.png"
    many = [drawn("cat") | {"name": f"cat_{i}"} for i in range(3)]
    path = write_puzzles(tmp_path / "many.json", *many)
    with pytest.raises(ConfigError, match=r"3 figures .* at most 2: .*json,cat_0], or"):
        play_run(of_game(tmp_path, puzzle=(str(path),), out=str(out)))
    assert not out.exists()


@pytest.mark.parametrize(
    ("what", "told"),
    [
        ({"puzzle": ("cat", "dog")}, "2 puzzles, coverage 0."),
        ({"episodes": 2}, "2 episodes, coverage 0."),
    ],
)
def test_a_picture_of_several_tokens_shows_the_ends(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], what: dict[str, Any], told: str
) -> None:
    out = tmp_path / "two.png"
    assert play_run(of_game(tmp_path, out=str(out), **what)) == 0
    assert f"{out}: {told}" in capsys.readouterr().out
    with Image.open(out) as picture:
        assert picture.format == "PNG"
        assert picture.width > 1.5 * picture.height


def test_a_film_has_a_picture_for_each_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(film_module, "MAX_FRAMES", 14)
    show = shown(of_game(tmp_path, puzzle=("cat",), seed=2))
    assert show.told().startswith("1 puzzle, coverage 0.")
    pictures = film_pictures(show)
    assert len(pictures) == 1 + 14 + 1
    assert all((np.asarray(a) != np.asarray(b)).any() for a, b in pairwise(pictures))
