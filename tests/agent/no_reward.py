"""A reward of a user's own, for runs of tests that tell episodes apart by what their rewards are.

Of such a reward nothing is known, so the wire bounds it by a million; Eq. 14 lies in [-1, 1].
"""

from pathlib import Path
from typing import Any

import numpy as np

NOTHING = f"{Path(__file__).absolute()}:nothing"


def nothing(achieved: Any, _desired: Any, _layout: Any) -> Any:
    """(B,) zeros."""
    return np.zeros(len(achieved))
