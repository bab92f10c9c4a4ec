"""Every training of the catalogue composes with every budget, which takes hydra a while."""

import pytest

from conf.help import choices
from tests.experiments.test_catalogue import setup_of, study

pytestmark = pytest.mark.slow

BUDGETS = choices("budget")
# The agent of each family that is not called like its agent.
AGENTS = {"start": "tangram", "matched": "tangram", "mlp_large": "mlp"}


@pytest.mark.parametrize("budget", BUDGETS)
def test_every_training_composes(budget: str) -> None:
    """All of them with one budget; with the others those whose nets the budget changes, too."""
    config = study(budget, choices("experiment"))
    for name, training in config.trainings.items():
        own_net = any(text.startswith("net") for text in training.overrides)
        if not (budget == "laptop" or own_net or name == training.family):
            continue
        agent = AGENTS.get(training.family, training.family)
        assert setup_of(config, name).agent.name == agent, name
