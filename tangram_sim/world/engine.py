"""PyBullet, without the line about its build that it prints whenever it is imported."""

import os
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def _quiet() -> Iterator[None]:
    """Send what C code writes to stderr nowhere: sys.stderr is not asked by it."""
    try:
        kept = os.dup(2)
    except OSError:  # this process has no stderr
        yield
        return
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(null)


with _quiet():
    import pybullet

__all__ = ["pybullet"]
