"""The model of contacts: as the engine pushes, read with every byte checked, and its bounds."""

import shutil
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tangram_agent import contacts
from tangram_agent.contacts import Contacts, ContactWorlds, known_contacts
from tangram_agent.coverage import Lying
from tangram_agent.foresight import EngineWorlds, Table
from tangram_agent.policy import Policy
from tangram_agent.pretrained import CARD, CONFIG, CONTACTS, PACKAGED, WEIGHTS, agent_names
from tangram_agent.setup import Setup
from tangram_lab.experiments.contacts import main, play, publish
from tangram_sim.batch import BatchedEnv
from tangram_sim.errors import ConfigError, RunError
from tangram_sim.kinematics import wrap
from tests.agent.builders import NAN, ZERO, setup, with_weights
from tests.agent.pair_scenes import PERCEPTRON, SEVEN, TWO, seven

pytestmark = pytest.mark.fast

SLIDE = {"backend": "physics", "motion": "slide"}
LEARNED = {"lookahead": "learned", "beam": 2}


def ahead(tokens: dict[str, Any] = SEVEN, mode: str = "learned", **sim: Any) -> Setup:
    return setup(tokens, {"lookahead": mode}, PERCEPTRON, **SLIDE | sim)


def known(made: Setup) -> Contacts:
    contacts = known_contacts(made)
    assert contacts is not None
    return contacts


def test_a_fresh_push_ends_as_in_the_engine() -> None:
    errors, pushed = [], []
    for movers, way, others, moved in islice(play(500, seed=1), 6):
        poses, none = np.stack([movers.pose, others.pose], 1), np.zeros(2, bool)
        worlds = ContactWorlds(Contacts(np.array([movers.index[0], others.index[0]])))
        scenes = Table(poses, none, poses[0], none)
        off = worlds.slid(scenes, np.zeros(len(way), np.int64), way)[:, 1] - others.pose - moved
        off[:, 2] = wrap(off[:, 2])
        counts = ~movers.flipped & ~others.flipped & (np.abs(moved).max(axis=1) > 1e-3)
        errors.append(np.abs(off)[counts])
        pushed.append(np.abs(moved)[counts])
    error, far = np.median(np.concatenate(errors), 0), np.median(np.concatenate(pushed), 0)
    assert sum(map(len, errors)) > 50
    assert (error < (0.002, 0.002, 0.01)).all()
    assert (error < 0.3 * far).all()


def lined_up(made: Setup) -> Table:
    """Squares in a row, a gap between them, and one from the left comes onto all."""
    poses = np.array([[(-0.5, 0.0, 0.0), (0.0, 0.01, 0.0), (0.25, -0.01, 0.0)]])
    return Table(poses, np.zeros(3, bool), poses[0], np.zeros(3, bool))


def test_what_is_pushed_pushes_a_third_one_as_in_the_engine() -> None:
    made = ahead({"shapes": ["square"] * 3, "scale": 0.6})
    table, token, way = lined_up(made), np.array([0]), np.array([[0.5, 0.0, 0.0]])
    learned = ContactWorlds(known(made)).slid(table, token, way)
    engine = EngineWorlds(made.layout, made.sim).slid(table, token, way)
    assert engine[0, 2, 0] > 0.35  # it was pushed by the second one
    np.testing.assert_allclose(learned[0, :, :2], engine[0, :, :2], atol=0.03)
    np.testing.assert_array_equal(table.poses, lined_up(made).poses)


def test_scenes_do_not_depend_on_those_beside_them() -> None:
    made = ahead({"shapes": ["square"] * 3, "scale": 0.6})
    worlds, table = ContactWorlds(known(made)), lined_up(made)
    token = np.array([0, 1, 2])
    way = np.array([[0.5, 0.0, 0.0], [0.0, 1.5, 1.0], [-0.2, 0.0, 0.3]])
    three = Table(np.repeat(table.poses, 3, 0), *list(vars(table).values())[1:])
    together = worlds.slid(three, token, way)
    for b in range(3):
        alone = worlds.slid(table, token[b : b + 1], way[b : b + 1])
        np.testing.assert_allclose(together[b], alone[0], atol=1e-5)
        np.testing.assert_allclose(together[b, b], table.poses[0, b] + way[b])


def test_what_a_way_pushes_off_a_piece_is_foreseen() -> None:
    contacts, none = Contacts(np.array([3, 0])), np.zeros(2, bool)
    start = np.array([(-0.7, 0.0, 0.0), (-0.7, 0.0, 0.0)])
    movers = Lying(np.array([3, 3]), start, none)
    pieces = Lying(np.array([3, 0]), np.array([(0.0, 0.0, 0.0), (0.6, 0.5, 0.0)]), none)
    ends = np.array([(0.3, 0.0, 0.0), (-0.7, 0.6, 0.0)])
    pushed = contacts.pushed(movers, ends, pieces)
    assert pushed[0, 0] == 1.0
    assert not pushed[0, 1]
    assert not pushed[1].any()
    part = contacts.pushed(movers, np.array([(-0.18, 0.0, 0.0)] * 2), pieces)
    assert 0.0 < part[0, 0] < 0.5


def test_a_plan_is_the_same_each_time_and_needs_no_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    made = seven(LEARNED, PERCEPTRON, starts="outside", **SLIDE)
    with closing(BatchedEnv(made.layout, made.sim, made.reward)) as env:
        env.reset([np.random.default_rng(3)])
        corners, placed, goals = env.corners, env.placed, env.goals
    monkeypatch.setattr(contacts, "EngineWorlds", None)
    first, second = Policy(made), Policy(made)
    second.load(first.weights())
    actions = [policy.act(corners, placed, goals) for policy in (first, second)]
    np.testing.assert_array_equal(*actions)


@pytest.mark.parametrize(
    ("tokens", "sim", "reason"),
    [
        (SEVEN, {"friction": 0.5}, "learned with sim.friction=0.2, got 0.5: set agent.lookahead="),
        (
            SEVEN,
            {"substeps": 16},
            "learned with sim.substeps=8, got 16: set agent.lookahead=engine",
        ),
        (SEVEN, {"arena": 3.0}, "learned with sim.arena=2, got 3"),
        (TWO, {}, "learned with the tans at tokens.scale=0.6, got another square: set agent.look"),
        (
            {
                "shapes": ["square", {"name": "b", "corners": [[0, 0], [1, 0], [0, 1]]}],
                "scale": 0.6,
            },
            {},
            "got another b: set agent.lookahead=engine",
        ),
    ],
)
def test_what_it_was_not_learned_for_is_refused(
    tokens: dict[str, Any], sim: dict[str, Any], reason: str
) -> None:
    with pytest.raises(ConfigError, match=reason):
        Policy(ahead(tokens, **sim))
    Policy(ahead(tokens, "engine", **sim))  # guided by the critic's second head
    assert known_contacts(ahead(tokens, "engine", **sim)) is None


@pytest.mark.parametrize(
    ("harm", "reason"),
    [
        (lambda model: (model / WEIGHTS).write_bytes(b"x"), "checksum of weights.safetensors"),
        (lambda model: (model / WEIGHTS).unlink(), "is damaged .*: install tangram-rl again"),
        (lambda model: (model / CARD).write_text("{"), "cannot be read"),
        (lambda model: (model / CONFIG).write_text("push: 1"), "learned by another version: inst"),
        (lambda model: (model / CONFIG).write_text("a: [1"), "not valid YAML"),
        (lambda model: with_weights(model, NAN), "'a' is not finite.: install tangram-rl again"),
        (lambda model: with_weights(model, ZERO), "learned by another version: install tangram"),
    ],
)
def test_a_damaged_model_is_refused(tmp_path: Path, harm: Any, reason: str) -> None:
    shutil.copytree(str(PACKAGED / CONTACTS), tmp_path / "model")
    harm(tmp_path / "model")
    with pytest.raises((RunError, ConfigError), match=f"^pretrained/contacts.*{reason}") as caught:
        Contacts(np.arange(5), tmp_path / "model")
    assert "\n" not in str(caught.value)


def test_it_is_made_by_one_command_and_is_no_agent(tmp_path: Path) -> None:
    card = publish(tmp_path / "model", pushes=100, updates=2)
    assert card["pushes"] == 100
    assert card["learned_from"] + card["tested_on"] <= 100
    assert "No agent" in (tmp_path / "model" / "card.md").read_text()
    assert Contacts(np.arange(5), tmp_path / "model").kinds.shape == (5,)
    assert CONTACTS not in agent_names()


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ("--pushes=24", "--pushes must be at least 100"),
        ("--pushes=-5", "--pushes must be at least 100"),
        ("--updates=0", "--updates must be at least 1"),
        (f"--out={__file__}", f"--out={__file__}/card.json cannot be written"),
    ],
)
def test_a_model_of_nothing_or_for_nowhere_is_not_made(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], given: str, reason: str
) -> None:
    monkeypatch.setattr("tangram_lab.experiments.contacts.make", None)
    monkeypatch.setattr("sys.argv", ["contacts", given])
    assert main() == 2
    assert capsys.readouterr().err.startswith(f"contacts: {reason}")
