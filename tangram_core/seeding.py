"""Random generators for episodes, derived so that no two episodes share a stream."""

import hashlib

import numpy as np


def episode_generator(
    run_seed: int, role: str, index: int, incarnation: int, episode: int
) -> np.random.Generator:
    """The generator of one episode.

    Different arguments give independent streams. So workers never play the same episodes, and a
    worker that is started again (a new incarnation) does not repeat its episodes.

    Args:
        run_seed: seed of the whole run.
        role: role of the process, such as `player`.
        index: number of the process within its role.
        incarnation: how often this process was started.
        episode: number of the episode in this incarnation.
    """
    # SeedSequence joins and pads its integers, so (1,) and (1, 0) collide; a digest does not.
    key = f"{run_seed}/{role!r}/{index}/{incarnation}/{episode}"
    digest = hashlib.sha256(key.encode()).digest()
    return np.random.default_rng(int.from_bytes(digest))
