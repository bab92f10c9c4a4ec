"""Presets, overrides, help, and the entry of every command."""

import errno
import gc
import shlex
import sys
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import yaml
from hydra._internal.config_loader_impl import ConfigLoaderImpl

from conf.cli import composed, entry, with_run_config
from conf.commands import COMMANDS, GROUPS, OVER, Plain, laid_over
from conf.help import choices, group_help, help_text, setting_names
from conf.kinds import Kinds, kinds_of
from conf.settings import PAGE, page
from tangram_agent.agents.pair.agent import PairConfig
from tangram_agent.base.config import RelabelConfig
from tangram_core.errors import (
    ConfigError,
    FailedError,
    OwnCodeError,
    RunError,
    TangramError,
    UnavailableError,
)
from tangram_core.run.service import ServiceConfig
from tangram_core.settings import KEY, PLAY, declared_fields
from tangram_core.setup import Setup, from_mapping, make_setup
from tangram_sim.config import RewardConfig, SimConfig

pytestmark = pytest.mark.fast

WITH_GROUPS = ("train", "master", "worker")
PRESETS = [(group, name) for group in GROUPS for name in choices(group)]


def compose(primary: str, *overrides: str) -> dict[str, Any]:
    return composed(primary, overrides)


# Presets are what differs from the declarations


@pytest.mark.parametrize(("group", "name"), PRESETS)
def test_a_preset_sets_what_is_declared_and_differs(group: str, name: str) -> None:
    text = (files("conf") / group / f"{name}.yaml").read_text("utf-8")
    assert text.startswith("# ")
    made = compose("train", f"{group}={name}")[group]
    kinds = kinds_of([f"{group}={name}"])
    usual = COMMANDS["train"].sections(kinds)[group]
    written = yaml.safe_load(text) or {}
    own = written.get(group, written)  # of one for the whole config its own section
    for key in set(own) - {"defaults", "name", "kind", "backend"}:
        assert key in usual
        assert made[key] != usual[key], f"{group}={name} says {key} for nothing"


def test_what_is_not_given_is_as_the_tangram_agent_has_it() -> None:
    setup = make_setup(compose("train", "agent=tangram"))
    assert setup.agent.config == PairConfig()
    assert (setup.task.sim, setup.task.reward) == (SimConfig(), RewardConfig())
    assert from_mapping(ServiceConfig, compose("train")["service"]) == ServiceConfig()


@pytest.mark.parametrize("primary", WITH_GROUPS)
def test_primaries_with_groups_make_a_setup(primary: str) -> None:
    setup = make_setup(compose(primary))
    assert setup == make_setup(compose("train"))
    assert setup.task.layout.tokens == 1


@pytest.mark.parametrize(
    "name",
    [
        name
        for name in choices("tokens")
        if name not in ("pair", "hexagon") and not name.startswith("tangram")
    ],
)
def test_preset_of_each_shape_has_the_same_area(name: str) -> None:
    layout = make_setup(compose("train", f"tokens={name}")).task.layout
    assert [shape.name for shape in layout.shapes] == [name]
    assert layout.shapes[0].area == pytest.approx(0.16, abs=1e-12)


def test_presets_of_more_and_of_own_shapes() -> None:
    pair = make_setup(compose("train", "tokens=pair")).task.layout
    assert [shape.area for shape in pair.shapes] == pytest.approx([0.16, 0.16], abs=1e-12)
    (hexagon,) = make_setup(compose("train", "tokens=hexagon")).task.layout.shapes
    assert hexagon.area == pytest.approx(0.16, abs=1e-6)
    assert hexagon.symmetry == 6


# Agents bring their nets


@pytest.mark.parametrize(
    ("primary", "overrides", "net"),
    [
        ("train", (), "mha_narrow"),
        ("train", ("agent=tangram",), "mha_narrow"),
        ("train", ("agent=paper",), "mha"),
        *((primary, ("agent=mlp",), "mlp") for primary in WITH_GROUPS),
        ("train", ("agent=mlp", "net=mlp_large"), "mlp_large"),
        ("train", ("net=mlp_large", "agent=paper"), "mlp_large"),
    ],
)
def test_net_is_the_agents_unless_it_is_chosen(
    primary: str, overrides: tuple[str, ...], net: str
) -> None:
    expected = yaml.safe_load((files("conf") / "net" / f"{net}.yaml").read_text("utf-8"))
    assert compose(primary, *overrides)["net"] == COMMANDS["train"].sections()["net"] | expected


def test_pace_is_the_agents_unless_it_is_chosen() -> None:
    usual = compose("train", "agent=mlp", "service=local")["service"]
    assert from_mapping(ServiceConfig, usual) == ServiceConfig()


@pytest.mark.parametrize("name", ["paper", "mlp"])
def test_the_papers_presets_are_what_its_authors_ran(name: str) -> None:
    settings = compose("train", f"agent={name}", "sim=paper")
    setup, service = make_setup(settings), from_mapping(ServiceConfig, settings["service"])
    agent, sim, jobs = setup.agent.config, setup.task.sim, 16  # simulations of a worker's job
    assert (service.mode, service.batch_episodes(1)) == ("lockstep", jobs)
    assert agent.updates_per_transition * jobs == agent.actor_delay == 51
    assert (agent.learning_starts, agent.batch_size, agent.replay_capacity) == (jobs, 64, 12_500)
    assert (agent.actor_lr, agent.critic_lr, agent.lr_final) == (5e-4, 1e-3, 1.0)
    assert (agent.noise, agent.noise_inside, agent.uniform_share) == (0.1, True, 0.0)
    assert (agent.gamma, agent.polyak, agent.saturation_penalty) == (0.99, 0.999, 0.0)
    assert (agent.acting_average, agent.flags) == (0.0, False)
    assert agent.hindsight == (RelabelConfig("final"),)
    assert (sim.arena * sim.view, sim.pixels, sim.overhang) == (5.0, 200, True)
    twice = name == "mlp"
    assert (agent.actor_tanh, agent.critic_tanh) == (1 + twice, twice)
    assert (setup.agent.net.rectified, setup.agent.net.init == "authors") == (not twice,) * 2


# A run's config in place of the groups


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    path = tmp_path / "config.yaml"
    path.write_text(
        yaml.safe_dump(compose("train", "agent=mlp", "agent.flags=true", "tokens=pair", "seed=7"))
    )
    return path


def apply(path: Path, *overrides: str) -> dict[str, Any]:
    settings = compose("worker", "connect=tcp://127.0.0.1:1", f"from_config='{path}'", *overrides)
    return with_run_config(settings, overrides)


def test_run_config_replaces_the_groups(stored: Path) -> None:
    settings = apply(stored)
    setup: Setup = make_setup(settings)
    assert (setup.agent.config.name, setup.task.layout.tokens, setup.agent.net.kind) == (
        "mlp",
        2,
        "mlp",
    )
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
    deep: list[Any] = []
    for _ in range(900):
        deep = [deep]
    with pytest.raises(ConfigError, match="runs/shared is nested too deeply: it must come from a"):
        apply_stored([], content | {"sim": {"stages": deep}})
    with pytest.raises(ConfigError, match="runs/shared lacks net: it must come from a run"):
        apply_stored([], {name: value for name, value in content.items() if name != "net"})
    assert with_run_config(dict(settings), [], lambda _: None)["agent"]["name"] == "tangram"


@pytest.mark.parametrize("override", ["agent=paper", "tokens=square"])
def test_choosing_a_group_beside_a_run_config_is_refused(stored: Path, override: str) -> None:
    with pytest.raises(ConfigError, match="from_config=.* chooses"):
        apply(stored, override)


# A thousand million values, if they were written out; by << they are.
LAUGHS = b"a0: &a0 {b: 1}\n" + b"".join(
    b"a%d: &a%d {<<: [%s]}\n" % (i, i, b", ".join([b"*a%d" % (i - 1)] * 9)) for i in range(1, 10)
)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "No such file"),
        (b"a: [", "is not valid YAML \\(while parsing"),
        (b"[" * 10_000, "is too large for settings: it must have .* and 20 levels"),
        (LAUGHS, "is too large for settings: .* 10000 values with what aliases repeat"),
        (b"\xff\xfe\xfa", "is not UTF-8: save"),
        (b"3", "names no task: it must have task.kind"),
        (
            b"{task: {kind: place}, agent: {kind: pair}, net: {}}",
            "lacks tokens, sim, reward, service",
        ),
    ],
)
def test_wrong_run_config_is_refused(tmp_path: Path, content: bytes | None, message: str) -> None:
    path = tmp_path / "wrong.yaml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=message):
        apply(path)


# Help


@pytest.mark.parametrize("primary", COMMANDS)
def test_help_explains_every_setting_and_its_examples_compose(primary: str) -> None:
    text = help_text(primary)
    lines = text.splitlines()
    assert ("group=choice" in lines[0]) == bool(COMMANDS[primary].groups)
    for own in COMMANDS[primary].fields():
        (line,) = [line for line in lines if line.startswith(f"  {own.name}: ")]
        assert len(line.partition("  # ")[2]) > 5
    examples = [
        shlex.split(line, comments=True)
        for line in text.partition("Examples:")[2].strip().splitlines()
    ]
    assert len(examples) == 3
    for command, *overrides in examples:
        assert command == text.split()[0]
        compose(primary, *overrides)


@pytest.mark.parametrize("group", GROUPS)
def test_help_of_a_group_has_a_line_for_each_setting(group: str) -> None:
    lines = group_help("train", group).splitlines()
    assert lines[0] == f"{group}={'|'.join(choices(group))}"
    names = [line.partition(":")[0] for line in lines[2:]]
    section = Kinds().sections()[group]
    every = [] if section is None else declared_fields(section)
    assert names == [f"{group}.{own.name}" for own in every]


@pytest.mark.parametrize("group", OVER)
def test_help_of_what_is_laid_over_a_run_has_what_it_may_be_played_with(group: str) -> None:
    names = [line.partition(":")[0] for line in group_help("eval", group).splitlines()[2:]]
    kinds = {name: own.metadata[KEY].part for name, own in laid_over(group).items()}
    assert names == [f"{group}.{name}" for name, part in kinds.items() if part == PLAY]
    refused = {"sim": "sim.arena", "agent": "agent.batch_size"}.get(group)
    assert refused not in names


def test_settings_are_laid_over_a_run_one_by_one() -> None:
    made = compose("eval", "run_dir=x", "sim.actions_per_token=3", "agent.reapply=1")
    given = {f"{s}.{n}": v for s in OVER for n, v in made[s].items() if v is not None}
    assert given == {"sim.actions_per_token": 3, "agent.reapply": 1}
    with pytest.raises(ConfigError, match="did you mean 'sim.actions_per_token'"):
        compose("eval", "run_dir=x", "sim.actions_per_tokens=3")


def test_known_settings_are_those_that_compose() -> None:
    top = compose("train")
    dotted = {f"{group}.{key}" for group in GROUPS for key in top[group]}
    assert set(setting_names("train")) == set(top) | dotted


# Presets of one's own


@pytest.fixture
def presets(tmp_path: Path) -> Path:
    (tmp_path / "tokens").mkdir()
    mine = "shapes: [square, {name: bar, corners: [[0, 0], [2, 0], [2, 1], [0, 1]]}]\nscale: 0.5\n"
    (tmp_path / "tokens" / "mine.yaml").write_text(mine)
    return tmp_path


Entered = Callable[..., tuple[int, list[Plain]]]


@pytest.fixture
def entered(monkeypatch: pytest.MonkeyPatch) -> Entered:
    """Runs a command line; its status, and the settings that its task was given."""

    def run(line: str, task: Callable[[Plain], int] = lambda _: 0) -> tuple[int, list[Plain]]:
        command, *arguments = line.split()
        seen: list[Plain] = []
        monkeypatch.setattr(sys, "argv", [f"tangram-{command}", *arguments])
        monkeypatch.setenv("HYDRA_FULL_ERROR", "")  # restores what the entry sets
        return entry(command, lambda settings: seen.append(settings) or task(settings)), seen

    return run


@pytest.mark.parametrize("line", ["train seed=3", "train --cfg job", "train nosuch=1", "train -h"])
def test_collecting_of_garbage_is_on_in_a_task_and_after(entered: Entered, line: str) -> None:
    collects: list[bool] = []
    entered(line, lambda _: collects.append(gc.isenabled()) or 0)
    assert (gc.isenabled(), collects) == (True, [True] if line.endswith("3") else [])


def test_a_config_is_composed_once(entered: Entered) -> None:
    real = ConfigLoaderImpl.load_configuration
    with patch.object(ConfigLoaderImpl, real.__name__, autospec=True, side_effect=real) as loading:
        assert entered("train seed=3")[0] == 0
    assert loading.call_count == 1


@pytest.mark.parametrize("form", ["--config-dir {}", "--config-dir={}", "-cd {}"])
def test_presets_of_ones_own_are_taken(entered: Entered, presets: Path, form: str) -> None:
    status, [settings] = entered(f"train tokens=mine {form.format(presets)} seed=3")
    assert (status, settings["seed"]) == (0, 3)
    assert [shape.name for shape in make_setup(settings).task.layout.shapes] == ["square", "bar"]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("tokens/mine.yaml", "scale: 1\n", "set tokens.shapes=..., it has no default"),
        ("tokens/mine.yaml", "shapes: [", "/tokens/mine.yaml cannot be read (while parsing"),
        ("tokens/mine.yaml", "&a [*a]", "/tokens/mine.yaml is too large for settings: it must"),
        ("tokens/mine.yaml", "x" * 100_001, "it must have at most 100000 characters"),
        (
            "tokens/mine.yaml",
            "3",
            "/tokens/mine.yaml cannot be read (Invalid loaded object type: i",
        ),
        (
            "tokens/mine.yaml",
            "",
            "/tokens/mine.yaml sets nothing: write settings as in name: value",
        ),
        ("tokens/mine.yaml", "[a]", "/tokens/mine.yaml sets nothing"),
        ("tokens/mine.yaml", "[" * 10_000, "/tokens/mine.yaml is too large for settings: it must"),
        (
            "tokens/mine.yaml",
            LAUGHS.decode(),
            "/tokens/mine.yaml is too large for settings: it must",
        ),
        ("tokens/square.yaml", "scale: 1\n", "has the name of a preset that comes with tangram-rl"),
    ],
)
def test_wrong_presets_of_ones_own_are_refused(
    entered: Entered,
    capsys: pytest.CaptureFixture[str],
    presets: Path,
    name: str,
    content: str,
    message: str,
) -> None:
    (presets / name).write_text(content)
    assert entered(f"train tokens=mine --config-dir {presets}") == (2, [])
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_help_names_presets_of_ones_own(
    entered: Entered, capsys: pytest.CaptureFixture[str], presets: Path
) -> None:
    assert entered(f"train --help --config-dir {presets}") == (0, [])
    assert "medium_triangle, mine, pair" in capsys.readouterr().out.replace("\n           ", " ")


def test_help_of_a_task_is_that_of_its_agent(
    entered: Entered, capsys: pytest.CaptureFixture[str]
) -> None:
    assert entered("train task=push --help agent") == (0, [])
    assert "agent.looked_at: 96" in capsys.readouterr().out


# The entry of every command


def test_entry_hands_over_plain_settings(entered: Entered) -> None:
    status, [settings] = entered("eval run_dir=x seed=3", lambda _: 5)
    assert status == 5
    assert type(settings) is dict
    assert settings == (
        {"run_dir": "x", "episodes": 100, "seed": 3, "rivals": ["all"], "turns": 1}
        | dict.fromkeys(("out", "puzzle"))
        | {group: dict.fromkeys(laid_over(group)) for group in OVER}
    )


def test_entry_runs_once_for_each_value_and_the_jobs_of_a_sweep_have_a_folder_each(
    entered: Entered, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    status, seen = entered("eval run_dir=x -m seed=1,2,3 out=y", lambda one: one["seed"] % 3)
    assert (status, [one["seed"] for one in seen]) == (2, [1, 2, 3])
    status, seen = entered("train -m seed=1,2 run_dir=runs")
    assert (status, [one["run_dir"] for one in seen]) == (0, ["runs/0", "runs/1"])


ROOM = "make room or choose a folder that you may write to"
LOWER = "lower agent.replay_capacity, agent.batch_size or service.envs"


@pytest.mark.parametrize(
    ("raised", "status", "line"),
    [
        (TangramError("port 5 is too large"), 2, "port 5 is too large"),
        (UnavailableError("port 5 is taken"), 75, "port 5 is taken"),
        (FailedError("it diverged"), 1, "it diverged"),
        (MemoryError("4 GiB"), 75, f"not enough memory (4 GiB): {LOWER}"),
        *(
            (OSError(getattr(errno, name), "no", "/x"), status, f"cannot use /x (no): {ROOM}")
            for status, names in {
                75: (
                    "ENOSPC",
                    "EDQUOT",
                    "EIO",
                    "EROFS",
                    "ESTALE",
                    "ENOMEM",
                    "EMFILE",
                    "EADDRINUSE",
                ),
                2: ("EACCES", "ENOENT", "EADDRNOTAVAIL"),
            }.items()
            for name in names
        ),
    ],
)
def test_entry_turns_errors_into_a_line_and_a_status(
    entered: Entered,
    capsys: pytest.CaptureFixture[str],
    raised: BaseException,
    status: int,
    line: str,
) -> None:
    def task(settings: Plain) -> int:
        raise raised

    assert entered("eval run_dir=x", task)[0] == status
    assert capsys.readouterr() == ("", f"tangram-eval: {line}\n" if line else "")


@pytest.mark.parametrize(
    ("number", "kind", "status"),
    [
        (errno.ENOSPC, ConfigError, 75),
        (errno.EACCES, ConfigError, 2),
        (errno.ENOSPC, OwnCodeError, 2),
    ],
)
def test_an_error_that_was_made_of_another_has_the_status_of_that(
    entered: Entered, number: int, kind: type[TangramError], status: int
) -> None:
    """Not where code of the user's own says so; nor for ever where one names itself."""

    def task(settings: Plain) -> int:
        try:
            try:
                raise OSError(number, "no")
            except OSError:
                raise RunError("cannot write") from None
        except RunError as error:
            error.__cause__ = error if status == 2 else error.__cause__
            raise kind("it failed") from error

    assert entered("eval run_dir=x", task)[0] == status


def test_entry_does_not_hide_a_fault_of_ours(entered: Entered) -> None:
    with pytest.raises(ZeroDivisionError):
        entered("eval run_dir=x", lambda settings: 1 // 0)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("train --config-dir nowhere", "--config-dir: there is no folder"),
        ("train --config-dir", "--config-dir takes one folder"),
        ("train tokens=[square,square]", "write tokens.shapes=[square,square]"),
        ("train from_config=3", "from_config must be the path of a run's config.yaml, got 3"),
        ("train -m agent=goal,push", "agent=goal,push: a sweep takes presets of one kind: start"),
        ("train +sim.arena=3 task=push", "sim.arena is no setting of task=push: leave it out"),
        ("train =3", "cannot read '=3': write name=value"),
        ("train ~agent.noise", "'~agent.noise': a setting cannot be removed, write agent.noise"),
        ("train tokens=3", "a config group takes the name of a preset, not a number"),
        (f"train seed={'[' * 3000}{']' * 3000}", "nested too deeply: write fewer brackets"),
        ("eval run_dir=x sim=kinematic", "sim=kinematic chooses a preset, but a trained run has"),
        ("eval run_dir=x tokens=square", "unknown setting 'tokens' (a trained run keeps its own)"),
        ("eval run_dir=x task.kind=place", "unknown setting 'task.kind' ("),
        ("train seed=\x1b[1m", "cannot read 'seed=\\x1b[1m': write name=value"),
        ("train sim=[physics,kinematic]", "sim takes one preset, got [physics,kinematic]"),
        ("eval run_dir=x -seed=3", "settings have no dashes, as in seed=3; --help lists them"),
    ],
)
def test_what_would_be_taken_for_something_else_is_refused(
    entered: Entered,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    line: str,
    message: str,
) -> None:
    assert entered(line) == (2, [])
    assert message in capsys.readouterr().err


# The page of all settings


def test_the_page_of_settings_is_up_to_date() -> None:
    assert PAGE.read_text("utf-8") == page(), "run: python -m conf.settings"
