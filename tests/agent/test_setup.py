"""Settings: what is refused, in which words, and what a fingerprint covers."""

from pathlib import Path
from typing import Any

import pytest

from tangram_core.errors import ConfigError
from tangram_core.run.service import ServiceConfig
from tangram_core.setup import from_mapping, make_setup

pytestmark = pytest.mark.fast

BASE: dict[str, dict[str, Any]] = {
    "task": {"kind": "place"},
    "tokens": {"shapes": ["square"], "scale": 1.0},
    "sim": {},
    "reward": {},
    "agent": {"kind": "pair"},
    "net": {},
}


def changed(section: str, **values: Any) -> dict[str, dict[str, Any]]:
    return with_sections(BASE, {section: values})


def with_sections(config: dict[str, Any], more: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return config | {name: config[name] | own for name, own in more.items()}


@pytest.mark.parametrize(
    ("config", "reason"),
    [
        (changed("tokens", shapes="square"), "tokens.shapes must be a list, .* got 'square'"),
        (changed("net", hidden=3), "hidden must be a list, .* got 3"),
        (
            changed("tokens", shapes=[{"name": "x", "corners": [[0, 0], [1e200, 0], [0, 1e200]]}]),
            "corners must be finite and within",
        ),
        (changed("sim", arena="wide"), "^sim.arena must be a number, got wide$"),
        (changed("sim", pixels=1.5), "^sim.pixels must be a whole number, got 1.5$"),
        (changed("net", hidden=["a"]), "^net.hidden must be a list, each a whole number, got .a.$"),
        (changed("sim", speed=1), r"no setting sim\.speed: delete it; .* older version"),
        (changed("agent", gamma=1.5), "agent.gamma must be between 0 and 1, got 1.5"),
        (
            changed("agent", batch_size=10, replay_capacity=5),
            r"batch_size \(10\) must not exceed agent.replay_capacity \(5\)",
        ),
        (changed("agent", kind="x"), "agent.kind=x: .* choose from scene, pair, outline"),
        (changed("task", kind="x"), "task.kind=x: there is no such task: choose from place, fill"),
        (changed("task", odd=1), "there is no setting task.odd: delete it"),
        (changed("net", kind="cnn"), "net.kind must be one of mha, mlp, got 'cnn'"),
        (changed("net", width=65), "net.width must be a multiple of 4, got 65"),
        (changed("net", hidden=[]), "net.hidden must name at least one layer"),
        (BASE | {"sim": 3}, "the section sim must be a mapping, got 3"),
        ({n: BASE[n] for n in ("task", "tokens", "agent")}, "no section sim, reward, net"),
        (
            {"tokens": {}, "agent": {"kind": "pair"}},
            "names no task: .* task.kind; .*CHANGELOG",
        ),
        ({"task": {"kind": "place"}, "agent": {}}, "names no agent: it must have agent.kind"),
    ],
)
def test_wrong_settings_are_refused_in_clear_words(config: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        _ = make_setup(config).task.layout


@pytest.mark.parametrize(
    ("section", "values"),
    [
        ("tokens", {"scale": 2.0}),
        ("tokens", {"shapes": ["parallelogram"]}),
        ("sim", {"arena": 3.0}),
        ("reward", {"name": "dense"}),
        ("agent", {"gamma": 0.5}),
        ("net", {"layers": 2}),
    ],
)
def test_the_section_that_differs_is_named(section: str, values: dict[str, Any]) -> None:
    made, other = make_setup(BASE), make_setup(changed(section, **values))
    ours, theirs = made.fingerprints(), other.fingerprints()
    assert [name for name in ours if ours[name] != theirs[name]] == [section]
    assert make_setup(BASE).fingerprints() == ours
    assert made.differences(other.contents()) == other.differences(made.contents()) == [section]
    assert made.differences(make_setup(BASE).contents()) == []


def test_a_master_and_a_worker_with_different_reward_files_differ(tmp_path: Path) -> None:
    made = []
    for folder, content in (("one", "a = 1"), ("copy", "a = 1"), ("other", "a = 2")):
        path = tmp_path / folder / "own.py"
        path.parent.mkdir()
        path.write_text(content)
        made.append(make_setup(changed("reward", name=f"{path}:near")))
    one, copy, other = made
    assert one.fingerprints() == copy.fingerprints()
    assert one.fingerprints()["reward"] != other.fingerprints()["reward"]
    assert one.task_digest() != other.task_digest()
    assert one.differences(copy.contents()) == []
    assert one.differences(other.contents()) == ["reward"]


def test_settings_that_only_one_version_knows_do_not_differ() -> None:
    made = make_setup(BASE)
    older = made.contents()
    del older["agent"]["reapply"], older["agent"]["hindsight"][0]["angle"], older["reward"]
    assert made.differences(older | {"newer": {}}) == []
    assert made.differences(3) == ["agent", "net", "reward", "sim", "task", "tokens"]
    older["agent"]["hindsight"][0]["copies"] = 7
    assert made.differences(older) == ["agent"]
    older["agent"]["hindsight"] = []
    assert made.differences(older) == ["agent"]


def test_whole_numbers_are_welcome_as_floats() -> None:
    assert make_setup(changed("sim", arena=3)).task.sim.arena == 3.0


@pytest.mark.parametrize(
    ("shapes", "actions", "horizon", "action_size"),
    [(["square"], 1, 1, 3), (["square"], 3, 3, 3), (["square", "parallelogram"], 2, 4, 4)],
)
def test_sizes_follow_from_tokens_and_actions(
    shapes: list[str], actions: int, horizon: int, action_size: int
) -> None:
    config = changed("tokens", shapes=shapes) | {"sim": {"actions_per_token": actions}}
    made = make_setup(config)
    assert (made.task.spec.horizon, made.task.spec.action_size) == (horizon, action_size)


@pytest.mark.parametrize(
    ("envs", "horizon", "found"), [(0, 1, 16), (0, 8, 16), (0, 50, 2), (0, 999, 1), (5, 50, 5)]
)
def test_a_worker_plays_fewer_environments_the_longer_episodes_are(
    envs: int, horizon: int, found: int
) -> None:
    service = ServiceConfig(envs=envs)
    assert (service.envs_for(horizon), service.batch_episodes(horizon)) == (found, 2 * found)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("port", 65535, "service.port must be between 0 and 65534, got 65535"),
        ("bind", "h:1", "service.bind must be an address or a name of a machine, .* got 'h:1'"),
        ("http_bind", "", "service.http_bind must be an address or a name of a machine"),
        ("host", "tcp://h", "service.host must be an address or a name of a machine"),
    ],
)
def test_wrong_service_settings_are_refused(name: str, value: object, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        from_mapping(ServiceConfig, {"bind": "::1", name: value})


SEVERAL = {"shapes": ["square", "square"]}
ONE = {"shapes": ["square"]}
FUTURE = [{"strategy": "future"}]


@pytest.mark.parametrize(
    ("tokens", "sections", "reason"),
    [
        (
            SEVERAL,
            {"reward": {"name": "dense"}},
            "reward.name=dense changes nothing with 2 tokens.*set agent=paper agent.flags=true",
        ),
        (SEVERAL, {"reward": {"source": "camera"}}, "reward.source=camera changes nothing"),
        (
            SEVERAL,
            {"agent": {"gamma": 0.9}},
            "agent.gamma=0.9 .*agent=paper agent.flags=true, which values the",
        ),
        (SEVERAL, {"agent": {"hindsight": FUTURE}}, "strategy=future changes nothing"),
        (
            SEVERAL,
            {"agent": {"kind": "scene", "flags": False}},
            "flags=false with 2 tokens",
        ),
        (
            ONE,
            {"agent": {"replay_capacity": 64}, "sim": {"actions_per_token": 65}},
            "agent.replay_capacity must hold one episode, at least 65, got 64",
        ),
        (ONE, {"sim": {"mirrored": 0.5}}, "sim.mirrored=0.5 .* take a set with a parallelogram"),
    ],
)
def test_what_would_change_nothing_is_refused(
    tokens: dict[str, Any], sections: dict[str, Any], reason: str
) -> None:
    config = with_sections(changed("tokens", **tokens), sections)
    with pytest.raises(ConfigError, match=reason):
        make_setup(config)


@pytest.mark.parametrize(
    ("tokens", "sections"),
    [
        (SEVERAL, {"reward": {"name": "dense"}, "agent": {"kind": "scene"}}),
        (SEVERAL, {"agent": {"kind": "scene", "gamma": 0.9, "hindsight": FUTURE}}),
        (ONE, {"reward": {"name": "dense"}, "agent": {"gamma": 0.9, "polyak": 0.9}}),
        (ONE, {"reward": {"name": "dense"}, "agent": {"reapply": 0}}),
    ],
)
def test_what_has_an_effect_is_taken(tokens: dict[str, Any], sections: dict[str, Any]) -> None:
    make_setup(with_sections(changed("tokens", **tokens), sections))
