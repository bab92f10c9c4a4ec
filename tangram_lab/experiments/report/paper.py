"""The paper's own numbers, by the place in the paper that an experiment names as its source."""

import re
from dataclasses import dataclass

from tangram_lab.experiments.report.study import Experiment, Training, Trial


@dataclass(frozen=True)
class Value:
    """What the paper reports of one of its agents.

    Attributes:
        mean_reward: that it reliably reaches.
        after: episodes until then.
        parameters: of the network.
        hours: of training.
        episodes: of training.
        by_actions: mean rewards with 1, 2, ... actions in sequence.
    """

    mean_reward: float | None = None
    after: int | None = None
    parameters: int | None = None
    hours: float | None = None
    episodes: int | None = None
    by_actions: tuple[float, ...] = ()


# Source -> name of a training or of a family -> what the paper reports.
VALUES = {
    "Fig. 4": {
        "paper": Value(mean_reward=0.75, after=1_500),
        "mlp": Value(mean_reward=0.70, after=19_000),
    },
    "Table I": {
        "paper": Value(parameters=504_000, hours=72, episodes=28_000),
        "mlp": Value(parameters=14_000, hours=48, episodes=100_000),
    },
    "Table II": {"paper": Value(by_actions=(0.758, 0.754, 0.754, 0.764, 0.750))},
}


def value(experiment: Experiment, training: Training) -> Value | None:
    """The paper's numbers for a training of an experiment.

    They belong to the training of that very name; where an experiment has none, to its family.
    """
    names = {one.name for one in experiment.trainings}
    for known in (VALUES[place] for place in _places(experiment)):
        if training.name in known:
            return known[training.name]
        if training.family in known and training.family not in names:
            return known[training.family]
    return None


def trial_value(experiment: Experiment, training: Training, trial: Trial) -> float | None:
    """The paper's mean reward in a test without noise, by its count of actions."""
    known = value(experiment, training)
    if known is None or trial.corner_noise or trial.actions is None:
        return None
    return dict(enumerate(known.by_actions, 1)).get(trial.actions)


def _places(experiment: Experiment) -> list[str]:
    return [p for p in VALUES if re.search(rf"{re.escape(p)}(?!\w)", experiment.source)]
