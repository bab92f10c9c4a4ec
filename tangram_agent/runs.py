"""Loading a finished run: its config, its setup and the actor that it learned.

`load_run("runs/my-run").predict(observation)` gives actions for what gymnasium's environment shows,
docs/gymnasium.md has whole examples; `Run.act` gives them for corners, see docs/inference.md.
`load_run("pretrained/square")` gives one of the agents that come with the package.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np

from tangram_agent.pretrained import is_agent, is_name, packaged, read_agent
from tangram_core.agent import Actor, Weights
from tangram_core.arrays import Floats, Singles
from tangram_core.errors import ConfigError, RunError
from tangram_core.registry import SHA256
from tangram_core.run.code import KIND
from tangram_core.settings import (
    KEY,
    LEARNING,
    NETWORK,
    Settings,
    declared_fields,
    refuse_ignored,
    setting_name,
    told,
)
from tangram_core.setup import Setup, make_setup
from tangram_core.spec import Arrays, EpisodeSpec
from tangram_core.store.checkpoints import (
    ACTING,
    CHECKPOINTS,
    SETUP,
    load_checkpoint,
    newest_checkpoint,
)
from tangram_core.store.stored import CONFIG, load_settings
from tangram_core.task import History
from tangram_sim.config import with_given_reward
from tangram_sim.geometry.shapes import MAX_COORDINATE
from tangram_tasks.place import Place

POLICY_SECTIONS = ("tokens", "agent", "net")
ANOTHER = "train a run with it"

Changes = Mapping[str, Mapping[str, Any]]  # section -> setting -> value


@dataclass(frozen=True, eq=False)
class Run:
    """A run that was read from its folder.

    Attributes:
        folder: the run folder, as it was named; `pretrained/<name>` for one of the package.
        config: the resolved config that it was trained with; only what makes the setup for an
            agent of the package.
        setup: the task and the agent.
        weights: as the checkpoint has them; their version is the number of updates.
    """

    folder: Path
    config: dict[str, Any]
    setup: Setup
    weights: Weights

    @property
    def updates(self) -> int:
        """Of the weights that were loaded."""
        return self.weights.version

    @cached_property
    def actor(self) -> Actor:
        """Acts with these weights."""
        actor = self.setup.agent.actor(self.setup.task)
        actor.load(self.weights.tensors)
        return actor

    @property
    def task(self) -> Place:
        """The task, which is one of tokens.

        Raises:
            ConfigError: it is not.
        """
        if not isinstance(self.setup.task, Place):
            raise ConfigError(
                f"{self.folder} plays task={self.setup.task_kind}: ask it by act, as "
                "docs/inference.md has it, or name a run of task=place"
            )
        return self.setup.task

    def act(self, seen: Arrays, past: History | None = None) -> Singles:
        """Actions (B, A) in [-1, 1], exploration off.

        Args:
            seen: the fields that the task's spec names, B rows each: of tokens their corners (B, V,
                2), which are placed (B, K), and goals (B, V, 2), or (B, G, 2) rows of outlines.
            past: what was seen of these episodes before, if anything.
        """
        return self.actor.act(seen, past or beginning(self.setup.spec, seen))

    def predict(self, observation: Mapping[str, Any]) -> Singles:
        """What the agent does, noise off: the actions alone, as it keeps nothing in mind.

        Args:
            observation: of a `TaskEnv`, or of several: each entry with B rows then.

        Returns:
            (A,) in [-1, 1], which `step` takes; (B, A) for B rows.

        Raises:
            ConfigError: an observation of another form, or of another set of tokens.
        """
        spec, shown = self.setup.spec, self._checked(observation)
        desired = spec.field(spec.desired)
        seen: dict[str, Any] = {desired.name: shown["desired_goal"].reshape(-1, *desired.shape)}
        fields = [one for one in spec.fields if one is not desired]
        parts = np.cumsum([math.prod(one.shape) for one in fields])[:-1]
        for one, part in zip(fields, np.split(shown["observation"], parts, axis=-1), strict=True):
            values = part.reshape(-1, *one.shape)
            seen[one.name] = values if one.dtype == "f4" else values > 0.5
        actions = self.act(seen)
        single: Singles = actions if shown["observation"].ndim > 1 else actions[0]
        return single

    def _checked(self, observation: object) -> dict[str, Floats]:
        """The entries as arrays, all for as many rows."""
        spec = self.setup.spec
        size = {one.name: math.prod(one.shape) for one in spec.fields}
        wanted = {
            "observation": sum(size.values()) - size[spec.desired],
            "achieved_goal": size[spec.achieved],
            "desired_goal": size[spec.desired],
        }
        if not isinstance(observation, Mapping) or wanted.keys() - observation.keys():
            given = f"a {type(observation).__name__}"
            if isinstance(observation, Mapping):
                given = ", ".join(map(str, observation))
            raise ConfigError(
                f"an observation is a dict of {', '.join(wanted)}, got {given or 'an empty one'}: "
                "give what reset or step returns first"
            )
        try:
            shown = {name: np.asarray(observation[name], dtype=np.float64) for name in wanted}
        except (TypeError, ValueError) as error:
            raise ConfigError(f"an observation's entries must be numbers: {error}") from None
        rows = shown["observation"].shape[:-1][:1]
        for name, count in wanted.items():
            if shown[name].shape != (*rows, count) or 0 in rows:
                raise ConfigError(
                    f"observation['{name}'] has shape {shown[name].shape}, and {self.folder} wants "
                    f"{(*(max(1, row) for row in rows), count)}: give what tangram_tasks.goal_env."
                    "TaskEnv(run.setup.task) shows"
                )
            if not (np.abs(shown[name]) <= MAX_COORDINATE).all():
                raise ConfigError(
                    f"observation['{name}'] must be finite and within +-{MAX_COORDINATE:g}: give "
                    "what the environment returns"
                )
        return shown

    def unlearned(self) -> "Run":
        """The same run with all weights 0, so that it values everything alike."""
        none = {name: np.zeros_like(one) for name, one in self.weights.tensors.items()}
        return replace(self, weights=replace(self.weights, tensors=none))

    def with_settings(self, changes: Changes) -> "Run":
        """The same weights, played with other settings: `{"agent": {"reapply": 1}}`.

        Raises:
            ConfigError: a setting that the weights were trained for or that was for learning only,
                or a value that this run cannot be played with.
        """
        given = [f"{s}.{name}={told(v)}" for s, own in changes.items() for name, v in own.items()]
        if not given:
            return self
        config = self.setup.config()
        for section, values in changes.items():
            holds = self.setup.sections.get(section)
            if holds is None:
                raise ConfigError(
                    f"{self.folder} has no settings of {section}: leave {given[0]} out"
                )
            if KIND in values:
                _refuse_other(f"{section}.{KIND}", values[KIND], config[section][KIND])
            _check_playable(holds, values)
            config[section] |= values
        try:
            return replace(self, setup=make_setup(config))
        except ConfigError as error:
            raise ConfigError(f"{self.folder} with {', '.join(given)}: {error}") from None


def _check_playable(trained: Settings, values: Mapping[str, Any]) -> None:
    """Refuse what is no matter of a trained run's play."""
    for own in declared_fields(type(trained)):
        if own.name not in values:
            continue
        name = setting_name(trained, own.name)
        given, part = f"{name}={told(values[own.name])}", own.metadata[KEY].part
        if part == LEARNING:
            refuse_ignored(given, "a trained run, which only plays", ANOTHER)
        if part == NETWORK:
            _refuse_other(name, values[own.name], getattr(trained, own.name))


def _refuse_other(name: str, given: object, was: object) -> None:
    """What the weights are of cannot be changed."""
    raise ConfigError(
        f"{name}={told(given)} does not fit this run, whose weights were trained with "
        f"{name}={told(was)}: leave it out, or {ANOTHER}"
    )


def read_config(path: Path) -> dict[str, Any]:
    """A run's resolved config.

    Raises:
        RunError: the file is missing or no mapping.
        ConfigError: it is no YAML, or larger than settings are.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise RunError(f"cannot read {path} ({error.strerror}): is this a run folder?") from None
    except UnicodeDecodeError:
        raise RunError(f"{path} is not valid YAML (it is no UTF-8): mend it") from None
    return _parse_config(text, path)


def _parse_config(text: str, path: Path) -> dict[str, Any]:
    content = load_settings(text, str(path))
    if not isinstance(content, dict):
        raise RunError(f"{path} holds no settings: it must be a mapping of sections")
    return content


def load_run(run_dir: str | Path, checkpoint: str | None = None, reward: str | None = None) -> Run:
    """A run with the weights of its newest checkpoint, or of the one that is named.

    Args:
        run_dir: the run folder, or `pretrained/<name>` for an agent that comes with the package;
            a folder of that name wins.
        checkpoint: name of a folder under `checkpoints`, such as 00004000.
        reward: `reward.name` in place of the run's. A run that was trained with code of somebody's
            own must be told it again, or `overlap`: its files alone have no code loaded.

    Raises:
        RunError: the folder, its config or the checkpoint is missing or corrupt, or the weights
            do not fit the config.
        ConfigError: the config is not one that this version can use, or names code.
    """
    return _acting(_read(Path(run_dir), checkpoint, reward))


def load_changed(run_dir: str | Path, changes: Changes) -> Run:
    """A run, played with other settings; a reward that is code must be among them.

    Raises:
        TangramError: see `load_run` and `Run.with_settings`.
    """
    return _acting(read_changed(run_dir, changes))


def read_changed(run_dir: str | Path, changes: Changes) -> Run:
    """The same, read without torch: what is not asked for its actor needs none."""
    reward = changes.get("reward", {}).get("name")
    return _read(Path(run_dir), None, reward).with_settings(changes)


def _acting(run: Run) -> Run:
    _ = run.actor  # refuses weights of another network here, not where it first plays
    return run


def beginning(spec: EpisodeSpec, seen: Arrays) -> History:
    """The history of B episodes that begin now."""
    count = len(seen[spec.achieved])
    now = {field.name: seen[field.name] for field in spec.fields if field.name in seen}
    moments = {n: now[n][:, None] for n in now if spec.field(n).per == "moment"}
    return History(moments, np.zeros((count, 0, spec.action_size), np.float32))


def _read(folder: Path, checkpoint: str | None, reward: str | None) -> Run:
    """See `load_run`."""
    source: Traversable = folder
    if not folder.is_dir():
        if not is_name(folder):
            raise RunError(f"no run folder {folder}: give the folder that tangram-train printed")
        source = packaged(folder)
    if not is_agent(source):
        return _trained(folder, checkpoint, reward)
    if checkpoint is not None:
        raise RunError(f"{folder} has no checkpoint {checkpoint}: leave the checkpoint out")
    text, weights = read_agent(source, folder)
    config = _with_reward(_parse_config(text, folder / CONFIG), reward)
    return Run(folder, config, make_setup(config), weights)


def _with_reward(config: dict[str, Any], name: str | None) -> dict[str, Any]:
    own = config.get("reward")
    if not isinstance(own, dict):
        return config
    return config | {"reward": with_given_reward(own, {} if name is None else {"name": name})}


def _trained(folder: Path, checkpoint: str | None, reward: str | None) -> Run:
    config = _with_reward(read_config(folder / CONFIG), reward)
    checkpoints = folder / CHECKPOINTS
    path = checkpoints / checkpoint if checkpoint else newest_checkpoint(checkpoints)
    # First, as it tells a run of another version by its format.
    content = load_checkpoint(path, [ACTING])
    setup = make_setup(config)
    # Where it plays may change: another backend or another reward does not change the policy.
    known = content.counters.get(SETUP, {})
    odd = [name for name in setup.differences(known) if name in POLICY_SECTIONS]
    odd += setup.meant_otherwise(known, "sim")
    own = setup.contents()
    odd += [r for r in ("task", "agent") if own[r].get(SHA256) != known.get(r, {}).get(SHA256)]
    if odd:
        raise RunError(
            f"{folder / CONFIG} is not what {path.name} was trained with: its {', '.join(odd)} "
            "differ; restore the run's own config.yaml"
        )
    return Run(folder, config, setup, Weights(content.updates, content.arrays[ACTING]))
