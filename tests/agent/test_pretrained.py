"""Agents of the package: found by name from any folder, and read with every byte checked."""

import hashlib
import json
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
import yaml

from tangram_agent import pretrained
from tangram_agent.pretrained import CARD, CONFIG, FORMAT, WEIGHTS, agent_names, is_name
from tangram_agent.runs import load_run
from tangram_core.errors import RunError, TangramError
from tangram_tasks import goal_env
from tangram_tasks.register import IDS
from tests.agent.builders import (
    BFLOAT,
    NAN,
    Policy,
    learner_of,
    random_transitions,
    sections,
    seen_in,
    setup,
    with_weights,
)

pytestmark = pytest.mark.fast

MADE = setup()
TENSORS = learner_of(MADE, 3).export()
SECTIONS = sections()


def write_agent(folder: Path, **card: object) -> Path:
    folder.mkdir(parents=True)
    (folder / CONFIG).write_text(yaml.safe_dump(SECTIONS))
    data = safetensors.numpy.save(TENSORS)
    (folder / WEIGHTS).write_bytes(data)
    content = {"format": FORMAT, "updates": 12, "sha256": hashlib.sha256(data).hexdigest()} | card
    (folder / CARD).write_text(json.dumps(content))
    return folder


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package with two agents, seen from an empty folder."""
    for name in ("square", "other"):
        write_agent(tmp_path / "package" / name)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.setattr(pretrained, "PACKAGED", tmp_path / "package")
    monkeypatch.chdir(tmp_path / "elsewhere")
    return tmp_path / "package"


@pytest.mark.parametrize("run_dir", ["pretrained/square", Path("pretrained/square")])
def test_an_agent_is_found_by_its_name(package: Path, run_dir: str | Path) -> None:
    run = load_run(run_dir)
    assert (run.folder, run.updates, run.config) == (Path("pretrained/square"), 12, SECTIONS)
    expected = Policy(MADE)
    expected.load(TENSORS)
    scene = seen_in(random_transitions(MADE, 4))
    np.testing.assert_array_equal(run.act(scene), expected.act(*scene.values()))


def test_a_folder_is_read_from_anywhere_and_wins_over_the_package(
    package: Path, tmp_path: Path
) -> None:
    write_agent(Path("pretrained/square"), updates=99)
    assert load_run("pretrained/square").updates == 99
    folder = write_agent(tmp_path / "mine")
    assert load_run(folder).folder == folder


@pytest.mark.parametrize("run_dir", ["runs/pretrained/square", "/pretrained/square", "square"])
def test_only_the_plain_name_means_the_package(package: Path, run_dir: str) -> None:
    assert not is_name(run_dir)
    with pytest.raises(RunError, match="no run folder"):
        load_run(run_dir)


def test_an_unknown_name_lists_those_that_there_are(package: Path) -> None:
    known = "no pretrained agent 'cat': choose from pretrained/other, pretrained/square"
    with pytest.raises(RunError, match=known):
        load_run("pretrained/cat")
    with pytest.raises(RunError, match="has no checkpoint 00000010"):
        load_run("pretrained/square", "00000010")


@pytest.mark.parametrize(
    ("harm", "reason"),
    [
        (lambda agent: (agent / WEIGHTS).write_bytes(b"x"), "checksum of weights.safetensors"),
        (lambda agent: (agent / WEIGHTS).unlink(), "is damaged .*: install tangram-rl again"),
        (lambda agent: (agent / CONFIG).unlink(), "is damaged"),
        (lambda agent: (agent / CONFIG).write_text("- 1"), "holds no settings"),
        (lambda agent: (agent / CONFIG).write_text("a: [1"), "not valid YAML"),
        (lambda agent: (agent / CARD).write_text("[" * 100_000), "cannot be read"),
        (lambda agent: (agent / CARD).write_text('{"format": 1}'), "not of format 2"),
        (lambda agent: (agent / CARD).write_text('{"format": 2}'), "has no number of updates"),
        (lambda agent: with_weights(agent, BFLOAT), "not safetensors: 'BF16'"),
        (lambda agent: with_weights(agent, NAN), "'a' is not finite"),
    ],
)
def test_a_damaged_agent_is_refused(package: Path, harm: object, reason: str) -> None:
    harm(package / "square")
    with pytest.raises(TangramError, match=reason) as caught:
        load_run("pretrained/square")
    assert "\n" not in str(caught.value)
    assert "pretrained/square" in str(caught.value)


@pytest.mark.parametrize("name", agent_names())
def test_the_packages_own_agents_are_whole_small_and_good(name: str) -> None:
    folder = pretrained.PACKAGED / name
    run = load_run(f"pretrained/{name}")
    card = json.loads((folder / CARD).read_bytes())
    layout = run.setup.task.layout  # type: ignore[attr-defined]
    assert [shape.name for shape in layout.shapes] == card.get("task", card)["tokens"]
    scores = card["tests"]["scores"]["this run"]  # as it ships
    assert scores["placed"] > 0.6 if name == "hand" else scores["mean_reward"] > 0.9
    assert len((folder / WEIGHTS).read_bytes()) < 1_000_000
    assert card["name"] == name


@pytest.mark.parametrize(
    ("name", "agent"),
    [
        ("Tangram-v0", "pretrained/square"),
        ("Tangram7-v0", "pretrained/tangram7"),
    ],
)
def test_an_id_is_what_its_agent_was_trained_on(name: str, agent: str) -> None:
    task, (kind, settings) = load_run(agent).setup.task, IDS[name]
    with closing(getattr(goal_env, kind)(**settings)) as env:
        assert env.task.identity() == task.identity()


@pytest.mark.parametrize("name", agent_names())
def test_an_agent_plays_the_environment_of_its_task(name: str) -> None:
    run = load_run(f"pretrained/{name}")
    with closing(goal_env.TaskEnv(run.setup.task)) as env:
        observation, _ = env.reset(seed=0)
        assert env.observation_space.contains(observation)
        action = run.predict(observation)
        assert env.action_space.contains(action)
        observation, reward, *_ = env.step(action)
        assert env.observation_space.contains(observation)
        goals = observation["achieved_goal"], observation["desired_goal"]
        near = 0.05 if "pictures" in name else 1e-6
        assert env.compute_reward(*goals, {}) == pytest.approx(reward, abs=near)
