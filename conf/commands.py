"""The commands: what each is for, and which settings it takes, as their dataclasses declare them.

A config is made of the declared defaults, then of the presets that are chosen, then of what stands
on the command line. The YAML files beside this one hold presets only: what differs from the
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
NEEDED = "???"  # hydra's word for a value that must be given

# In this order presets are merged. A task brings its world; an agent brings its own net and pace,
# net=... and service=... on the command line win; a set of several tokens comes last, as it brings
# its starts.
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
    """Settings in place of groups."""

    from_config: str | None = setting(
        None, "config.yaml of a run: takes its groups instead; single values still override"
    )


@dataclass(frozen=True)
class Command:
    """A console script.

    Attributes:
        name: of the script.
        about: what it does, for --help.
        examples: three lines.
        settings: the dataclasses that declare its own settings, as `module:Class`.
        groups: config group -> presets that are taken by default.
        given: own setting -> default that hydra fills in.
        over: sections of a trained run, of which any setting can be laid over the run's.
    """

    name: str
    about: str
    examples: tuple[str, ...]
    settings: tuple[str, ...]
    groups: Mapping[str, str | list[str]] = field(default_factory=dict)
    given: Mapping[str, str] = field(default_factory=dict)
    over: tuple[str, ...] = ()

    def fields(self) -> list["Field[Any]"]:
        """Its own settings."""
        return [own for name in self.settings for own in declared_fields(load(name))]

    def defaults(self) -> Plain:
        """Its own settings with their defaults."""
        return {own.name: self.given.get(own.name, plain_default(own)) for own in self.fields()}

    def chosen(self, kinds: Kinds) -> dict[str, str | list[str] | None]:
        """Config group -> presets, of the groups that a task and an agent have.

        None: those by default are of another task or agent than is played.
        """
        known, usual = kinds.sections(), USUAL.named()
        other = {role for role, kind in kinds.named().items() if kind != usual[role]}
        groups = {group: preset for group, preset in self.groups.items() if group in known}
        return groups | dict.fromkeys(other & groups.keys())

    def sections(self, kinds: Kinds = USUAL) -> dict[str, Plain]:
        """Group -> setting -> default, of the groups whose settings are declared.

        What is laid over a run has no default: null is as the run was trained.
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
        """What hydra is told: defaults list, declared defaults, and its own behaviour."""
        chosen = [{group: preset} for group, preset in self.chosen(kinds).items()]
        return {
            "defaults": ["_self_", *chosen],
            **self.defaults(),
            **self.sections(kinds),
            "hydra": _quiet(),
        }


def declared(section: type[Settings] | None) -> list["Field[Any]"]:
    """The settings of a section, if it has any."""
    return [] if section is None else declared_fields(section)


def laid_over(group: str, own: Kinds = USUAL) -> dict[str, "Field[Any]"]:
    """The settings that may be laid over a run's, of whatever kind it is, by their names.

    Args:
        group: of settings.
        own: a task and an agent that do not come with the package.
    """
    every = [kinds.sections().get(group) for kinds in (*every_kind(group), own)]
    return {own.name: own for section in every for own in declared(section)}


def load(name: str) -> type[Settings]:
    """The dataclass that `module:Class` names."""
    module, _, kind = name.partition(":")
    loaded: type[Settings] = getattr(import_module(module), kind)
    return loaded


def plain_default(own: "Field[Any]") -> Any:
    """A setting's default as YAML has it."""
    return NEEDED if own.default is MISSING else _plain(own.default)


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    return [_plain(one) for one in value] if isinstance(value, tuple) else value


def _quiet() -> Plain:
    """The commands make their own folders and logs; hydra adds none."""
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
Trains an agent on this machine. It starts a master that learns, workers that play and an
evaluator, shows the progress, and leaves a run folder with the config, checkpoints,
TensorBoard curves, result.json and a picture of test episodes.""",
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
Learns. It waits for workers, keeps what they played in a replay buffer, updates the agent
and broadcasts its weights. Where to join stands in connection.json in the run folder.""",
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
Plays. It joins a master, plays episodes with the newest weights and sends them. A run's
folder, or a copy of its connection.json, is all that it needs. An address alone is enough
where the master has service.auth=off: then task, tokens, sim, reward, agent and net must be given
and be the master's, or it is refused and told what differs.""",
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
Says how a run stands: what it does or waits for, its workers, how fast they are, how old
their weights and the last checkpoint are. It asks the master, from wherever a worker may be;
`watch tangram-status connect=...` asks every two seconds.""",
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
Says who has a key to a run whose master listens on an address, makes a key for somebody
else, and takes it back, all while the run goes on. The master must have started on an
address before, as with service.bind=0.0.0.0. The new key lies in a connection file of its
own, which is all that the other one needs. Who joined, left and was refused stands in
audit.jsonl in the run folder.""",
        (
            "tangram-keys run_dir=runs/shared    # who has keys; changes nothing",
            "tangram-keys run_dir=runs/shared add=alice role=evaluator    # makes alice.json",
            "tangram-keys run_dir=runs/shared revoke=alice    # ends alice's process, too",
        ),
        ("master.config:KeysConfig",),
    ),
    "eval": Command(
        "tangram-eval",
        """\
Scores a run. It plays test episodes with the newest weights of a run, noise off, and prints
mean reward, raw overlap and the errors in position and angle. With several tokens it prints
how much of the target is covered and how many are solved (95 % covered), and plays puzzles:
those that come with tangram-rl or your own, see docs/puzzles.md.""",
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
Shows a run. It plays episodes with the newest weights of a run, noise off, and draws them.
It assembles puzzles: those that come with tangram-rl or your own, see docs/puzzles.md.
With target=FILE it takes what you have, a drawing, a black figure, a photograph or a puzzle, says
what it took it for, and lays it, or what comes nearest to it; see docs/silhouettes.md. With
out=solution.json or .svg it writes where each token lies.""",
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
Writes an agent as an ONNX file, which onnxruntime plays in any language without torch: an action
of the fields that the task shows, by their names, for any number of rows. It plays 1,000
observations both ways first, and writes nothing if they are more than 1e-5 apart. Needs the extra
onnx; agents that search (outline, push) are more than a network and are refused.""",
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
Serves a page to play on, on this machine alone, and prints its address, which has a token
in it. Choose, lay out, draw or drop a figure: the agent says how seven tans fill it and lays
it, while you may take tans away.""",
        (
            "tangram-studio",
            "tangram-studio port=9000",
            "tangram-studio port=0    # any free one",
        ),
        ("tangram_studio.config:StudioConfig",),
    ),
    "experiments": Command(
        "tangram-experiment",
        """\
Runs a study of conf/studies.yaml: every training over its seeds, then its tests. Each test adds
rows to STUDY.csv; what has its rows is skipped, and what was cut goes on from its checkpoint, so
the same command can be given again and again. tangram-report draws what is there.""",
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
Draws tables (Markdown) and figures (PNG) of every STUDY.csv of a folder, as tangram-experiment
wrote it. Of a folder whose folders are runs, such as a sweep's, it makes one table.""",
        (
            "tangram-report runs=runs/experiments/laptop",
            "tangram-report runs=runs/my_sweep out=report",
            "tangram-report check=true    # or: check. In a clone: pages against results",
        ),
        ("tangram_lab.experiments.cli:ReportConfig",),
    ),
}
