"""The paper's Figs. 1 to 3: files, captions, and that drawing twice gives the same bytes."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tangram_lab.experiments import pictures
from tangram_lab.experiments.pictures import (
    TOKENS,
    draw_paper_pictures,
    embeddings,
    node_classes,
    take_shots,
)
from tangram_sim.errors import ConfigError
from tangram_sim.layout import make_layout

pytestmark = pytest.mark.slow


def test_three_pictures_with_titles_and_captions_twice_the_same(tmp_path: Path) -> None:
    shown = draw_paper_pictures(tmp_path / "first")
    assert [title.split(":")[0] for title, _, _ in shown] == ["Fig. 1", "Fig. 2", "Fig. 3"]
    for title, file, caption in shown:
        assert caption.startswith(title.split(":")[0])
        with Image.open(tmp_path / "first" / file) as picture:
            assert picture.width > 1000
            colours = picture.convert("RGB").getcolors(1 << 24)
        assert len(colours) > 3
    assert draw_paper_pictures(tmp_path / "second") == shown
    files = sorted(path.name for path in (tmp_path / "first").iterdir())
    assert len(files) == 6
    for name in files:
        first, second = ((tmp_path / one / name).read_bytes() for one in ("first", "second"))
        assert first == second, name


@pytest.mark.parametrize("backend", ["physics", "kinematic"])
def test_the_camera_sees_an_episode(backend: str) -> None:
    shots = take_shots(backend)
    assert shots.backend == backend
    assert (shots.start != shots.target).any()
    assert (shots.end != shots.start).any()
    assert 0.5 < shots.reward < 0.95


def test_without_the_engine_the_kinematic_camera_is_used_and_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(layout: object, sim: object) -> None:
        if sim.backend == "physics":
            raise ConfigError("no module named 'pybullet'")

    monkeypatch.setattr(pictures, "check_world", refuse)
    _, caption = pictures.draw_camera()
    assert "the kinematic world's camera (PyBullet is not installed)" in caption


def test_the_graph_is_the_layouts(tmp_path: Path) -> None:
    layout = make_layout(TOKENS)
    assert node_classes(layout) == [0] * 4 + [1] + [2] * 4
    features = layout.node_features(
        layout.corners(np.zeros((1, 3))), np.zeros(1, bool), layout.corners(np.ones((1, 3)))
    )
    first, last = embeddings(layout, features)
    assert first.shape == last.shape == (9, 64)
    assert (first != last).any()
