"""Making the agents of the package from finished runs."""

import json
import shutil
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import yaml

from tangram_agent.runs import load_run
from tangram_core.errors import ConfigError, RunError
from tangram_core.run.service import ServiceConfig
from tangram_core.setup import make_setup
from tangram_core.store.checkpoints import save_checkpoint
from tangram_game.config import EvalConfig
from tangram_game.evaluate import evaluate_run
from tangram_game.figures.puzzles import find_figures
from tangram_lab.experiments import pretrained
from tangram_lab.experiments.pretrained import main, publish
from tests.agent.agents.outline.outlines import AGENT as FILLER
from tests.agent.agents.outline.outlines import SIM as OUTLINES
from tests.agent.builders import random_transitions, seen_in, setup
from tests.sim.builders import SEVEN
from tests.worker.builders import write_run

pytestmark = pytest.mark.fast

TESTS = 3
RESULT = {
    "mean_reward_camera": 0.9,
    "coverage": 0.95,
    "coverage_p10": 0.9,
    "angle_error_deg_median": 0.5,
    "angle_error_deg_p90": 1.0,
    "position_error_median": 0.001,
    "position_error_p90": 0.002,
    "test_episodes": 100.0,
    "scored_updates": 7,
    "updates": 7,
    "episodes": 1234,
    "transitions": 1234,
    "wall_s": 12.0,
    "train_s": 11.0,
    "cores": 2,
    "processor": "A Processor",
    "device": "cpu",
    "workers": 1,
    "parameters": 999,
    "commit": None,
    "host": "a_secret_host",
    "versions": {"python": "3.11.7"},
}

SEED_0 = RESULT | {"seed": 0, "mean_reward": 0.2}


def finished(folder: Path, seed: int, mean_reward: float | None, **more: object) -> Path:
    """A finished run, as tangram-train leaves it, with random weights of the seed's own."""
    run = folder / f"seed_{seed}"
    write_run(run)
    config = yaml.safe_load((run / "config.yaml").read_text())
    (run / "config.yaml").write_text(yaml.safe_dump(config | {"run_dir": str(run)}))
    result = RESULT | {"seed": seed, "mean_reward": mean_reward} | more
    (run / "result.json").write_text(json.dumps(result))
    return run


@pytest.mark.parametrize(
    ("rewards", "seed"),
    [([0.9, 0.7, 0.8], 2), ([0.5], 0), ([0.9, 0.7], 1), ([0.1, 0.4, 0.3, 0.2], 3)],
)
def test_the_median_seed_ships(tmp_path: Path, rewards: list[float], seed: int) -> None:
    runs = [finished(tmp_path, number, reward) for number, reward in enumerate(rewards)]
    folder = publish(runs, "square", tmp_path / "out", TESTS)
    assert folder == tmp_path / "out" / "square"
    card = json.loads((folder / "card.json").read_text())
    assert card["seed"] == seed
    assert [one["mean_reward"] for one in card["seeds"]] == rewards


def test_an_agent_is_its_run_and_its_card_tells_everything(tmp_path: Path) -> None:
    runs = [finished(tmp_path, number, 0.7 + number / 10) for number in range(3)]
    folder = publish(runs, "square", tmp_path / "out", TESTS)
    assert {path.name for path in folder.iterdir()} == {
        "card.json",
        "config.yaml",
        "weights.safetensors",
    }
    scene = seen_in(random_transitions(setup(), 4))
    agent, run = load_run(folder), load_run(runs[1])
    assert agent.updates == 7
    assert agent.setup == run.setup
    np.testing.assert_array_equal(agent.act(scene), run.act(scene))
    card = json.loads((folder / "card.json").read_text())
    assert card["tests"]["episodes"] == TESTS
    assert [*card["tests"]["scores"]] == ["this run", "exact", "position only", "random"]
    assert (card["episodes"], card["updates"]) == (1234, 7)
    assert (card["budget"]["train_s"], card["budget"]["processor"]) == (11, "A Processor")
    assert [one["mean_reward"] for one in card["seeds"]] == pytest.approx([0.7, 0.8, 0.9])
    assert card["selection"].startswith("median of the seeds")
    # Nothing of the machine that it was made on, and nothing that is no number in the JSON.
    for path in folder.iterdir():
        content = path.read_bytes()
        assert str(tmp_path).encode() not in content
        assert b"a_secret_host" not in content


def test_an_agent_of_outlines_ships_beside_its_rivals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pretrained, "FIGURES", ("test",))
    monkeypatch.setattr(  # all figures of a split take long
        pretrained, "find_figures", lambda split, run, *_: find_figures(split, run, ["heart"])
    )
    run, seven = finished(tmp_path, 0, 0.5), {"shapes": list(SEVEN), "scale": 0.6}
    sim = {"backend": "kinematic", "arena": 2.0, "allow_flip": True}
    write_run(run, tokens=seven, sim=OUTLINES | sim | {"targets": "touching"}, agent=FILLER)
    folder = publish([run], "outlines", tmp_path / "out", 1)
    card = json.loads((folder / "card.json").read_text())
    assert set(card["tests"]["scores"]) == {"this run", "search", "random"}
    told = {*card["tests"]["scores"]["this run"], *card["puzzles"]["test"]["scores"]}
    assert {"iou", "solved", "coverage_p10"} <= told


def test_an_agent_of_pushes_ships_trying_some_and_beside_who_is_quick(tmp_path: Path) -> None:
    run = finished(tmp_path, 0, None, solved=0.5)
    config = {
        "task": {"kind": "push"},
        "tokens": {"shapes": ["square"], "scale": 1.1},
        "agent": {"kind": "push", "width": 8, "looked_at": 4},
        "service": asdict(ServiceConfig()),
    }
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    made = make_setup(config)
    arrays = {"weights": made.agent.learner(made.task, 0, "cpu").export(), "learner": {}}
    arrays["learner"]["updates"] = np.array([7])
    save_checkpoint(run / "checkpoints", 7, arrays, {}, keep=1)
    folder = publish([run], "pushes", tmp_path / "out", 1)
    card = json.loads((folder / "card.json").read_text())
    assert load_run(folder).setup.agent.config.tried == 16
    assert set(card["tests"]["scores"]) == {"this run", "random"}
    assert "median of the seeds by final solved" in card["selection"]


def test_an_agent_is_evaluated_like_a_run(tmp_path: Path) -> None:
    folder = publish([finished(tmp_path, 0, 0.5)], "square", tmp_path / "out", TESTS)
    out = tmp_path / "scores.json"
    evaluate_run(EvalConfig(str(folder), episodes=TESTS, seed=1, out=str(out)))
    scores = json.loads(out.read_text())
    tested = json.loads((folder / "card.json").read_text())["tests"]["scores"]["this run"]
    assert {name: scores[name] for name in tested} == tested


def other_net(run: Path) -> None:
    shutil.rmtree(run)
    write_run(run, net={"width": 8, "layers": 1, "feed_forward": 8})
    (run / "result.json").write_text(json.dumps(RESULT | {"seed": 1, "mean_reward": 0.1}))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda run: (run / "result.json").unlink(), "cannot read .*result.json"),
        (lambda run: (run / "result.json").write_text("{"), "cannot read .*result.json"),
        (lambda run: finished(run.parent, 1, None), "holds no score"),
        (lambda run: finished(run.parent, 1, 0.3, scored_updates=5), "scored after 5 of its 7"),
        (lambda run: finished(run.parent, 1, 0.3, updates=9, scored_updates=9), "weights of 7"),
        (
            lambda run: (run / "result.json").write_text(json.dumps(SEED_0)),
            r"of the seeds \[0, 0\]",
        ),
        (other_net, "differs from .*seed_0 in net"),
    ],
)
def test_runs_that_make_no_agent_are_refused(tmp_path: Path, spoil: object, message: str) -> None:
    runs = [finished(tmp_path, seed, 0.5) for seed in (0, 1)]
    spoil(runs[1])
    with pytest.raises(RunError, match=message):
        publish(runs, "square", tmp_path / "out", TESTS)
    assert not (tmp_path / "out").exists()


def test_weights_that_are_too_large_are_refused(tmp_path: Path) -> None:
    run = tmp_path / "run"
    write_run(run, net={"width": 256, "layers": 2, "feed_forward": 256})
    (run / "result.json").write_text(json.dumps(RESULT | {"seed": 0, "mean_reward": 0.1}))
    with pytest.raises(RunError, match="more than 1,000,000: publish an agent with a smaller net"):
        publish([run], "square", tmp_path / "out", TESTS)


@pytest.mark.parametrize("name", ["", "Square", "../x", "a/b", "small-triangle"])
def test_a_name_that_cannot_be_one_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="name must be a-z, 0-9"):
        publish([tmp_path], name, tmp_path / "out")


def test_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run, out = finished(tmp_path, 0, 0.5), tmp_path / "out"
    options = ["--out", str(out), "--tests", "2"]
    monkeypatch.setattr(sys, "argv", ["pretrained", "square", str(run), *options])
    assert main() == 0
    assert capsys.readouterr().out == f"{out / 'square'}\n"
    monkeypatch.setattr(sys, "argv", ["pretrained", "square", str(tmp_path / "nowhere")])
    assert main() == 2
    assert "pretrained: cannot read" in capsys.readouterr().err
    out = run / "config.yaml"  # a file is in the way: seen before the run is read
    monkeypatch.setattr(sys, "argv", ["pretrained", "square", "nowhere", f"--out={out}"])
    assert main() == 2
    assert capsys.readouterr().err.startswith(f"pretrained: --out={out}/square/card.json cannot b")
