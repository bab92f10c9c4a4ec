"""Setups of the presets, as the measurements use them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

import conf
from tangram_agent.setup import SECTIONS, Setup, make_setup
from tangram_sim.assembly import COUNTS
from tangram_sim.layout import TokensConfig


def preset(agent: str = "tangram", tokens: str = "square") -> Setup:
    """The setup of an agent's preset on a token set, read from the config's files."""
    folder = Path(conf.__file__).parent

    def group(name: str, choice: str) -> dict[str, Any]:
        content = yaml.safe_load((folder / name / f"{choice}.yaml").read_text())
        return {key: value for key, value in content.items() if key != "defaults"}

    agent_file = yaml.safe_load((folder / "agent" / f"{agent}.yaml").read_text())
    (net,) = (
        value
        for line in agent_file["defaults"]
        if isinstance(line, dict)
        for value in line.values()
    )
    choices = dict(zip(SECTIONS, (tokens, "physics", "overlap", agent, net), strict=True))
    return make_setup({name: group(name, choice) for name, choice in choices.items()})


SEVEN = tuple(name for name, count in COUNTS.items() for _ in range(count))


def several(count: int, agent: str = "tangram") -> Setup:
    """The first tans of the game, one action each, in an arena that is wide enough for all.

    One velocity for the next token: the rivals that these are measured against know no pairs.
    """
    setup = with_agent(preset(agent), readout="token")
    sim = replace(setup.sim, arena=3.0)
    return replace(setup, tokens=TokensConfig(SEVEN[:count], 0.6), sim=sim)


def with_sim(setup: Setup, **values: Any) -> Setup:
    """Another simulation."""
    return replace(setup, sim=replace(setup.sim, **values))


def with_agent(setup: Setup, **values: Any) -> Setup:
    """Another agent."""
    return replace(setup, agent=replace(setup.agent, **values))
