"""Animations of tangram-play, whose drawing takes a while."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import worker.film as film_module
from tests.agent.builders import PAIR
from tests.worker.builders import write_run
from tests.worker.test_compare import PLAIN_AGENT, compared
from worker.config import PlayConfig
from worker.play import compare_runs, play_run

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(("episodes", "actions"), [(4, None), (1, 2)])
def test_an_animation_has_frames_that_move(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    episodes: int,
    actions: int | None,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(film_module, "FRAMES_PER_ACTION", 6)  # drawing takes its time
    write_run(tmp_path / "run", PAIR)
    out = tmp_path / "film.gif"
    config = PlayConfig(str(tmp_path / "run"), str(out), episodes=episodes, actions=actions)
    assert play_run(config) == 0
    with Image.open(out) as film:
        assert film.format == "GIF"
        assert film.n_frames > 10
        first = np.asarray(film.convert("RGB"))
        film.seek(film.n_frames - 1)
        assert (np.asarray(film.convert("RGB")) != first).any()
    assert f"{out}: {episodes} episodes, raw overlap 0." in capsys.readouterr().out
    assert list(tmp_path.glob(".film*")) == []


def test_two_agents_move_side_by_side(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_run(tmp_path / "first")
    write_run(tmp_path / "second", agent=PLAIN_AGENT)
    assert compare_runs(compared(tmp_path, "first", "second", episodes=1)) == 0
    printed = capsys.readouterr().out
    assert f"{tmp_path / 'both.gif'}: 1 episodes; first: mean raw overlap 0." in printed
    assert "; second: mean raw overlap 0." in printed
    with Image.open(tmp_path / "both.gif") as film:
        assert film.n_frames > 10
        assert film.width > film.height
        left, right = halves(film)
        film.seek(film.n_frames - 1)
        last = halves(film)
        assert (last[0] != left).any()
        assert (last[1] != right).any()


def halves(film: Image.Image) -> tuple[np.ndarray, np.ndarray]:
    pixels = np.asarray(film.convert("RGB"))
    middle = pixels.shape[1] // 2
    return pixels[:, : middle - 12], pixels[:, middle + 12 :]
