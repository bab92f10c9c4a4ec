"""Every training of the catalogue, composed, which takes hydra a while."""

from dataclasses import asdict

import pytest

from conf.help import choices
from tangram_agent.setup import Setup
from tangram_lab.experiments.cli import RESULTS, ROOT
from tangram_lab.experiments.report.check import reports
from tangram_lab.experiments.report.data import DATA, read_data
from tests.experiments.test_catalogue import setup_of, study

pytestmark = pytest.mark.slow

BUDGETS = choices("budget")
# The agent of each family that is not called like its agent.
AGENTS = {
    **dict.fromkeys(("start", "long", "raw"), "tangram"),
    "matched": "tangram",
    "mlp_large": "mlp",
    "game": "tangram",
    "game_paper": "paper",
    "game_reward": "tangram",
    "worlds": "tangram",
    "pictures": "tangram",
    "pictures_game": "tangram",
    "pictures_piles": "tangram",
    "outlines": "outline",
    "outlines_pictures": "outline",
}


def reported(budget: str) -> set[str]:
    """What `tangram-report check` composes, and holds to the settings that it was trained with."""
    plans = [read_data(folder / DATA)[0] for folder in reports(ROOT / RESULTS)]
    return {one.name for plan in plans if plan.budget.name == budget for one in plan.trainings}


@pytest.mark.parametrize("budget", BUDGETS)
def test_every_training_composes(budget: str) -> None:
    """With one budget all that the check of the reports does not; with the others those whose nets
    the budget changes, too.
    """
    config, known = study(budget, choices("experiment")), reported(budget)
    for name, training in config.trainings.items():
        own_net = any(text.startswith("net") for text in training.overrides)
        if name in known or not (budget == "laptop" or own_net or name == training.family):
            continue
        agent = AGENTS.get(training.family, training.family)
        assert setup_of(config, name).agent.name == agent, name


# What each row of an ablation changes, seen from the first row of its table.
CHANGES = {
    "tangram": {
        "tangram_scene": {"agent.readout"},
        "tangram_no_penalty": {"agent.saturation_penalty"},
        "tangram_late_penalty": {"agent.saturation_limit"},
        "tangram_arena_frame": {"agent.egocentric"},
        "tangram_no_offsets": {"agent.offsets"},
        "tangram_no_orientation": {"agent.orientation"},
        "tangram_plain_head": {"agent.angle_head"},
        "tangram_no_afterstate": {"agent.afterstate"},
        "tangram_no_near": {"agent.hindsight"},
        "tangram_no_hindsight": {"agent.hindsight"},
        "tangram_no_decay": {"agent.lr_final"},
        "tangram_no_average": {"agent.acting_average"},
        "tangram_tanh": {"agent.squash", "agent.saturation_limit"},
        "tangram_all_edges": {"agent.edges"},
        "tangram_mlp": {"net.kind"},
        "tangram_mlp_large": {"net.kind", "net.hidden"},
    },
    "paper": {
        "paper_literal": {"agent.saturation_penalty", "agent.saturation_limit"},
        "paper_egocentric": {"agent.egocentric"},
        "paper_offsets": {"agent.offsets"},
        "paper_orientation": {"agent.orientation"},
        "paper_clamp": {"agent.squash"},
        "paper_kfold": {"agent.angle_head"},
        "paper_afterstate": {"agent.afterstate"},
        "paper_near": {"agent.hindsight"},
        "paper_no_hindsight": {"agent.hindsight"},
        "paper_decay": {"agent.lr_final"},
        "paper_all_edges": {"agent.edges"},
        "paper_mlp": {"net.kind"},
    },
}
MHA_ONLY = {"net.width", "net.layers", "net.feed_forward", "net.scale"}  # an MLP has none of them


@pytest.mark.parametrize("reference", ["tangram", "paper"])
def test_an_ablation_changes_what_its_label_says(reference: str) -> None:
    config = study("laptop", [f"ablation_{reference}"])
    (experiment,) = config.experiments.values()
    assert experiment.trainings == (reference, *CHANGES[reference])
    first = setup_of(config, reference)
    for name, expected in CHANGES[reference].items():
        found = changes(first, setup_of(config, name))
        assert (found - MHA_ONLY if "net.kind" in found else found) == expected, name
        assert config.trainings[name].family == reference


def changes(one: Setup, other: Setup) -> set[str]:
    """The settings in which two setups differ."""
    ours, theirs = asdict(one), asdict(other)
    return {
        f"{section}.{key}"
        for section, values in ours.items()
        for key in values
        if values[key] != theirs[section][key]
    }
