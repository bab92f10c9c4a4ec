"""No setting is ignored: each changes what is played or learned, or is refused with the reason."""

import ast
import hashlib
from collections.abc import Iterator
from contextlib import closing
from functools import cache
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tests.core.toy  # noqa: F401 - registers environments
from conf.commands import COMMANDS, GROUPS, declared, load
from conf.kinds import every_kind
from conf.settings import NESTED
from master.learn.trainer import Trainer
from tangram_agent.runs import beginning
from tangram_core.errors import TangramError
from tangram_core.run.service import ServiceConfig
from tangram_core.settings import declared_fields
from tangram_core.setup import Setup, make_setup
from tests.sim.builders import SEVEN
from worker.play.rollout import Rollout
from worker.play.session import Acting

pytestmark = pytest.mark.fast

ROOT = Path(__file__).parents[1]
Config = dict[str, dict[str, Any]]
ENVS, TURNS = 4, 2

# A small run of each kind, which the rows below change.
AGENT = {
    "batch_size": 4,
    "replay_capacity": 256,
    "learning_starts": 4,
    "updates_per_transition": 0.5,
    "uniform_share": 0.25,
}
ONE: Config = {
    "task": {"kind": "place"},
    "tokens": {"shapes": ["large_triangle"], "scale": 0.8},
    "sim": {"backend": "kinematic"},
    "reward": {},
    "agent": {"kind": "pair", **AGENT},
    "net": {"width": 8, "layers": 1, "feed_forward": 8},
}
SEVERAL: Config = ONE | {
    "tokens": {"shapes": ["large_triangle", "parallelogram"], "scale": 0.8},
    "sim": {"backend": "kinematic", "arena": 3.0},
}


def over(base: Config, **sections: dict[str, Any]) -> Config:
    return base | {name: base[name] | values for name, values in sections.items()}


PAPER = over(ONE, agent={"gamma": 0.9}, sim={"actions_per_token": 2})
MLP = ONE | {"net": {"kind": "mlp", "hidden": [8]}}
OUTLINES = over(
    SEVERAL,
    task={"kind": "fill"},
    sim={"observe": "silhouette", "starts": "outside", "allow_flip": True},
) | {"agent": {"kind": "outline", **AGENT, "learning_starts": 2}}
PHYSICS = over(ONE, sim={"backend": "physics"})
SEEN = over(ONE, sim={"pixels": 16, "arena": 1.2})
CAMERA = over(SEEN, reward={"source": "camera"})
NEAR = {"strategy": "near", "copies": 1, "position": 0.1, "angle": 0.1}
FINAL_TWICE = over(ONE, sim={"actions_per_token": 2}, agent={"hindsight": [{"strategy": "final"}]})
NEAR_ONE = over(ONE, agent={"hindsight": [NEAR]})

GOAL: Config = {
    "task": {"kind": "gym", "id": "Toy-v0", "imports": ["tests.core.toy"]},
    "agent": {
        "kind": "goal",
        "hidden": [8],
        "batch_size": 8,
        "learning_starts": 8,
        "replay_capacity": 256,
        "updates_per_transition": 0.1,
    },
}
SAC = over(GOAL, agent={"algorithm": "sac"})

PUSH: Config = {
    "task": {"kind": "push"},
    "tokens": {"shapes": ["square", "small_triangle"], "scale": 1.1},
    "agent": {
        "kind": "push",
        "width": 8,
        "batch_size": 64,
        "learning_starts": 8,
        "replay_capacity": 256,
        "updates_per_transition": 0.1,
        "looked_at": 8,
    },
}
PUSH_SEVEN = over(PUSH, tokens={"shapes": [*SEVEN], "scale": 0.6})

# Setting -> a run in which it has an effect, and another value.
SHOWS: dict[str, tuple[Config, object]] = {
    "tokens.shapes": (ONE, ["square"]),
    "tokens.scale": (ONE, 0.7),
    "sim.backend": (SEVERAL, "physics"),
    "sim.arena": (ONE, 2.5),
    "sim.actions_per_token": (ONE, 2),
    "sim.targets": (SEVERAL, "connected"),
    "sim.starts": (SEVERAL, "outside"),
    "sim.mirrored": (SEVERAL, 1.0),
    "sim.allow_flip": (SEVERAL, True),
    "sim.pixels": (CAMERA, 32),
    "sim.view": (over(CAMERA, sim={"pixels": 32}), 2.0),
    "sim.overhang": (ONE, True),
    "sim.observe": (SEEN, "pictures"),
    "reward.name": (ONE, "dense"),
    "reward.source": (SEEN, "camera"),
    "net.kind": (ONE | {"net": {}}, "mlp"),
    "net.hidden": (MLP, [9]),
    "net.width": (ONE, 16),
    "net.layers": (ONE, 2),
    "net.feed_forward": (ONE, 9),
    "net.rectified": (ONE, True),
    "net.init": (ONE, "authors"),
    "net.activation": (MLP, "tanh"),
    "agent.saturation_penalty": (over(ONE, agent={"kind": "scene"}), 9.0),
    "agent.flags": (over(ONE, agent={"kind": "scene"}), False),
    "agent.actor_tanh": (over(ONE, agent={"kind": "scene"}), 2),
    "agent.critic_tanh": (over(ONE, agent={"kind": "scene"}), True),
    "agent.noise_inside": (over(ONE, agent={"kind": "scene"}), True),
    "agent.reapply": (SEVERAL, 0),
    "agent.gamma": (PAPER, 0.5),
    "agent.polyak": (PAPER, 0.5),
    "agent.copies": (OUTLINES, 1),
    "agent.acting_average": (ONE, 0.0),
    "agent.actor_lr": (ONE, 1e-2),
    "agent.critic_lr": (ONE, 1e-2),
    "agent.lr_final": (ONE, 0.5),
    "agent.batch_size": (ONE, 5),
    "agent.replay_capacity": (ONE, 8),
    "agent.updates_per_transition": (ONE, 0.25),
    "agent.learning_starts": (ONE, 16),
    "agent.noise": (ONE, 0.2),
    "agent.uniform_share": (ONE, 1.0),
    "agent.algorithm": (GOAL, "ddpg"),
    "agent.hidden": (GOAL, [9]),
    "agent.learning_rate": (GOAL, 1e-2),
    "agent.relabel_share": (GOAL, 0.0),
    "agent.action_penalty": (GOAL, 1.0),
    "agent.actor_delay": (GOAL, 1),
    "agent.width": (PUSH, 9),
    "agent.looked_at": (PUSH, 64),
    "agent.tried": (PUSH, 64),
    "task.count": (PUSH, 1),
    "task.fewer": (PUSH, [1.0]),
    "task.within": (PUSH, 0.5),
    "task.turned": (over(PUSH, task={"within": 0.5}), 3.0),
    "task.finger": (PUSH, 0.1),
    "task.puzzle": (PUSH_SEVEN, ["cat"]),
    "task.longest": (PUSH, 1.0),
    "task.table_friction": (PUSH, [0.1, 0.2]),
    "task.spread": (PUSH, [4.0, 5.0]),
    "task.finger_friction": (PUSH, [1.0, 2.0]),
    "task.centre": (PUSH, 0.5),
    "agent.hindsight": (ONE, [{"strategy": "final"}]),
    "agent.hindsight.strategy": (FINAL_TWICE, "future"),
    "agent.hindsight.copies": (NEAR_ONE, 2),
    "agent.hindsight.position": (NEAR_ONE, 0.2),
    "agent.hindsight.angle": (NEAR_ONE, 0.2),
}
# What shows elsewhere, and where.
ELSEWHERE = {
    "agent.name": "the label of a run in reports",
    "task.id": "tests/tasks/test_gym.py: it is made, or refused by name",
    "task.imports": "tests/cluster/test_own_code.py: a module that is not there is named",
    "task.hand": "tests/tasks/test_push_shown.py: the arm pushes as the finger does",
    "task.pixels": "tests/tasks/test_push.py: what pictures show is near",
    "task.ends": "tests/core/test_conformance.py: a toy without ends",
    "task.fresh": "tests/core/test_conformance.py: a toy made anew",
    "reward.sha256": "tests/sim/test_rewards.py: another file is refused",
}


def changed(base: Config, name: str, value: object) -> Config:
    """A config with another value of a setting, or of the first entry of a list of them."""
    section, *inner, key = name.split(".")
    if not inner:
        return over(base, **{section: {key: value}})
    first, *others = base[section][inner[0]]
    return over(base, **{section: {inner[0]: [first | {key: value}, *others]}})


def steps_of(setup: Setup) -> Iterator[str]:
    """Digests of a short seeded run: of what is played, of what is learned, and so on."""
    trainer, acting = Trainer(setup, 0, "cpu"), Acting(setup.agent.actor(setup.task))
    with closing(setup.task.make(ENVS)) as env:
        acting.follow(trainer.weights())
        seen = env.reset([np.random.default_rng(i) for i in range(ENVS)])
        yield digest(acting.actor.act(seen, beginning(setup.spec, seen)))
        result = env.step(np.zeros((ENVS, setup.spec.action_size), np.float32))
        facts = env.facts()
        yield digest(result.rewards, np.array(facts.get("camera"), np.float64))
        rollout = Rollout(env, setup.spec, 0, "player", 0, 0)
        for turn in range(TURNS):
            acting.follow(trainer.weights())
            played = rollout.play(acting.actor.act)
            yield digest(*(played.arrays[name] for name in sorted(played.arrays)))
            trainer.insert(played)
            while trainer.rate_limiter.may_update():
                trainer.update(turn / TURNS)
            states = trainer.state()[0]
            yield digest(*(states[name][key] for name in states for key in sorted(states[name])))


def digest(*arrays: Any) -> str:
    content = hashlib.sha256()
    for array in arrays:
        content.update(repr(np.shape(array)).encode() + np.ascontiguousarray(array).tobytes())
    return content.hexdigest()


class Trace:
    """The steps of a run, with which many rows compare; it goes on as far as they look."""

    def __init__(self, setup: Setup) -> None:
        self._rest, self._seen = steps_of(setup), list[str]()

    def __iter__(self) -> Iterator[str]:
        yield from self._seen
        for step in self._rest:
            self._seen.append(step)
            yield step


@cache
def trace(config: str) -> Trace:
    return Trace(make_setup(ast.literal_eval(config)))


def differ(base: Config, other: Config) -> bool:
    """Whether two runs differ; they go on only until they do."""
    steps = zip_longest(trace(repr(base)), steps_of(make_setup(other)))
    return any(one != two for one, two in steps)


@pytest.mark.parametrize("name", SHOWS)
def test_a_setting_changes_a_run(name: str) -> None:
    base, value = SHOWS[name]
    assert differ(base, changed(base, name, value))


@pytest.mark.parametrize("base", [ONE, SEVERAL])
def test_an_equal_run_has_an_equal_trace(base: Config) -> None:
    assert not differ(base, base)


def test_every_setting_of_a_run_is_walked() -> None:
    groups = [(g, kinds.sections().get(g)) for g in GROUPS for kinds in every_kind(g)]
    groups += [(group, load(name)) for group, name in NESTED.items()]
    known = {f"{g}.{own.name}" for g, kind in groups if g != "service" for own in declared(kind)}
    assert SHOWS.keys() | ELSEWHERE.keys() == known
    assert not SHOWS.keys() & ELSEWHERE.keys()


# What the service and the tools are told


def read_names() -> set[str]:
    """Every attribute and text in the packages, but where settings are declared."""
    names: set[str] = set()
    for package in (
        "master",
        "worker",
        "tangram_agent",
        "tangram_core",
        "tangram_game",
        "tangram_lab",
        "tangram_tasks",
    ):
        for path in (ROOT / package).rglob("*.py"):
            if path.name in ("config.py", "commands.py"):
                continue
            for node in ast.walk(ast.parse(path.read_text("utf-8"))):
                if isinstance(node, ast.Attribute):
                    names.add(node.attr)
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    names.add(node.value)
    return names


def test_every_setting_of_a_command_is_read() -> None:
    owners = [*(load(name) for c in COMMANDS.values() for name in c.settings), ServiceConfig]
    assert {own.name for kind in owners for own in declared_fields(kind)} <= read_names()


# What could have no effect


@pytest.mark.parametrize(
    ("base", "name", "value", "because"),
    [
        (MLP, "net.width", 32, "net.kind=mlp"),
        (FINAL_TWICE, "agent.hindsight.position", 0.1, "agent.hindsight.strategy=final"),
        (over(ONE, sim={"observe": "silhouette"}), "sim.pixels", 64, "sim.observe=silhouette"),
    ],
)
def test_a_setting_without_effect_is_refused(
    base: Config, name: str, value: object, because: str
) -> None:
    with pytest.raises(TangramError, match=f"^{name}=.* changes nothing with {because}: leave it"):
        make_setup(changed(base, name, value))
