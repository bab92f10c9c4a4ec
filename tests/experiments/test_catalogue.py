"""Every preset of conf/: each experiment is what its name says."""

import pytest

from conf.cli import composed
from conf.help import choices
from tangram_agent.setup import Setup, from_mapping, make_setup
from tangram_lab.experiments.plan import StudyConfig

pytestmark = pytest.mark.fast

PAPERS = ["fig4", "table1", "table2", "fig5", "fig6"]


def study(budget: str, names: list[str]) -> StudyConfig:
    chosen = f"experiment=[{','.join(names)}]"
    return from_mapping(StudyConfig, composed("experiments", [f"budget={budget}", chosen]))


def setup_of(config: StudyConfig, training: str) -> Setup:
    return make_setup(composed("train", ["run_dir=x", *config.command(training)]))


def test_the_papers_figures_and_tables_are_the_default() -> None:
    config = from_mapping(StudyConfig, composed("experiments", []))
    assert list(config.experiments) == PAPERS
    assert config.budget.name == "laptop"
    assert config.budget.seeds == (0, 1, 2)


def test_every_training_and_test_of_the_catalogue_is_used() -> None:
    config = study("laptop", choices("experiment"))
    used = {name for e in config.experiments.values() for name in e.trainings}
    assert used == set(config.trainings)
    assert {name for e in config.experiments.values() for name in e.tests} == set(config.tests)
    assert all(experiment.tests for experiment in config.experiments.values())


def test_no_two_rows_have_one_label() -> None:
    config = study("laptop", choices("experiment"))
    labels = [training.label for training in config.trainings.values()]
    assert len(set(labels)) == len(labels)


@pytest.mark.parametrize("name", choices("experiment"))
def test_each_experiment_can_be_chosen_alone(name: str) -> None:
    (only,) = study("smoke", [name]).experiments
    assert only == name


def test_the_papers_budget_is_the_papers() -> None:
    config = study("paper", PAPERS)
    assert "max_episodes=28000" in config.command("paper")
    assert "max_episodes=100000" in config.command("mlp")
    net = setup_of(config, "paper").net
    assert (net.width, net.layers, net.heads, net.feed_forward) == (64, 3, 4, 512)
    assert setup_of(config, "mlp_large").net.hidden == (482, 482)


def test_the_papers_trainings_publish_and_reward_as_the_paper_does() -> None:
    config = study("laptop", PAPERS)
    made = composed("train", ["run_dir=x", *config.command("paper")])
    assert made["service"]["publish_seconds"] == 0.0
    assert (made["reward"]["source"], made["sim"]["pixels"]) == ("camera", 64)
