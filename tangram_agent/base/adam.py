"""Adam as in torch.optim, without the import of torch's compiler, which takes 1.4 s and 70 MB."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.optim.adam import adam

from tangram_core.errors import RunError

BETAS, EPSILON = (0.9, 0.999), 1e-8
NAMES = ("step", "exp_avg", "exp_avg_sq")


class Adam:
    """The optimiser Adam for a list of parameters.

    Attributes:
        slots: the state of every parameter, by the names of torch.optim. Its tensors and the
            parameters are only changed in place: a compiled update refers to them.
    """

    def __init__(self, parameters: Sequence[Tensor]) -> None:
        self._parameters = list(parameters)
        own = [parameter.detach() for parameter in self._parameters]
        means, squares = ([torch.zeros_like(one) for one in own] for _ in range(2))
        self.slots = dict(
            zip(NAMES, ([one.new_zeros(()) for one in own], means, squares), strict=True)
        )

    def load(self, slots: dict[str, list[Tensor]]) -> None:
        """Load the `slots` of the same parameters; an empty dict resets the optimiser.

        Raises:
            RunError: the slots belong to other parameters.
        """
        wanted, found = (
            {name: [(one.shape, one.dtype) for one in own] for name, own in kept.items()}
            for kept in (self.slots, slots)
        )
        if slots and found != wanted:
            raise RunError(
                "the optimiser's averages belong to another network: start a new run; "
                "warm_start=RUN_DIR takes only the networks of a run"
            )
        for name, own in self.slots.items():
            for i, one in enumerate(own):
                one.copy_(slots[name][i] if slots else torch.zeros_like(one))

    @torch.no_grad()
    def step(self, gradients: Sequence[Tensor], rate: float | Tensor, traced: bool = False) -> None:
        """Make one step of all parameters.

        Args:
            gradients: one for each parameter.
            rate: learning rate of this step; a tensor of one number inside a graph.
            traced: whether to use single operations, which a compiler can fuse; `rate` must be a
                tensor then. Otherwise one kernel of torch makes the whole step.
        """
        steps, means, squares = (self.slots[name] for name in NAMES)
        if traced:
            for step in steps:
                step.add_(1.0)
            # 1 - beta^t, by a formula that keeps all digits at small t. A compiler for CPUs keeps a
            # tanh that is used again, but computes an expm1 anew for every 16 weights.
            passed = (-math.log(beta) * steps[0] for beta in BETAS)
            whole, square = (torch.tanh(0.5 * x) * (1.0 + torch.exp(-x)) for x in passed)
            rate, factor = rate / whole, 1.0 / square
            for one in zip(self._parameters, gradients, means, squares, strict=True):
                _told(*one, rate, factor)
            return
        adam(
            self._parameters,
            [one.contiguous() for one in gradients],  # the kernel ignores strides
            means,
            squares,
            max_exp_avg_sqs=[],
            state_steps=steps,
            fused=True,
            amsgrad=False,
            beta1=BETAS[0],
            beta2=BETAS[1],
            lr=rate,
            weight_decay=0.0,
            eps=EPSILON,
            maximize=False,
        )


def _told(
    parameter: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, rate: Tensor, factor: Tensor
) -> None:
    """The step of one parameter (Kingma and Ba 2014, algorithm 1)."""
    mean.lerp_(gradient, 1.0 - BETAS[0])
    square.lerp_(gradient * gradient, 1.0 - BETAS[1])
    parameter.sub_(rate * mean / ((square * factor).sqrt() + EPSILON))
