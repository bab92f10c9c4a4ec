"""Everything that a master and its workers must agree on, from plain mappings."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass
from functools import cached_property
from typing import Any, TypeVar, cast, get_origin, get_type_hints

import dacite

from tangram_agent.config import AgentConfig, NetConfig
from tangram_core.errors import ConfigError
from tangram_core.settings import KEY, NETWORK, declared_fields, refuse_ignored, told
from tangram_core.spec import EpisodeSpec
from tangram_sim.config import SILHOUETTES, RewardConfig, SimConfig
from tangram_sim.episodes import spec_of
from tangram_sim.geometry.layout import Layout, TokensConfig, make_layout
from tangram_sim.motion.actions import action_size, corner_bound, goal_rows, horizon
from tangram_sim.rewards import reward_identity
from tangram_sim.tasks.targets import check_targets

Settings = TypeVar("Settings")

# Those that have none on outlines.
_NOT_OF_OUTLINES = ("saturation_penalty", "actor_lr", "noise")
SECTIONS = ("tokens", "sim", "reward", "agent", "net")


@dataclass(frozen=True)
class Setup:
    """The task and the agent of one run."""

    tokens: TokensConfig
    sim: SimConfig
    reward: RewardConfig
    agent: AgentConfig
    net: NetConfig

    def __post_init__(self) -> None:
        """Refuse settings that would change nothing.

        Raises:
            ConfigError: names the setting and the remedy.
        """
        if self.fills and self.layout.tokens == 1:  # before the set's own remedies, which lead here
            raise ConfigError(
                f"tokens={self.layout.shapes[0].name}: an agent of outlines needs a set of several "
                "tokens: set tokens=tangram7, or another agent"
            )
        check_targets(self.layout, self.sim)
        agent, one = self.agent, self.layout.tokens == 1
        if agent.replay_capacity < self.horizon:
            raise ConfigError(
                f"agent.replay_capacity must hold an episode, {self.horizon} actions, "
                f"got {agent.replay_capacity}"
            )
        if self.fills:
            self._check_fills()
        if self.pairs and not one:
            self._check_credit(f"{self.layout.tokens} tokens on pairs")

    def _check_fills(self) -> None:
        """Refuse what an agent of outlines cannot use, or outlines that no agent sees."""
        agent, sim = self.agent, self.sim
        if sim.observe not in SILHOUETTES:
            raise ConfigError(
                f"agent.readout=outline needs sim.observe=silhouette, got {sim.observe}: set "
                "sim=silhouette, or another agent"
            )
        if self.net.kind == "mlp":
            refuse_ignored("net.kind=mlp", "outlines", "set net.kind=mha")
        changed = _changed(agent)
        for name in _NOT_OF_OUTLINES:
            if name in changed:
                given, usual = f"agent.{name}={told(changed[name])}", getattr(AgentConfig, name)
                refuse_ignored(given, "outlines", "take another agent", usual)
        for name, value in _changed(self.reward).items():
            refuse_ignored(
                f"reward.{name}={told(value)}",
                "an agent that learns what fills outlines",
                "take another agent",
            )
        if any(relabel.strategy != "final" for relabel in agent.hindsight):
            refuse_ignored("agent.hindsight.strategy", "outlines", "use final")
        if not agent.hindsight:
            raise ConfigError(
                "agent.hindsight=[] leaves an agent of outlines without a filled one to learn "
                "from: name final, as in agent.hindsight=[{strategy:final,copies:6}]"
            )
        self._check_world_of_outlines()

    def _check_world_of_outlines(self) -> None:
        """Refuse a game in which a token does not go where an agent of outlines takes it, once."""
        sim, flips = self.sim, self.layout.any_chiral
        wanted: dict[str, object] = {
            "motion": "lift",
            "starts": "outside",
            "actions_per_token": 1,
            "allow_flip": flips or sim.allow_flip,
            "corner_noise": 0.0,
            "world": "plain",
        }
        if self.agent.gamma != 1.0:
            raise ConfigError(
                f"agent.gamma={told(self.agent.gamma)}: an agent of outlines learns what comes of "
                "an action at the end: set agent.gamma=1"
            )
        for name, value in wanted.items():
            given = getattr(sim, name)
            if given != value:
                raise ConfigError(
                    f"sim.{name}={told(given)}: an agent of outlines needs a token to go where it "
                    f"takes it, once, from outside: set sim.{name}={told(value)}"
                )

    def _check_credit(self, several: str) -> None:
        """Refuse what several tokens on pairs cannot use, or cannot learn."""
        agent, whole = self.agent, "set agent.readout=token, which values the whole scene"
        if agent.gamma > 0.0:
            refuse_ignored(f"agent.gamma={told(agent.gamma)}", several, whole)
        for name, value in _changed(self.reward).items():
            refuse_ignored(f"reward.{name}={told(value)}", several, whole)
        if any(relabel.strategy == "future" for relabel in agent.hindsight):
            refuse_ignored("agent.hindsight.strategy=future", several, "use final")

    @cached_property
    def layout(self) -> Layout:
        """The token set's fixed structure."""
        return make_layout(self.tokens)

    @property
    def horizon(self) -> int:
        """T: actions in one episode."""
        return horizon(self.layout.tokens, self.sim)

    @property
    def pairs(self) -> bool:
        """Whether the agent acts on pairs of a token and a piece of the target."""
        return self.agent.readout == "pair"

    @property
    def fills(self) -> bool:
        """Whether the agent fills outlines: it is told of no piece of the target."""
        return self.agent.readout == "outline"

    @property
    def goal_rows(self) -> int:
        """G: corners of a target as agents see it."""
        return goal_rows(self.layout, self.sim)

    @property
    def critic_plays(self) -> bool:
        """Whether the critic has a say in what is played; else the actor alone decides.

        Of one token that stays on its side there is one proposal, and nothing to choose.
        """
        one = self.layout.tokens == 1 and not self.sim.allow_flip
        return self.pairs and not one

    @property
    def credits_pieces(self) -> bool:
        """Whether the critic learns what a token covers of each piece of the target.

        Else it learns the environment's reward.
        """
        return self.pairs and self.layout.tokens > 1

    @property
    def bootstraps(self) -> bool:
        """Whether the critic's target counts what follows an action (Eq. 5)."""
        return self.agent.gamma > 0.0 and self.horizon > 1

    @property
    def learns_motion(self) -> bool:
        """Whether the agent learns what a command comes to: with a critic that sees afterstates."""
        return self.pairs and self.agent.motion == "learned"

    @property
    def screens_motions(self) -> bool:
        """Whether a motion far beside what is usual tells nothing: of an exact world in pictures.

        There it is that of a token which met others or was seen wrongly. Elsewhere it may be what
        that world does.
        """
        sim = self.sim
        return sim.observe == "pictures" and self.layout.tokens > 1 and not sim.inexact

    @property
    def action_size(self) -> int:
        """A: x, y and angular velocity, with more than one token its number before them."""
        return action_size(self.layout.tokens, self.sim)

    @property
    def bound(self) -> float:
        """The largest |coordinate| that a corner can reach."""
        return corner_bound(self.layout.tokens, self.sim)

    @cached_property
    def spec(self) -> EpisodeSpec:
        """What its episodes are made of."""
        return spec_of(self.layout, self.sim, self.reward, self.fills)

    def fingerprints(self) -> dict[str, str]:
        """A digest of each section: two processes with the same ones play the same task."""
        sections = {"tokens": self.layout.fingerprint()}
        for name in SECTIONS[1:]:
            content = json.dumps(self._content(name), sort_keys=True)
            sections[name] = hashlib.sha256(content.encode()).hexdigest()[:16]
        return sections

    def task_digest(self) -> str:
        """A digest of all sections but the agent's, which may change in the middle of a run."""
        digests = [value for name, value in sorted(self.fingerprints().items()) if name != "agent"]
        return hashlib.sha256("".join(digests).encode()).hexdigest()[:16]

    def contents(self) -> dict[str, Any]:
        """Each section as JSON values, for a checkpoint; tokens by what makes them."""
        sections: dict[str, Any] = {name: self._content(name) for name in SECTIONS[1:]}
        sections["tokens"] = self.layout.fingerprint()
        plain: dict[str, Any] = json.loads(json.dumps(sections))
        return plain

    def _content(self, name: str) -> dict[str, Any]:
        if name == "reward":
            return reward_identity(self.reward)
        content: dict[str, Any] = asdict(getattr(self, name))
        return content

    def differences(self, contents: object) -> list[str]:
        """The sections in which another setup, known by its contents, is not this one.

        Only settings that both know are compared, so that a run outlives a version with more of
        them: what is new does by default what was done before. But for agent.motion: a learner
        refuses a checkpoint that has no model of motion.
        """
        own = self.contents()
        known = own | contents if isinstance(contents, dict) else {}
        return sorted(name for name in own if not _agree(own[name], known.get(name)))

    def meant_otherwise(self, contents: object, section: str = "agent") -> list[str]:
        """The settings by which networks of another setup are not networks of this one.

        They may have the same shapes: what they see, give and learn from is another thing.
        """
        other = contents.get(section) if isinstance(contents, dict) else None
        own = self.contents()[section]
        known = own | other if isinstance(other, dict) else own
        declared = declared_fields(type(getattr(self, section)))
        parts = {one.name: one.metadata[KEY].part for one in declared}
        names = [name for name in own if parts[name] == NETWORK]
        return [f"{section}.{name}" for name in names if own[name] != known[name]]


def _changed(config: RewardConfig | AgentConfig) -> dict[str, Any]:
    """The settings that are not the default, by name."""
    every = {own.name: (getattr(config, own.name), own.default) for own in fields(config)}
    return {name: value for name, (value, default) in every.items() if value != default}


def _agree(one: object, other: object) -> bool:
    """Whether two JSON values are equal in all keys that both have."""
    if isinstance(one, dict) and isinstance(other, dict):
        return all(_agree(one[name], other[name]) for name in one.keys() & other.keys())
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_agree, one, other))
    return one == other


def make_setup(config: Mapping[str, Any]) -> Setup:
    """The setup in the sections tokens, sim, reward, agent and net of a resolved config.

    Raises:
        ConfigError: a section is missing, a key is unknown, or a value has a wrong type or range.
    """
    missing = [name for name in SECTIONS if name not in config]
    if missing:
        raise ConfigError(f"the config has no section {', '.join(missing)}")
    return from_mapping(Setup, {name: config[name] for name in SECTIONS})


def from_mapping(kind: type[Settings], mapping: Mapping[str, Any]) -> Settings:
    """A settings dataclass from a plain mapping; unknown keys and wrong types are refused.

    Raises:
        ConfigError: names the key and what is wrong with it.
    """
    _check_names(kind, mapping)
    rules = dacite.Config(strict=True, cast=[tuple], type_hooks={float: _as_float})
    try:
        return dacite.from_dict(kind, mapping, rules)
    except dacite.DaciteError as error:
        raise ConfigError(f"wrong config: {error}") from None


def _check_names(kind: type[Any], mapping: Mapping[str, Any], group: str = "") -> None:
    """Refuse unknown names, and what is no list where one is expected.

    A text would be taken letter by letter.
    """
    hints = get_type_hints(kind)
    for name, value in mapping.items():
        if name not in hints:
            raise ConfigError(
                f"there is no setting {group}{name}: delete it; a config may have it of an older "
                "version (CHANGELOG.md)"
            )
        if get_origin(hints[name]) is tuple and not isinstance(value, list | tuple):
            full = f"{group}{name}"
            raise ConfigError(f"{full} must be a list, as in {full}=[...], got {value!r}")
        if is_dataclass(hints[name]) and isinstance(value, Mapping):
            _check_names(cast("type[Any]", hints[name]), value, f"{group}{name}.")


def _as_float(value: object) -> object:
    """Whole numbers are welcome where a float is expected; texts and booleans are not."""
    if isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return value
