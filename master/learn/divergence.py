"""Numbers that are not finite: the update is undone, counted, and ends the run if it goes on."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import safetensors.numpy

from master.learn.trainer import Trainer
from master.record.counters import Counters
from tangram_core.agent import NotFiniteError, Weights
from tangram_core.errors import RunError
from tangram_core.run.process import Every
from tangram_core.store.files import write_whole

# Going back further costs updates, keeping more often costs time.
KEEP_S = 0.5
MAX_BAD_UPDATES = 10  # undone in a row, then the run ends
UNDONE = "undone updates"


class DivergenceGuard:
    """Runs a trainer's updates; one that is not finite takes it back to its last good state.

    Attributes:
        trainer: whoever saves its state calls `check` before.
    """

    def __init__(self, trainer: Trainer, evidence: Path, limit: int = MAX_BAD_UPDATES) -> None:
        """Keep the present state as the first good one.

        Args:
            trainer: as made or restored.
            evidence: where the batch of the last failure is written to when the run ends.
            limit: failures in a row, without good weights between them, that end it.

        Raises:
            NotFiniteError: the state is not finite already.
        """
        self._tally = Counters()
        self.trainer, self._limit, self._evidence = trainer, limit, evidence
        self._in_a_row, self._keep = 0, Every(KEEP_S)
        self._good = trainer.learner.state()
        _check_finite(self._good, trainer.updates)

    @property
    def undone(self) -> int:
        """How often something was not finite and the learner went back."""
        return self._tally[UNDONE]

    def update(self, share: float) -> dict[str, float]:
        """One update; its losses, none if it was undone; RunError if one too many was."""
        try:
            losses = self.trainer.update(share)
        except NotFiniteError as error:
            self._undo(error)
            return {}
        if self._keep.due():
            self.check()
        return losses

    def weights(self) -> Weights:
        """The acting weights, which are finite; RunError if they were not, one time too many."""
        weights = self.trainer.weights()
        try:
            _check_finite(weights.tensors, weights.version)
        except NotFiniteError as error:
            self._undo(error)
            return self.trainer.weights()
        return weights

    def check(self) -> None:
        """Keep the state if it is finite, else the one before; RunError where there is none."""
        state = self.trainer.learner.state()
        try:
            _check_finite(state, self.trainer.updates)
        except NotFiniteError as error:
            self._undo(error)
        else:
            self._good, self._in_a_row = state, 0

    def _undo(self, error: NotFiniteError) -> None:
        self._tally.note(UNDONE, str(error))
        self._in_a_row += 1
        if self._in_a_row >= self._limit:
            batch = {name: np.array(one) for name, one in self.trainer.learner.evidence().items()}
            write_whole(self._evidence, safetensors.numpy.save(batch), above=False)
            raise RunError(
                f"{error}; {self._in_a_row} times in a row, so the run ends. The last batch is in "
                f"{self._evidence}: {self.trainer.learner.advice}, and go on from the last "
                "checkpoint with resume=auto"
            )
        self.trainer.go_back(self._good)


def _check_finite(arrays: Mapping[str, npt.NDArray[Any]], updates: int) -> None:
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise NotFiniteError(f"the weights are not finite after {updates} updates ('{name}')")
