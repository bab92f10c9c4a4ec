"""A network's parameters as named arrays, and back."""

from collections.abc import Collection, Mapping

import numpy as np
import torch
from torch import nn

from tangram_core.errors import RunError
from tangram_core.spec import Array

MOST = 1e6  # bound of a parameter's magnitude; learned ones stay far below


def load_arrays(
    module: nn.Module, arrays: Mapping[str, Array], names: Collection[str] | None = None
) -> None:
    """Copy named arrays into a module's parameters.

    Args:
        module: the module to change.
        arrays: arrays by the names of parameters.
        names: names of the parameters that must be given; None: all.

    Raises:
        RunError: names or shapes differ, or numbers are not finite; names the first one.
    """
    every = module.named_parameters()
    own = {name: p for name, p in every if names is None or name in names}
    if set(own) != set(arrays):
        odd = min(set(own) ^ set(arrays))
        raise RunError(
            f"weights of another network: '{odd}' is on one side only: start a new run, or use the "
            "version that they were trained with"
        )
    with torch.no_grad():
        for name, parameter in own.items():
            if tuple(parameter.shape) != arrays[name].shape:
                raise RunError(
                    f"weights of another layout: '{name}' is {arrays[name].shape}, "
                    f"this setup needs {tuple(parameter.shape)}: start with the run's own tokens, "
                    "agent and net"
                )
            if not np.abs(arrays[name]).max(initial=0.0) <= MOST:  # NaN fails, too
                raise RunError(
                    f"damaged weights: '{name}' must hold finite numbers up to {MOST:g}: take them "
                    "from another checkpoint"
                )
            parameter.copy_(torch.from_numpy(np.array(arrays[name])))


def to_arrays(module: nn.Module) -> dict[str, Array]:
    """Copies of a module's parameters by name."""
    named = module.named_parameters()
    return {name: p.detach().cpu().numpy().copy() for name, p in named}


def under(prefix: str, state: Mapping[str, Array]) -> dict[str, Array]:
    """The arrays whose names begin with a prefix, by the rest of their names."""
    return {name.removeprefix(prefix): v for name, v in state.items() if name.startswith(prefix)}
