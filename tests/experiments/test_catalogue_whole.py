"""Every training of the catalogue composes with every budget, which takes hydra a while."""

import pytest

from conf.help import choices
from tests.experiments.test_catalogue import setup_of, study

pytestmark = pytest.mark.slow

BUDGETS = choices("budget")


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
