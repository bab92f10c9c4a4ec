"""Played episodes of tokens, for scores, rivals and pictures.

Legend: E episodes, B environments, T steps of an episode, K tokens, V corners, A entries of an
action.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from tangram_core import task
from tangram_core.arrays import Bools, Floats, Pixels
from tangram_core.spec import Arrays, Episodes

Fields = TypeVar("Fields")  # arrays or tensors


def closed(seen: Mapping[str, Fields]) -> Fields:
    """(B, K) tokens that no action should choose: placed, or unseen while others are seen."""
    return seen.get("closed", seen["placed"])


def as_seen(seen: Arrays) -> tuple[Floats, Bools, Floats]:
    """Corners (B, V, 2), `closed` tokens (B, K) and goals (B, V, 2), as rivals need them."""
    corners, goals = (np.asarray(seen[name], np.float64) for name in ("corners", "goals"))
    return corners, np.asarray(closed(seen), np.bool_), goals


@dataclass(frozen=True, eq=False)
class Played:
    """E whole episodes, with exact facts that only the environments know.

    Attributes:
        episodes: corners and goals as the policy saw them, its actions and their rewards.
        corners: (E, T + 1, V, 2) exact corners, before each step and after the last.
        goals: (E, V, 2) exact corners of the targets.
        coverage: (E,) covered share of exact polygons after the last step.
        refused: (E, T) whether the action chose a placed token.
        blocked: (E, T) whether a token could not be set down because it would lie on others.
        seconds: (E,) wall time of choosing and moving; episodes played together share it equally.
        chose: (E,) processor time of choosing.
        camera: (E,) Eq. 14 of the pictures after the last step; None without a camera.
        pictures: (E, T + 1, P, P) pictures that the agent saw; None if it sees none.
    """

    episodes: Episodes
    corners: Floats
    goals: Floats
    coverage: Floats
    refused: Bools
    blocked: Bools
    seconds: Floats
    chose: Floats
    camera: Floats | None
    pictures: Pixels | None

    @property
    def starts(self) -> Floats:
        """(E, V, 2) corners of the tokens before the first action."""
        return self.corners[:, 0]

    @property
    def ends(self) -> Floats:
        """(E, V, 2) corners of the tokens after the last action."""
        return self.corners[:, -1]

    @staticmethod
    def of(played: task.Played) -> "Played":
        """Read episodes and the facts of a `PlaceEnv`."""
        facts = played.facts
        return Played(
            episodes=played.episodes,
            corners=facts["corners"],
            goals=facts["goals"][:, 0],
            coverage=facts["coverage"][:, -1],
            refused=facts["refused"][:, 1:],
            blocked=facts["blocked"][:, 1:],
            seconds=played.seconds,
            chose=played.chose,
            camera=facts["camera"][:, -1] if "camera" in facts else None,
            pictures=facts.get("pictures"),
        )
