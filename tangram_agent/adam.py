"""Adam as torch.optim has it, without the compiler of torch: its import takes 1.4 s and 70 MB."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.optim.adam import adam

from tangram_sim.errors import RunError

BETAS, EPSILON = (0.9, 0.999), 1e-8
NAMES = ("step", "exp_avg", "exp_avg_sq")


class Adam:
    """Steps of parameters along their gradients.

    Attributes:
        rate: of the next step.
        slots: what is kept of every parameter, by the names of torch.optim; empty before a step.
    """

    def __init__(self, parameters: Sequence[Tensor], rate: float) -> None:
        self.rate = rate
        self.slots: dict[str, list[Tensor]] = {}
        self._parameters = list(parameters)

    def load(self, slots: dict[str, list[Tensor]]) -> None:
        """Take over what was kept of the same parameters: torch reads beyond the end of others.

        Raises:
            RunError: it is of other parameters.
        """
        forms = [(one.shape, one.dtype) for one in self._parameters]
        wanted = dict.fromkeys(NAMES, forms) | {"step": [((), kind) for _, kind in forms]}
        found = {name: [(one.shape, one.dtype) for one in own] for name, own in slots.items()}
        if slots and found != wanted:
            raise RunError(
                "the optimiser's averages are not those of this network: start a new run, "
                "warm_start=RUN_DIR takes its networks alone"
            )
        self.slots = slots

    @torch.no_grad()
    def step(self) -> None:
        """One step along `grad` of each parameter."""
        if not self.slots:
            scalars = [parameter.new_zeros(()) for parameter in self._parameters]
            averages = ([torch.zeros_like(one) for one in self._parameters] for _ in range(2))
            self.slots = dict(zip(NAMES, (scalars, *averages), strict=True))
        steps, means, squares = (self.slots[name] for name in NAMES)
        adam(
            self._parameters,
            [parameter.grad for parameter in self._parameters if parameter.grad is not None],
            means,
            squares,
            max_exp_avg_sqs=[],
            state_steps=steps,
            fused=True,
            amsgrad=False,
            beta1=BETAS[0],
            beta2=BETAS[1],
            lr=self.rate,
            weight_decay=0.0,
            eps=EPSILON,
            maximize=False,
        )
