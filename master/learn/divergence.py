"""Protection against divergence: undoes updates that give values that are not finite."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import safetensors.numpy

from master.learn.trainer import Trainer
from master.record.counters import Counters
from tangram_core.agent import NotFiniteError, Weights
from tangram_core.errors import FailedError
from tangram_core.run.process import Every
from tangram_core.store.files import write_whole

# Time between two copies of the state. Longer: more updates are lost. Shorter: copying costs time.
KEEP_S = 0.5
MAX_BAD_UPDATES = 10  # undone in a row, then the master ends
UNDONE = "undone updates"


class DivergenceGuard:
    """Runs a trainer's updates; returns to the last good state if values are not finite.

    Attributes:
        trainer: the trainer; call `check` before you save its state.
    """

    def __init__(self, trainer: Trainer, evidence: Path, limit: int = MAX_BAD_UPDATES) -> None:
        """Keep the present state as the first good one.

        Args:
            trainer: new or restored.
            evidence: file for the batch of the last failure, written at the limit.
            limit: the master ends after this many failures in a row.

        Raises:
            NotFiniteError: the present state is not finite.
        """
        self._tally = Counters()
        self.trainer, self._limit, self._evidence = trainer, limit, evidence
        self._in_a_row, self._keep = 0, Every(KEEP_S)
        self._good = trainer.learner.state()
        _check_finite(self._good, trainer.updates)

    @property
    def undone(self) -> int:
        """How many times the learner went back to an earlier state."""
        return self._tally[UNDONE]

    def update(self, share: float) -> dict[str, float]:
        """Make one update; returns its losses, empty if undone; FailedError at the limit."""
        try:
            losses = self.trainer.update(share)
        except NotFiniteError as error:
            self._undo(error)
            return {}
        if self._keep.due():
            self.check()
        return losses

    def weights(self) -> Weights:
        """The acting weights, always finite: if not, go back first; FailedError at the limit."""
        weights = self.trainer.weights()
        try:
            _check_finite(weights.tensors, weights.version)
        except NotFiniteError as error:
            self._undo(error)
            return self.trainer.weights()
        return weights

    def check(self) -> None:
        """Keep the present state if it is finite, else go back; FailedError at the limit."""
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
            advice = self.trainer.learner.advice
            write_whole(self._evidence, safetensors.numpy.save(batch), above=False)
            raise FailedError(
                f"{error}; {self._in_a_row} times in a row. The last batch is in {self._evidence}. "
                f"If this comes again after a restart with resume=auto, {advice}, or begin a new "
                "run with these networks and no old episodes: warm_start=RUN_DIR"
            )
        self.trainer.go_back(self._good)


def _check_finite(arrays: Mapping[str, npt.NDArray[Any]], updates: int) -> None:
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise NotFiniteError(f"the weights are not finite after {updates} updates ('{name}')")
