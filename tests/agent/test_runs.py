"""Loading a run from its folder, and each way in which that can fail."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tangram_agent.runs import load_changed, load_run
from tangram_core.errors import ConfigError, RunError, TangramError
from tangram_core.store.checkpoints import save_checkpoint
from tangram_sim.config import RewardConfig
from tests.agent.builders import (
    SMALL,
    Policy,
    learner_of,
    random_transitions,
    sections,
    seen_in,
    setup,
)

pytestmark = pytest.mark.fast

MADE = setup()
WEIGHTS = "checkpoints/00000020/weights.safetensors"
CONFIG = sections()
KINDS = "{task: {kind: place}, agent: {kind: pair}}"


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(CONFIG))
    for updates in (10, 20):
        arrays = {"weights": learner_of(MADE, updates).export()}
        counters = {"setup": MADE.contents()}
        save_checkpoint(tmp_path / "checkpoints", updates, arrays, counters, keep=2)
    return tmp_path


@pytest.mark.parametrize(("checkpoint", "updates"), [(None, 20), ("00000010", 10)])
def test_a_run_acts_as_it_was_saved(run_dir: Path, checkpoint: str | None, updates: int) -> None:
    run = load_run(run_dir, checkpoint)
    assert run.updates == updates
    assert run.config == CONFIG
    expected = Policy(MADE)
    expected.load(learner_of(MADE, updates).export())
    scene = seen_in(random_transitions(MADE, 4))
    np.testing.assert_array_equal(run.act(scene), expected.act(*scene.values()))


def spoil(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(bytes(data))


@pytest.mark.parametrize(
    ("harm", "reason"),
    [
        (lambda run: run.rename(run.with_name("elsewhere")), "no run folder"),
        (lambda run: (run / "config.yaml").unlink(), "is this a run folder"),
        (lambda run: (run / "config.yaml").write_text("a: [1"), "not valid YAML"),
        (lambda run: (run / "config.yaml").write_text("[" * 9999), "is too large for sett"),
        (lambda run: (run / "config.yaml").write_text("- 1"), "holds no settings"),
        (lambda run: (run / "config.yaml").write_text("tokens: {}"), "names no task: .*CHANGELOG"),
        (lambda run: (run / "config.yaml").write_text(KINDS), "no section tokens, sim"),
        (lambda run: (run / "checkpoints").rename(run / "gone"), "no checkpoint in"),
        (lambda run: spoil(run / WEIGHTS), "checksum of weights.safetensors differs"),
    ],
)
def test_a_broken_run_is_refused_in_clear_words(run_dir: Path, harm: Any, reason: str) -> None:
    harm(run_dir)
    with pytest.raises(TangramError, match=reason) as caught:
        load_run(run_dir)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("section", "content"),
    [
        ("tokens", {"shapes": ["parallelogram"], "scale": 1.0}),
        ("agent", {"kind": "scene"}),
        ("net", {**SMALL, "rectified": True}),
        ("sim", {"arena": 3.0}),
    ],
)
def test_a_config_that_was_changed_after_the_training_is_refused(
    run_dir: Path, section: str, content: dict[str, object]
) -> None:
    """None of these changes the shape of any weight."""
    (run_dir / "config.yaml").write_text(yaml.safe_dump(CONFIG | {section: content}))
    with pytest.raises(RunError, match=f"00000020 was trained with: its {section}.* differ"):
        load_run(run_dir)


def test_a_run_may_be_played_in_another_world(run_dir: Path) -> None:
    config = CONFIG | {"sim": {"backend": "physics"}, "reward": {"name": "dense"}}
    (run_dir / "config.yaml").write_text(yaml.safe_dump(config))
    assert load_run(run_dir).task.sim.backend == "physics"


def test_a_run_folder_has_no_code_loaded_that_was_not_named(run_dir: Path) -> None:
    own = run_dir / "own.py"
    own.write_text("def near(achieved, desired, layout): return [0.0] * len(achieved)")
    config = CONFIG | {"reward": {"name": f"{own}:near", "sha256": "0" * 64}}
    (run_dir / "config.yaml").write_text(yaml.safe_dump(config))
    with pytest.raises(ConfigError, match=rf"name code, {own}:near \(sha256 0{{64}}\)"):
        load_run(run_dir)
    with pytest.raises(ConfigError, match=f"has sha256 .* want {'0' * 64}"):
        load_run(run_dir, reward=f"{own}:near")
    assert load_changed(run_dir, {"reward": {"name": "overlap"}}).task.reward == RewardConfig()
    config["reward"] = {"name": f"{own}:near"}
    (run_dir / "config.yaml").write_text(yaml.safe_dump(config))
    assert load_run(run_dir, reward=f"{own}:near").task.reward.own == (own, "near")


def test_weights_of_another_net_are_refused(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(CONFIG | {"net": {**SMALL, "width": 32}}))
    arrays = {"weights": learner_of(MADE, 0).export()}
    save_checkpoint(tmp_path / "checkpoints", 10, arrays, {}, keep=2)
    with pytest.raises(RunError, match="weights of another layout"):
        load_run(tmp_path)
