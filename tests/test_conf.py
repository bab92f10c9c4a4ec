"""Config groups, presets, overrides and help."""

import dataclasses
import re
import sys
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import hydra
import pytest
import yaml
from omegaconf import OmegaConf

from conf.cli import entry, with_run_config
from conf.help import Plain, choices, group_defaults, help_text, setting_names
from conf.names import hidden, revealed
from conf.sweep import check_launcher, refuse_lost_job
from master.config import LaunchConfig, MasterConfig
from tangram_agent.config import AgentConfig, NetConfig, RelabelConfig, ServiceConfig
from tangram_agent.setup import SECTIONS, Setup, from_mapping, make_setup
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.errors import ConfigError, TangramError
from tangram_sim.layout import TokensConfig
from worker.config import EvalConfig, PlayConfig, StatusConfig, WorkerConfig

pytestmark = pytest.mark.fast

GROUPS = {
    "tokens": TokensConfig,
    "sim": SimConfig,
    "reward": RewardConfig,
    "net": NetConfig,
    "agent": AgentConfig,
    "service": ServiceConfig,
}
PRIMARIES = ("train", "master", "worker", "status", "eval", "play", "experiments", "report")
WITH_GROUPS = ("train", "master", "worker")
PRESETS = [(group, name) for group in GROUPS for name in choices(group)]


def compose(primary: str, *overrides: str) -> dict[str, Any]:
    with hydra.initialize_config_module("conf", version_base="1.3"):
        config = hydra.compose(primary, hidden(overrides, primary))
    plain = OmegaConf.to_container(config)
    assert isinstance(plain, dict)
    return revealed({str(name): value for name, value in plain.items()}, primary)


def field_names(kind: Any) -> set[str]:
    return {field.name for field in dataclasses.fields(kind)}


# Config and dataclasses say the same


@pytest.mark.parametrize(("group", "name"), PRESETS)
def test_preset_writes_out_every_field(group: str, name: str) -> None:
    section = compose("train", f"{group}={name}")[group]
    assert set(section) == field_names(GROUPS[group])
    from_mapping(GROUPS[group], section)


def test_what_is_not_given_is_as_the_tangram_agent_has_it() -> None:
    setup = make_setup(compose("train", "agent=tangram"))
    assert setup.agent == AgentConfig()
    assert (setup.sim, setup.reward) == (SimConfig(), RewardConfig())
    assert from_mapping(ServiceConfig, compose("train")["service"]) == ServiceConfig()
    assert make_setup(compose("train", "agent=paper")).net == NetConfig()


@pytest.mark.parametrize("name", choices("agent"))
def test_first_twin_of_a_preset_writes_out_every_field(name: str) -> None:
    twins = compose("train", f"agent={name}")["agent"]["hindsight"]
    assert set(twins[0]) == field_names(RelabelConfig)


@pytest.mark.parametrize(
    ("primary", "kinds", "extra"),
    [
        ("train", (LaunchConfig, MasterConfig), {"master"}),
        ("master", (MasterConfig,), set()),
        ("worker", (WorkerConfig,), set()),
        ("status", (StatusConfig,), set()),
        ("eval", (EvalConfig,), set()),
        ("play", (PlayConfig,), set()),
    ],
)
def test_primary_has_every_field(primary: str, kinds: tuple[Any, ...], extra: set[str]) -> None:
    groups = SECTIONS if primary in WITH_GROUPS else ()
    names = set(compose(primary)) - set(groups) - {"from_config"}
    assert names == set().union(*map(field_names, kinds)) - extra


@pytest.mark.parametrize("primary", WITH_GROUPS)
def test_primaries_with_groups_make_a_setup(primary: str) -> None:
    setup = make_setup(compose(primary))
    assert setup == make_setup(compose("train"))
    assert setup.layout.tokens == 1


@pytest.mark.parametrize(("group", "name"), PRESETS)
def test_preset_says_what_it_is_for(group: str, name: str) -> None:
    text = (files("conf") / group / f"{name}.yaml").read_text("utf-8")
    assert text.startswith("# ")


@pytest.mark.parametrize(
    "name",
    [
        name
        for name in choices("tokens")
        if name not in ("pair", "hexagon") and not name.startswith("tangram")
    ],
)
def test_preset_of_each_shape_has_the_same_area(name: str) -> None:
    layout = make_setup(compose("train", f"tokens={name}")).layout
    assert [shape.name for shape in layout.shapes] == [name]
    assert layout.shapes[0].area == pytest.approx(0.16, abs=1e-12)


def test_presets_of_more_and_of_own_shapes() -> None:
    pair = make_setup(compose("train", "tokens=pair")).layout
    assert [shape.area for shape in pair.shapes] == pytest.approx([0.16, 0.16], abs=1e-12)
    (hexagon,) = make_setup(compose("train", "tokens=hexagon")).layout.shapes
    assert hexagon.area == pytest.approx(0.16, abs=1e-6)
    assert hexagon.symmetry == 6


# Agents bring their nets


@pytest.mark.parametrize(
    ("overrides", "net"),
    [
        ((), "mha_narrow"),
        (("agent=tangram",), "mha_narrow"),
        (("agent=paper",), "mha"),
        (("agent=mlp",), "mlp"),
        (("agent=mlp", "net=mlp_large"), "mlp_large"),
        (("net=mlp_large", "agent=paper"), "mlp_large"),
    ],
)
@pytest.mark.parametrize("primary", WITH_GROUPS)
def test_net_is_the_agents_unless_it_is_chosen(
    primary: str, overrides: tuple[str, ...], net: str
) -> None:
    expected = yaml.safe_load((files("conf") / "net" / f"{net}.yaml").read_text("utf-8"))
    assert compose(primary, *overrides)["net"] == expected


@pytest.mark.parametrize("name", ["paper", "mlp"])
def test_where_the_paper_is_silent_its_presets_follow_the_hindsight_paper(name: str) -> None:
    """Values of the appendix of [16]."""
    agent = make_setup(compose("train", f"agent={name}")).agent
    assert (agent.saturation_penalty, agent.saturation_limit) == (1.0, 0.0)
    assert (agent.noise, agent.uniform_share) == (0.1, 0.2)
    assert (agent.gamma, agent.polyak, agent.batch_size) == (0.98, 0.95, 128)
    assert agent.actor_lr == agent.critic_lr == 1e-3


@pytest.mark.parametrize("name", ["paper", "mlp"])
def test_paper_presets_add_nothing_to_the_text(name: str) -> None:
    agent = make_setup(compose("train", f"agent={name}")).agent
    assert not any((agent.egocentric, agent.offsets, agent.orientation, agent.afterstate))
    assert (agent.angle_head, agent.squash, agent.lr_decay) == ("plain", "tanh", "none")
    assert (agent.edges, agent.grad_clip, agent.acting_average) == ("paper", 0.0, 0.0)
    assert [twin.strategy for twin in agent.hindsight] == ["final"]


# A run's config in place of the groups


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(compose("train", "agent=mlp", "tokens=pair", "seed=7")))
    return path


def apply(path: Path, *overrides: str) -> dict[str, Any]:
    settings = compose("worker", "connect=tcp://127.0.0.1:1", f"from_config='{path}'", *overrides)
    return with_run_config(settings, overrides)


def test_run_config_replaces_the_groups(stored: Path) -> None:
    settings = apply(stored)
    setup: Setup = make_setup(settings)
    assert (setup.agent.name, setup.layout.tokens, setup.net.kind) == ("mlp", 2, "mlp")
    assert "from_config" not in settings
    assert "seed" not in settings


def test_single_values_still_override_a_run_config(stored: Path) -> None:
    settings = apply(stored, "service.envs=7", "agent.hindsight.0.copies=3")
    assert settings["service"]["envs"] == 7
    assert settings["agent"]["hindsight"][0]["copies"] == 3
    assert settings["agent"]["name"] == "mlp"


def test_a_command_may_know_other_places_of_a_run_config(stored: Path) -> None:
    content = yaml.safe_load(stored.read_text())
    settings = compose("worker", "connect=runs/shared", "service.envs=7")

    def apply_stored(overrides: list[str], content: dict[str, Any] = content) -> dict[str, Any]:
        return with_run_config(dict(settings), overrides, lambda given: (given["connect"], content))

    made = apply_stored(["service.envs=7"])
    assert (made["agent"]["name"], made["service"]["envs"], "seed" in made) == ("mlp", 7, False)
    with pytest.raises(ConfigError, match="runs/shared chooses tokens already: leave out tokens=x"):
        apply_stored(["tokens=x"])
    with pytest.raises(ConfigError, match="runs/shared lacks net: it must come from a run"):
        apply_stored([], {name: value for name, value in content.items() if name != "net"})
    assert with_run_config(dict(settings), [], lambda _: None)["agent"]["name"] == "tangram"


@pytest.mark.parametrize("override", ["agent=paper", "~agent.noise", "tokens=square"])
def test_choosing_a_group_beside_a_run_config_is_refused(stored: Path, override: str) -> None:
    with pytest.raises(ConfigError, match="from_config=.* chooses"):
        apply(stored, override)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "No such file"),
        (b"a: [", "not a YAML file"),
        (b"\xff\xfe\xfa", "not a YAML file"),
        (b"3", "lacks sim"),
        (b"{agent: {}, net: {}}", "lacks sim, reward, service, tokens"),
    ],
)
def test_wrong_run_config_is_refused(tmp_path: Path, content: bytes | None, message: str) -> None:
    path = tmp_path / "wrong.yaml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=message):
        apply(path)


# A setting that is called like a group


@pytest.mark.parametrize(
    ("given", "name"), [("tangram7", "tangram7"), ("no_preset", "no_preset"), ("null", None)]
)
def test_tokens_of_a_command_without_groups_are_a_name(given: str, name: str | None) -> None:
    settings = compose("play", f"tokens={given}", "out=a.gif")
    assert (settings["tokens"], settings["out"]) == (name, "a.gif")
    assert compose("play")["tokens"] is None
    assert hidden(["tokens=square", "seed=1"], "train") == ["tokens=square", "seed=1"]


# Help


@pytest.mark.parametrize("primary", PRIMARIES)
def test_examples_of_the_help_compose(primary: str) -> None:
    text = help_text(primary)
    examples = [line.split() for line in text.partition("Examples:")[2].strip().splitlines()]
    assert len(examples) == 3
    for command, *overrides in examples:
        assert command == text.split()[0]
        compose(primary, *overrides)


@pytest.mark.parametrize("primary", PRIMARIES)
def test_help_explains_every_setting(primary: str) -> None:
    lines = help_text(primary).splitlines()
    inside = {"families", "trainings", "tests", "experiments"}  # of the catalogue
    for name in set(compose(primary)) - set(group_defaults(primary)) - inside:
        (line,) = [line for line in lines if line.startswith(f"  {name}: ")]
        assert "  # " in line


def test_known_settings_are_those_that_compose() -> None:
    names = set(setting_names("train"))
    top = compose("train")
    dotted = {f"{group}.{key}" for group in GROUPS for key in top[group]}
    assert names == set(top) | dotted


# The entry of every command


def start(monkeypatch: pytest.MonkeyPatch, task: Callable[[Plain], int], *overrides: str) -> int:
    monkeypatch.setattr(sys, "argv", ["tangram-eval", "run_dir=x", *overrides])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "")  # restores what the entry sets
    return entry("eval", task)


def test_entry_hands_over_plain_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Plain] = []
    assert start(monkeypatch, lambda settings: seen.append(settings) or 5, "seed=3") == 5
    assert seen == [
        {"run_dir": "x", "episodes": 100, "seed": 3, "turns": 1, "skip_invalid": False}
        | dict.fromkeys(("out", "actions", "corner_noise", "puzzles", "sheet"))
        | dict.fromkeys(("order", "reapply", "refine_steps", "push_weight"))
    ]
    assert type(seen[0]) is dict


def test_entry_runs_once_for_each_value(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    seeds: list[int] = []
    status = start(
        monkeypatch, lambda s: seeds.append(s["seed"]) or s["seed"] % 3, "-m", "seed=1,2,3", "out=y"
    )
    assert (seeds, status) == ([1, 2, 3], 2)


@pytest.mark.parametrize(
    ("raised", "status", "line"),
    [
        (TangramError("port 5 is taken"), 2, "tangram-eval: port 5 is taken\n"),
        (KeyboardInterrupt(), 130, ""),
    ],
)
def test_entry_turns_errors_into_a_line_and_a_status(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    raised: BaseException,
    status: int,
    line: str,
) -> None:
    def task(settings: Plain) -> int:
        raise raised

    assert start(monkeypatch, task) == status
    assert capsys.readouterr() == ("", line)


def test_entry_does_not_hide_a_fault_of_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ZeroDivisionError):
        start(monkeypatch, lambda settings: 1 // 0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["hydra/launcher=submitit_slurm"], "is for the jobs of a sweep: add --multirun"),
        (["-m", "hydra/launcher=submitit_slurm"], "needs a plugin: pip install 'tangram-rl.slurm"),
    ],
)
def test_a_launcher_that_cannot_work_is_refused(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.setattr("conf.sweep.find_spec", lambda name: None)
    assert start(monkeypatch, lambda settings: 0, *arguments) == 2
    assert re.search(message, capsys.readouterr().err)


def test_slurm_is_asked_for_only_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("conf.sweep.find_spec", lambda name: name)
    check_launcher(["-m", "hydra/launcher=basic"])
    monkeypatch.setattr("shutil.which", lambda name: None)
    check_launcher(["-m", "hydra/launcher=submitit_local"])
    with pytest.raises(ConfigError, match="needs SLURM, and there is no srun"):
        check_launcher(["-m", "hydra/launcher=submitit_slurm"])
    monkeypatch.setattr("shutil.which", lambda name: "/usr/bin/srun")
    check_launcher(["-m", "hydra/launcher=submitit_slurm"])


def test_a_lost_job_of_a_sweep_is_told_in_one_line() -> None:
    lost = type("UncompletedJobError", (Exception,), {"__module__": "submitit.core.utils"})
    with pytest.raises(TangramError, match="was lost .Job 3 has no output.; the same command"):
        refuse_lost_job(lost("Job 3\nhas no output\n----\nmany lines"))
    refuse_lost_job(ZeroDivisionError())
