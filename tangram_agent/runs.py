"""Load a finished run: its config, its setup and its trained actor.

`load_run("runs/my-run").predict(observation)` gives actions for observations of the gymnasium
environment, see docs/gymnasium.md. `Run.act` gives actions for corners, see docs/inference.md.
`load_run("pretrained/square")` loads one of the agents that come with the package.
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
    """A finished run, loaded from its folder.

    Attributes:
        folder: the run folder as given; `pretrained/<name>` for a pretrained agent.
        config: the resolved config of the training; for a pretrained agent only the sections of
            its setup.
        setup: the task and the agent.
        weights: the actor's weights; their version is the number of updates.
    """

    folder: Path
    config: dict[str, Any]
    setup: Setup
    weights: Weights

    @property
    def updates(self) -> int:
        """Number of updates before the loaded weights were saved."""
        return self.weights.version

    @cached_property
    def actor(self) -> Actor:
        """An actor with the loaded weights."""
        actor = self.setup.agent.actor(self.setup.task)
        actor.load(self.weights.tensors)
        return actor

    @property
    def task(self) -> Place:
        """The task of the run, which must be one of tokens.

        Raises:
            ConfigError: the run has another kind of task.
        """
        if not isinstance(self.setup.task, Place):
            raise ConfigError(
                f"{self.folder} plays task={self.setup.task_kind}: use Run.act, as "
                "docs/inference.md shows, or give a run of task=place"
            )
        return self.setup.task

    def act(self, seen: Arrays, past: History | None = None) -> Singles:
        """Actions (B, A) in [-1, 1], without exploration.

        Args:
            seen: the fields in the task's spec, B rows each. For tokens: `corners` (B, V, 2),
                `placed` (B, K), and `goals` as corners (B, V, 2) or rows of outlines (B, G, 2).
            past: earlier moments and actions of these episodes; None: the episodes begin now.
        """
        return self.actor.act(seen, past or beginning(self.setup.spec, seen))

    def predict(self, observation: Mapping[str, Any]) -> Singles:
        """Actions for an observation, without exploration and without memory of earlier steps.

        Args:
            observation: from one `TaskEnv`, or from B of them with B rows in each entry.

        Returns:
            (A,) in [-1, 1], as `TaskEnv.step` takes it; (B, A) for B rows.

        Raises:
            ConfigError: the observation has another form, or another set of tokens.
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
        """The entries of an observation as arrays, all with the same number of rows."""
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
                "give the observation that reset or step returns"
            )
        try:
            shown = {name: np.asarray(observation[name], dtype=np.float64) for name in wanted}
        except (TypeError, ValueError) as error:
            raise ConfigError(f"an observation's entries must be numbers: {error}") from None
        rows = shown["observation"].shape[:-1][:1]
        for name, count in wanted.items():
            if shown[name].shape != (*rows, count) or 0 in rows:
                raise ConfigError(
                    f"observation['{name}'] has shape {shown[name].shape}, but {self.folder} needs "
                    f"{(*(max(1, row) for row in rows), count)}: use observations of tangram_tasks."
                    "goal_env.TaskEnv(run.setup.task)"
                )
            if not (np.abs(shown[name]) <= MAX_COORDINATE).all():
                raise ConfigError(
                    f"observation['{name}'] must be finite and within +-{MAX_COORDINATE:g}: give "
                    "what the environment returns"
                )
        return shown

    def with_settings(self, changes: Changes) -> "Run":
        """A copy of the run that plays with other settings, such as `{"agent": {"reapply": 1}}`.

        Raises:
            ConfigError: the weights depend on the setting, the setting is only for learning, or
                the run cannot play with the value.
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
    """Refuse settings that cannot be changed after the training."""
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
    """Refuse another value of a setting on which the weights depend."""
    raise ConfigError(
        f"{name}={told(given)} does not fit this run, whose weights were trained with "
        f"{name}={told(was)}: leave it out, or {ANOTHER}"
    )


def read_config(path: Path) -> dict[str, Any]:
    """The resolved config of a run, by section.

    Raises:
        RunError: the file is missing, or does not hold a mapping.
        ConfigError: the file is not YAML, or too large for settings.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise RunError(f"cannot read {path} ({error.strerror}): is this a run folder?") from None
    except UnicodeDecodeError:
        raise RunError(f"{path} is not valid YAML (it is not UTF-8): correct it") from None
    return _parse_config(text, path)


def _parse_config(text: str, path: Path) -> dict[str, Any]:
    content = load_settings(text, str(path))
    if not isinstance(content, dict):
        raise RunError(f"{path} holds no settings: it must be a mapping of sections")
    return content


def load_run(run_dir: str | Path, checkpoint: str | None = None, reward: str | None = None) -> Run:
    """Load a run with the weights of its newest checkpoint, or of a named one.

    Args:
        run_dir: the run folder, or `pretrained/<name>` for an agent that comes with the package.
            If a folder of that name exists, it is loaded instead.
        checkpoint: name of a folder under `checkpoints`, such as 00004000.
        reward: `reward.name` in place of the run's. If that is a user's code, give the code again,
            or `overlap`: code is never loaded because a run's files name it.

    Raises:
        RunError: the folder, its config or the checkpoint is missing or corrupt, or the weights
            do not fit the config.
        ConfigError: this version cannot use the config, or the config names code.
    """
    return _acting(_read(Path(run_dir), checkpoint, reward))


def load_changed(run_dir: str | Path, changes: Changes) -> Run:
    """Load a run to play with other settings; a reward that is code must be among them.

    Raises:
        TangramError: see `load_run` and `Run.with_settings`.
    """
    return _acting(read_changed(run_dir, changes))


def read_changed(run_dir: str | Path, changes: Changes) -> Run:
    """Like `load_changed`, but without making the actor, so that torch is not imported."""
    reward = changes.get("reward", {}).get("name")
    return _read(Path(run_dir), None, reward).with_settings(changes)


def _acting(run: Run) -> Run:
    _ = run.actor  # made here, so that weights of another network are refused at once
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
    # Loaded first: its format shows whether another version wrote the run.
    content = load_checkpoint(path, [ACTING])
    setup = make_setup(config)
    # The backend of the simulation and the reward may differ: the policy stays the same.
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
