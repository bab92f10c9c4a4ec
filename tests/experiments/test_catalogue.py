"""Every preset of conf/: each training composes with each budget, and is what its name says."""

from typing import Any

import hydra
import pytest
from omegaconf import OmegaConf

from conf.help import choices
from experiments.plan import StudyConfig
from tangram_agent.setup import Setup, from_mapping, make_setup

pytestmark = pytest.mark.fast

BUDGETS = choices("budget")
PAPERS = ["fig4", "table1", "table2", "fig5", "fig6"]


def compose(primary: str, overrides: list[str]) -> dict[str, Any]:
    with hydra.initialize_config_module("conf", version_base="1.3"):
        composed = OmegaConf.to_container(hydra.compose(primary, overrides), resolve=True)
    assert isinstance(composed, dict)
    return {str(name): value for name, value in composed.items()}


def study(budget: str, names: list[str]) -> StudyConfig:
    chosen = f"experiment=[{','.join(names)}]"
    return from_mapping(StudyConfig, compose("experiments", [f"budget={budget}", chosen]))


def setup_of(config: StudyConfig, training: str) -> Setup:
    overrides = config.overrides(config.trainings[training])
    return make_setup(compose("train", ["run_dir=x", *overrides]))


def test_the_papers_figures_and_tables_are_the_default() -> None:
    config = from_mapping(StudyConfig, compose("experiments", []))
    assert list(config.experiments) == PAPERS
    assert config.budget.name == "laptop"
    assert config.budget.seeds == (0, 1, 2)


@pytest.mark.parametrize("budget", BUDGETS)
def test_every_training_composes(budget: str) -> None:
    """All of them with one budget; with the others those whose nets the budget changes, too."""
    config = study(budget, choices("experiment"))
    for name, training in config.trainings.items():
        own_net = any(text.startswith("net") for text in training.overrides)
        if not (budget == "laptop" or own_net or name == training.family):
            continue
        agent = {"start": "tangram", "mlp_large": "mlp"}.get(training.family, training.family)
        assert setup_of(config, name).agent.name == agent, name


def test_every_training_and_test_of_the_catalogue_is_used() -> None:
    config = study("laptop", choices("experiment"))
    used = {name for e in config.experiments.values() for name in e.trainings}
    assert used == set(config.trainings)
    assert {name for e in config.experiments.values() for name in e.tests} == set(config.tests)


@pytest.mark.parametrize("name", choices("experiment"))
def test_each_experiment_can_be_chosen_alone(name: str) -> None:
    (only,) = study("smoke", [name]).experiments
    assert only == name


@pytest.mark.parametrize("reference", ["tangram", "paper"])
def test_an_ablation_changes_one_part(reference: str) -> None:
    """Every row of the table differs from its first by one setting, or by one part in several."""
    config = study("laptop", [f"ablation_{reference}"])
    (experiment,) = config.experiments.values()
    first, *others = experiment.trainings
    assert first == reference
    for name in others:
        training = config.trainings[name]
        parts = {text.partition("=")[0].partition("_")[0] for text in training.overrides}
        assert len(parts) == 1, name
        assert training.family == reference


def test_the_papers_budget_is_the_papers() -> None:
    config = study("paper", PAPERS)
    assert "max_episodes=28000" in config.overrides(config.trainings["paper"])
    assert "max_episodes=100000" in config.overrides(config.trainings["mlp"])
    net = setup_of(config, "paper").net
    assert (net.width, net.layers, net.heads, net.feed_forward) == (64, 3, 4, 512)
    assert setup_of(config, "mlp_large").net.hidden == (482, 482)


def test_the_papers_trainings_publish_and_reward_as_the_paper_does() -> None:
    config = study("laptop", PAPERS)
    made = compose("train", ["run_dir=x", *config.overrides(config.trainings["paper"])])
    assert made["service"]["every_update"]
    assert (made["reward"]["source"], made["sim"]["camera"]) == ("camera", True)
