"""Array aliases and the legend of dimensions used in shape comments.

B batch, T steps of an episode, K tokens, V corners of all tokens together, N nodes, F features,
A entries of an action.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

AnyArray = npt.NDArray[Any]
Complex = npt.NDArray[np.complex128]
Floats = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]
Pixels = npt.NDArray[np.uint8]
