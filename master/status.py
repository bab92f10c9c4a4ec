"""A run at one moment, and how it reads in one line."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Status:
    """A run at one moment.

    Attributes:
        episodes, transitions, updates: since the run began.
        elapsed_s: seconds of training since the run began.
        share: used share of the budget, or None where nothing is bounded.
        left_s: seconds left, or None when unknown.
        transitions_per_s, updates_per_s: over the last seconds.
        players, evaluators: connected now.
        activity: what happens, or what is waited for.
        scores: of the last evaluation, by name; empty before the first.
    """

    episodes: int
    transitions: int
    updates: int
    elapsed_s: float
    share: float | None
    left_s: float | None
    transitions_per_s: float
    updates_per_s: float
    players: int
    evaluators: int
    activity: str
    scores: Mapping[str, float]


def duration(seconds: float) -> str:
    """0:07, 12:34 or 1:02:03."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def plural(count: int, noun: str) -> str:
    """1 worker, 2 workers."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"


def status_line(status: Status) -> str:
    """One line for people and for grep."""
    parts = [duration(status.elapsed_s)]
    if status.share is not None:
        parts.append(f"{status.share:.0%}{left_text(status)}")
    parts += [
        plural(status.episodes, "episode"),
        plural(status.updates, "update"),
        f"{status.transitions_per_s:,.0f} transitions/s",
        f"{status.updates_per_s:,.1f} updates/s",
        score_text(status.scores),
        plural(status.players, "worker"),
        status.activity,
    ]
    return " | ".join(part for part in parts if part)


def score_text(scores: Mapping[str, float]) -> str:
    """The scores that matter most, or nothing before the first evaluation."""
    known = (
        ("mean_reward", "reward {:.3f}"),
        ("angle_error_deg_median", "angle {:.2f}°"),
        ("position_error_median", "position {:.4f}"),
    )
    return ", ".join(text.format(scores[name]) for name, text in known if name in scores)


def left_text(status: Status) -> str:
    """How long it still takes, where that is known."""
    return f", {duration(status.left_s)} left" if status.left_s else ""
