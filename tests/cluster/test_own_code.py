"""Tasks and agents of the user's own: files that a command line names, and other packages'."""

import hashlib
import json
import os
import shutil
from contextlib import ExitStack
from pathlib import Path

import pytest
import yaml

from conf.cli import composed
from tangram_core.errors import ConfigError
from tangram_core.registry import find_agent, find_task, load_own
from tangram_core.run.code import code_of, override
from tests.cluster.processes import LIMIT_S, refused, run, run_here, started, wait_for_file
from tests.cluster.test_cli import READ
from tests.core.examples import EXAMPLES

pytestmark = pytest.mark.cluster

POINT, TD3 = f"task={EXAMPLES}/point.py:Point", f"agent={EXAMPLES}/td3.py:TD3"
SETS = f"agent={EXAMPLES}/network.py:Sets"
FEW = ("max_updates=3", "service.eval_episodes=2", "agent.batch_size=16")
TRAININGS = [
    ((SETS,), ("sim=kinematic", "agent.learning_starts=32")),
    ((POINT, TD3), ("agent.learning_starts=40", "agent.hidden=[16]")),
]
DRAWS = """

class Point(Point):
    def draw(self, played):
        return np.zeros((8, 8, 3), np.uint8)
"""


@pytest.mark.parametrize(("own", "more"), TRAININGS)
def test_the_examples_train_through_a_master_and_two_workers(
    folder: Path, own: tuple[str, ...], more: tuple[str, ...]
) -> None:
    """From a folder whose name must be quoted."""
    mine, code = folder / "it's mine", list[str]()
    mine.mkdir()
    for one in own:
        role, _, path = one.partition("=")
        source, _, name = path.rpartition(":")
        copy = Path(shutil.copy(source, mine))
        if role == "task":
            copy.write_text(copy.read_text() + DRAWS)
        code.append(override(role, f"{copy}:{name}"))
    with ExitStack() as stack:
        settings = (f"run_dir={folder}", *FEW, *more, *code)
        master = stack.enter_context(started("tangram-master", *settings, cwd=folder))
        wait_for_file(folder / "connection.json", master)
        join = (f"connect={folder}", *code)
        for _ in range(2):
            stack.enter_context(started("tangram-worker", *join, cwd=folder))
        stack.enter_context(started("tangram-worker", *join, "role=evaluator", cwd=folder))
        assert master.wait(LIMIT_S) == 0
    assert json.loads((folder / "result.json").read_text())["updates"] == 3
    for one in own:
        role, _, path = one.partition("=")
        file = Path(path.rpartition(":")[0]).name
        assert (folder / f"{role}_{file}").read_bytes() == (mine / file).read_bytes()
    told = refused("tangram-eval", f"run_dir={folder}", cwd=folder)
    assert "which is not loaded unless you name it" in told
    scored = run_here("tangram-eval", f"run_dir={folder}", "episodes=2", *code, cwd=folder)
    assert "this run" in scored
    run_here("tangram-play", f"run_dir={folder}", "out=a.png", "episodes=2", *code, cwd=folder)
    assert (folder / "a.png").stat().st_size


LINES = [line.replace("reward=", "{role}=") for line in READ if "eval" not in line]


@pytest.mark.parametrize("line", [line for line in LINES if "play" not in line])
@pytest.mark.parametrize("given", [POINT, TD3])
def test_a_file_is_loaded_only_if_the_command_line_names_it(
    tmp_path: Path, line: str, given: str
) -> None:
    role, _, source = given.partition("=")
    path, _, name = source.rpartition(":")
    own = tmp_path / "own.py"
    marks = f"__import__('pathlib').Path({str(tmp_path / 'loaded')!r}).touch()"
    own.write_text(f"{Path(path).read_text()}\n{marks}\n")
    kind = {"kind": f"{own}:{name}", "sha256": "0" * 64}
    settings = composed("train", ["agent=goal"]) | {role: kind}
    for place, content in (
        ("run/config.yaml", yaml.safe_dump(settings)),
        ("run/connection.json", json.dumps({"endpoint": "tcp://127.0.0.1:1", "run_id": "a" * 16,
                                            "settings": settings})),
        (f"presets/{role}/mine.yaml", yaml.safe_dump(kind)),
    ):  # fmt: skip
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).write_text(content)
    command, *arguments = line.format(role=role).split()
    told = refused(command, *arguments, cwd=tmp_path)
    assert f"name code, {own}:{name}, which is not loaded unless you name it: " in told
    assert told.endswith(f"add {role}={own}:{name} if you trust it")
    assert not (tmp_path / "loaded").exists()
    told = refused(command, *arguments, f"{role}={own}:{name}", cwd=tmp_path)
    found = hashlib.sha256(own.read_bytes()).hexdigest()
    assert f"has sha256 {found}, and the settings of the run want {'0' * 64}" in told


def test_a_module_is_imported_only_if_the_command_line_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "marks.py").write_text("raise ImportError('it was imported')")
    gym = ("task=gym", "agent=goal", "task.id=Nothing-v0")
    settings = composed("train", [*gym, "task.imports=[marks]"])
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(settings))
    told = refused("tangram-train", "from_config=config.yaml", cwd=tmp_path)
    assert told.endswith(
        "name code, the module marks, which is not imported unless you name it: "
        "add task.imports=[marks] if you trust it"
    )
    for named in (("from_config=config.yaml",), gym):
        told = refused("tangram-train", *named, "task.imports=[marks]", cwd=tmp_path)
        assert "cannot import marks (it was imported)" in told


def test_a_module_of_ones_own_is_told_to_every_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    gym = (
        "task=gym",
        "task.id=Toy-v0",
        "task.imports=[tests.core.toy]",
        "agent.learning_starts=20",
    )
    run(
        "tangram-train",
        *gym,
        "max_updates=2",
        "service.eval_episodes=4",
        "run_dir=it",
        cwd=tmp_path,
    )
    result = json.loads((tmp_path / "it/result.json").read_text())
    assert (result["task"], result["updates"]) == ("Toy-v0", 2)


BROKEN = [
    ("import nothing_of_the_kind", "cannot load", "No module named 'nothing_of_the_kind'"),
    ("Own = 3", "is no Agent", "derive its class from tangram_core.agent"),
    ("class Own(Agent): pass", "has no actor, learner, pace", "see tangram_core.agent"),
    ("class Own(Whole): sections = ['agent']", "sections must be a dict, section -> data", ""),
    ("class Own(Whole): sections = {'agent': int}", "sections['agent'] is no", "Settings"),
    ("class Own(Whole): sections = {'net': Config}", "Config must say section='net'", ""),
    ("class Own(Whole): sections = {'agent': Kind}", "Kind must not declare kind or sha256", ""),
    ("class Own(Whole): sections = {'agent': Config}", "has no field config", "@dataclass"),
]
WHOLE = """
from tangram_core.agent import Agent
from tangram_core.settings import Settings
from tangram_core.run.code import override
class Config(Settings, section="agent"): pass
class Kind(Settings, section="agent"): kind = "x"
class Whole(Agent): actor = learner = pace = None
"""


@pytest.mark.parametrize(("source", "why", "remedy"), BROKEN)
def test_a_file_that_holds_no_agent_is_told(
    tmp_path: Path, source: str, why: str, remedy: str
) -> None:
    (tmp_path / "own.py").write_text(WHOLE + source)
    told = refused("tangram-train", "agent=own.py:Own", cwd=tmp_path)
    assert told.startswith("tangram-train: agent=own.py:Own")
    assert why in told
    assert remedy in told


@pytest.mark.parametrize(
    ("before", "after", "told"),
    [
        ("return -1.0 * (np.linalg", "return np.nan * (np.linalg", "Points.step"),
        ("def make(", "def check(self, **_):\n        exit(3)\n\n    def make(", "SystemExit: 3"),
    ],
)
def test_a_promise_that_is_not_kept_is_told_before_anything_starts(
    tmp_path: Path, before: str, after: str, told: str
) -> None:
    text = (EXAMPLES / "point.py").read_text()
    assert before in text
    (tmp_path / "own.py").write_text(text.replace(before, after))
    assert told in refused("tangram-train", "task=own.py:Point", "agent=goal", cwd=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["own.py"]


def test_another_package_announces_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As an installed one does: a module, and metadata with entry points."""
    (tmp_path / "their_rl.py").write_text(
        (EXAMPLES / "point.py").read_text() + (EXAMPLES / "td3.py").read_text()
    )
    metadata = tmp_path / "their_rl-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: their-rl\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(
        "[tangram_rl.tasks]\ntheir_point = their_rl:Point\n"
        "[tangram_rl.agents]\ntheir_td3 = their_rl:TD3\ngone = their_rl.gone:TD3\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match=r"agent=gone \(their_rl.gone:TD3\) cannot be loaded: "):
        find_agent("gone")
    assert find_task("their_point").__module__ == find_agent("their_td3").__module__ == "their_rl"
    settings = run_here(
        "tangram-train", "task=their_point", "agent=their_td3", "task.reach=0.2", "--cfg", "job",
        cwd=tmp_path,
    )  # fmt: skip
    found = yaml.safe_load(settings)
    assert found["task"] == {"kind": "their_point", "reach": 0.2, "stride": 0.2}
    assert found["agent"]["kind"] == "their_td3"


def test_code_is_found_in_settings_by_its_form() -> None:
    """These come from files and from the wire: anything may stand there."""
    code = {"kind": "a.py:A", "other": "b.py:B", "imports": ["panda_gym", "mine"]}
    found = {"task": "a.py:A", "task.other": "b.py:B", "task.imports": "[panda_gym,mine]"}
    assert code_of({"task": code}) == found
    plain = {"kind": "gym", "imports": ["panda_gym"], "seed": 1}
    assert code_of({"task": plain, "agent": {"imports": 5}, "run_dir": "a.py:A"}) == {}


def test_a_program_names_a_file_as_a_command_line_does() -> None:
    with pytest.raises(ConfigError, match="task=point: name it as in task=path/to/file.py:Name"):
        load_own("task", "point")
    load_own("task", POINT.partition("=")[2])
    assert find_task("elsewhere/point.py:Point").__name__ == "Point"


@pytest.mark.parametrize(
    ("place", "text"),
    [
        ("agent/foo.yaml", "# @package _global_\nagent: {kind: goal}"),
        ("agent/foo.yaml", "hydra: {callbacks: {x: {_target_: os.getcwd}}}\nkind: goal"),
        ("agent/foo.yaml", "defaults: [/hydra/callbacks: x]\nkind: goal"),
        ("hydra/callbacks/x.yaml", "x: {_target_: os.getcwd}"),
    ],
)
def test_a_preset_calls_nothing(tmp_path: Path, place: str, text: str) -> None:
    """Hydra makes what its own settings name, before any command is asked."""
    (tmp_path / "mine" / place).parent.mkdir(parents=True)
    (tmp_path / "mine" / place).write_text(text)
    told = refused("tangram-train", "--config-dir", "mine", "agent=goal", "task=gym", cwd=tmp_path)
    own = place.startswith("hydra")
    assert ("hydra's own settings: remove it" if own else "sets more than its group: leave") in told


def test_a_task_and_an_agent_of_one_file_know_each_other(tmp_path: Path) -> None:
    both = tmp_path / "both.py"
    both.write_text((EXAMPLES / "point.py").read_text() + (EXAMPLES / "td3.py").read_text())
    load_own("task", f"{both}:Point")
    load_own("agent", f"{both}:TD3")
    assert find_task(f"{both}:Point").__module__ == find_agent(f"{both}:TD3").__module__


def test_a_file_that_changed_before_its_copy_is_refused(tmp_path: Path) -> None:
    """As by an editor, between the check and the start."""
    changes = "\nfrom pathlib import Path\nPath(__file__).write_text('# another')\n"
    (tmp_path / "own.py").write_text((EXAMPLES / "point.py").read_text() + changes)
    told = refused("tangram-master", "task=own.py:Point", "agent=goal", "run_dir=run", cwd=tmp_path)
    assert "has sha256" in told


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["task=own.py"], "task=own.py: name the class in it, as in task=path/to/file.py:Name"),
        (["from_config=x.yaml", "--cfg", "job"], "--cfg shows presets and arguments only"),
        (["agent=pipe.py:A"], "it is no file"),
        (["agent=a.py:A,b.py:B"], "one file at a time: start a sweep for each"),
    ],
)
def test_what_cannot_be_meant_is_told(tmp_path: Path, arguments: list[str], told: str) -> None:
    os.mkfifo(tmp_path / "pipe.py")
    assert told in refused("tangram-train", *arguments, cwd=tmp_path)


def test_help_is_that_of_the_agent_that_is_named(tmp_path: Path) -> None:
    for agent, setting in (("goal", "agent.relabel_share"), ("mlp", "agent.saturation_penalty")):
        assert setting in run_here(
            "tangram-train", f"agent={agent}", "--help", "agent", cwd=tmp_path
        )
