"""The commands: purpose, examples, and the dataclasses that declare their settings.

A config is made from the declared defaults, then the chosen presets, then the command line; later
values win. The YAML files in this folder are presets, which set only what differs from the
defaults.
"""

from collections.abc import Mapping
from dataclasses import MISSING, Field, asdict, dataclass, field, is_dataclass
from importlib import import_module
from typing import Any

from conf.kinds import Kinds, every_kind
from tangram_core.run.code import KIND
from tangram_core.settings import Settings, declared_fields, setting

Plain = dict[str, Any]
USUAL = Kinds()
NEEDED = "???"  # hydra's mark of a value that must be given

# Presets are merged in this order. A task also sets `sim`. An agent also sets `net` and `service`,
# but net=... and service=... on the command line win. `tokens` comes last, as a set of several
# tokens also sets `sim` and `service`.
GROUPS = ("task", "sim", "reward", "net", "service", "agent", "tokens")
RUN: dict[str, str | list[str]] = {
    "sim": "physics",
    "reward": "overlap",
    "task": "place",
    "net": "mha_narrow",
    "service": "local",
    "agent": "tangram",
    "tokens": "square",
}
OVER = ("task", "sim", "reward", "agent")
NEW_RUN = "runs/${now:%Y-%m-%d_%H-%M-%S}"


@dataclass(frozen=True)
class StoredConfig(Settings):
    """Setting that replaces the config groups."""

    from_config: str | None = setting(
        None, "config.yaml of a run, used instead of presets; single values on the command line win"
    )


@dataclass(frozen=True)
class Command:
    """A console script.

    Attributes:
        name: name of the script.
        about: purpose, for --help.
        examples: three command lines.
        settings: dataclasses that declare the command's own settings, as `module:Class`.
        groups: config group -> default presets.
        given: own setting -> default that hydra fills in.
        over: sections of a trained run whose settings the command can replace.
    """

    name: str
    about: str
    examples: tuple[str, ...]
    settings: tuple[str, ...]
    groups: Mapping[str, str | list[str]] = field(default_factory=dict)
    given: Mapping[str, str] = field(default_factory=dict)
    over: tuple[str, ...] = ()

    def fields(self) -> list["Field[Any]"]:
        """The command's own settings, without those of config groups."""
        return [own for name in self.settings for own in declared_fields(load(name))]

    def defaults(self) -> Plain:
        """Own setting -> default."""
        return {own.name: self.given.get(own.name, plain_default(own)) for own in self.fields()}

    def chosen(self, kinds: Kinds) -> dict[str, str | list[str] | None]:
        """Config group -> default presets, for the groups of a task and an agent.

        None: the default presets are for another task or agent.
        """
        known, usual = kinds.sections(), USUAL.named()
        other = {role for role, kind in kinds.named().items() if kind != usual[role]}
        groups = {group: preset for group, preset in self.groups.items() if group in known}
        return groups | dict.fromkeys(other & groups.keys())

    def sections(self, kinds: Kinds = USUAL) -> dict[str, Plain]:
        """Group -> setting -> default, for the groups of the command.

        A setting that can replace one of a trained run has the default None: the run's value.
        """
        known, named = kinds.sections(), kinds.named()
        given = {
            group: {KIND: named[group]} if group in named else {}
            for group in known
            if group in self.groups
        }
        for group, section in given.items():
            section |= {own.name: plain_default(own) for own in declared(known[group])}
        over = {group: dict.fromkeys(laid_over(group, kinds)) for group in self.over}
        return given | over

    def node(self, kinds: Kinds = USUAL) -> Plain:
        """Config node for hydra: defaults list, declared defaults and hydra's own settings."""
        chosen = [{group: preset} for group, preset in self.chosen(kinds).items()]
        return {
            "defaults": ["_self_", *chosen],
            **self.defaults(),
            **self.sections(kinds),
            "hydra": _quiet(),
        }


def declared(section: type[Settings] | None) -> list["Field[Any]"]:
    """The settings of a section; empty for None."""
    return [] if section is None else declared_fields(section)


def laid_over(group: str, own: Kinds = USUAL) -> dict[str, "Field[Any]"]:
    """Name -> setting of a group that can replace one of a trained run, for all kinds.

    Args:
        group: name of the group.
        own: a further task and agent, such as the user's own.
    """
    every = [kinds.sections().get(group) for kinds in (*every_kind(group), own)]
    return {own.name: own for section in every for own in declared(section)}


def load(name: str) -> type[Settings]:
    """Import the dataclass that `module:Class` names."""
    module, _, kind = name.partition(":")
    loaded: type[Settings] = getattr(import_module(module), kind)
    return loaded


def plain_default(own: "Field[Any]") -> Any:
    """The default of a setting as YAML value; ??? if it must be given."""
    return NEEDED if own.default is MISSING else _plain(own.default)


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    return [_plain(one) for one in value] if isinstance(value, tuple) else value


def _quiet() -> Plain:
    """Settings that keep hydra from adding folders and logs of its own."""
    return {
        "run": {"dir": "."},
        "sweep": {
            "dir": "runs/sweeps/${now:%Y-%m-%d_%H-%M-%S}",
            "subdir": "${hydra.job.num}",
        },
        "output_subdir": None,
        "job_logging": {"root": None},
        "hydra_logging": {"root": None},
    }


COMMANDS = {
    "train": Command(
        "tangram-train",
        """\
Trains an agent on this machine. It starts a master that learns, workers that play episodes, and
an evaluator that plays test episodes. It shows the progress and writes a run folder: config,
checkpoints, TensorBoard curves, result.json and a picture of test episodes.""",
        (
            "tangram-train",
            "tangram-train tokens=parallelogram seed=1 workers=2 run_dir=runs/parallelogram_1",
            "tangram-train agent=mlp sim=kinematic max_updates=500 agent.batch_size=128",
        ),
        (
            "master.config:MasterConfig",
            "conf.commands:StoredConfig",
        ),
        RUN,
        given={"run_dir": NEW_RUN},
    ),
    "master": Command(
        "tangram-master",
        """\
Trains an agent with workers that are started by hand, also on other machines. It waits for
workers, stores their episodes in a replay buffer, updates the agent and broadcasts its weights.
Workers join with the file connection.json in the run folder.""",
        (
            "tangram-master run_dir=runs/shared service.bind=0.0.0.0 service.port=5555",
            "tangram-master from_config=runs/shared/config.yaml run_dir=runs/shared resume=auto",
            "tangram-master from_config=runs/shared/config.yaml run_dir=runs/again seed=1",
        ),
        ("master.config:MasterConfig", "conf.commands:StoredConfig"),
        RUN,
        given={"run_dir": NEW_RUN},
    ),
    "worker": Command(
        "tangram-worker",
        """\
Plays episodes for a master: it joins, plays with the newest weights and sends the episodes. It
needs only the run's folder, or a copy of its connection.json. If the master has service.auth=off,
an address is enough. Then give the same task, tokens, sim, reward, agent and net as the master;
else the master refuses the worker and names the difference.""",
        (
            "tangram-worker connect=runs/shared",
            "tangram-worker connect=learner.json service.envs=64",
            "tangram-worker connect=runs/shared/connection.json role=evaluator "
            "service.eval_seconds=30",
        ),
        ("worker.config:WorkerConfig", "conf.commands:StoredConfig"),
        RUN,
    ),
    "status": Command(
        "tangram-status",
        """\
Shows the status of a run: its current activity, its workers and their speed, the age of their
weights and of the last checkpoint. It asks the master, so it works on every machine where a
worker works. `watch tangram-status connect=...` repeats it every two seconds.""",
        (
            "tangram-status connect=runs/my_run",
            "tangram-status connect=learner.json",
            "tangram-status connect=runs/my_run/connection.json json=true",
        ),
        ("worker.config:StatusConfig",),
    ),
    "keys": Command(
        "tangram-keys",
        """\
Lists, adds and revokes the keys with which other people's workers can join a run. The run need
not stop. Its master must have started once with an address, as with service.bind=0.0.0.0. A new
key is written to a connection file of its own. Send this file to its owner, who needs nothing
else. The file audit.jsonl in the run folder records who joined, left and was refused.""",
        (
            "tangram-keys run_dir=runs/shared    # lists keys; changes nothing",
            "tangram-keys run_dir=runs/shared add=alice role=evaluator    # makes alice.json",
            "tangram-keys run_dir=runs/shared revoke=alice    # ends alice's process, too",
        ),
        ("master.config:KeysConfig",),
    ),
    "eval": Command(
        "tangram-eval",
        """\
Scores a run. It plays test episodes with the newest weights of the run, without exploration noise,
and prints the scores of the task. For one token these are coverage, mean reward and the errors in
position and angle. For several tokens they include the share of solved targets (95 % covered).
With puzzle= it plays puzzles of tangram-rl or your own, see docs/puzzles.md.""",
        (
            "tangram-eval run_dir=runs/my_run episodes=1000 out=scores.json",
            "tangram-eval run_dir=runs/my_run sim.actions_per_token=3 sim.backend=kinematic",
            "tangram-eval run_dir=runs/my_game puzzle=test turns=8 out=puzzles.json",
        ),
        ("tangram_game.config:EvalConfig",),
        over=OVER,
    ),
    "play": Command(
        "tangram-play",
        """\
Shows a run. It plays episodes with the newest weights of the run, without exploration noise, and
draws them. With puzzle= it assembles puzzles of tangram-rl or your own, see docs/puzzles.md.
With target=FILE it takes a figure from a drawing, a black figure, a photograph or a puzzle file.
It prints how it read the file, and assembles the figure or the nearest to it that it finds; see
docs/silhouettes.md. With out=solution.json or out=solution.svg it writes where each token lies.""",
        (
            "tangram-play run_dir=runs/my_run out=tests.png episodes=20",
            "tangram-play puzzle=cat out=cat.gif",
            "tangram-play silhouette=cat.png out=cat_filled.gif",
        ),
        ("tangram_game.config:PlayConfig",),
        over=OVER,
    ),
    "export": Command(
        "tangram-export",
        """\
Writes an agent as an ONNX file, which onnxruntime runs in many languages without torch. Its inputs
are the task's observed fields by name, with any number of rows; its output is the actions. First
it compares the agent and the file on 1,000 observations. If an action differs by more than 1e-5,
it writes nothing. It needs the packages onnx, onnxscript and onnxruntime. Agents that search
(outline, push) are more than a network and cannot be exported.""",
        (
            "tangram-export run_dir=runs/my_run out=agent.onnx",
            "tangram-export run_dir=pretrained/tangram7 out=runs/tangram7.onnx",
            "tangram-export run_dir=runs/my_run agent.reapply=0    # fewer steps, a smaller file",
        ),
        ("tangram_game.config:ExportConfig",),
        over=("sim", "reward", "agent"),
    ),
    "studio": Command(
        "tangram-studio",
        """\
Serves a web page to play on, for this machine only. It prints the page's address, which has a
secret in it. Choose, arrange, draw or drop a figure: the agent finds how the seven tans fill it
and lays them. Meanwhile you may take tans away.""",
        (
            "tangram-studio",
            "tangram-studio port=9000",
            "tangram-studio port=0    # any free port",
        ),
        ("tangram_studio.config:StudioConfig",),
    ),
    "experiments": Command(
        "tangram-experiment",
        """\
Runs a study of conf/studies.yaml: each training with several seeds, then its tests. Each test adds
rows to STUDY.csv. After an interruption, give the same command again: it skips finished tests, and
unfinished trainings go on from their checkpoints. tangram-report draws the results.""",
        (
            "tangram-experiment budget=smoke",
            "tangram-experiment study=paper budget=paper jobs=4",
            "tangram-experiment study=game seeds=3 jobs=8",
        ),
        ("tangram_lab.experiments.studies:StudyConfig",),
        given={"run_dir": "runs/experiments/${budget}"},
    ),
    "report": Command(
        "tangram-report",
        """\
Draws tables (Markdown) and figures (PNG) from every STUDY.csv in a folder, as tangram-experiment
writes them. From a folder of run folders, such as a sweep's, it makes one table.""",
        (
            "tangram-report runs=runs/experiments/laptop",
            "tangram-report runs=runs/my_sweep out=report",
            "tangram-report check=true    # in a clone: are the scores of all pages right?",
        ),
        ("tangram_lab.experiments.cli:ReportConfig",),
    ),
}
