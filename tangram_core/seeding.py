"""Generators for every place that needs randomness, derived so that no two share a stream."""

import hashlib

import numpy as np


def episode_generator(
    run_seed: int, role: str, index: int, incarnation: int, episode: int
) -> np.random.Generator:
    """The generator of one episode.

    Any two different tuples of arguments give independent streams, so workers never play the same
    episodes, and a worker that is started again (a new incarnation) does not repeat itself.

    Args:
        run_seed: seed of the whole run.
        role: who plays, such as `player`.
        index: which one of that role.
        incarnation: how often that one was started.
        episode: number of the episode in this incarnation.
    """
    # SeedSequence joins and pads its integers, so (1,) and (1, 0) collide; a digest does not.
    key = f"{run_seed}/{role!r}/{index}/{incarnation}/{episode}"
    digest = hashlib.sha256(key.encode()).digest()
    return np.random.default_rng(int.from_bytes(digest))
