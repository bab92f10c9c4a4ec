"""The newest weights, whichever way they came."""

from tangram_agent.arrays import WeightShapes
from tangram_agent.messages import decode_weights
from tangram_agent.types import Weights


class Inbox:
    """Keeps the newest weights of the master's present life, until they are taken.

    Attributes:
        epoch: of that life; weights of another are dropped.
        version: newest that came, -1 before the first.
    """

    def __init__(self, shapes: WeightShapes | None) -> None:
        self._shapes = shapes
        self.epoch = ""
        self.version = -1
        self._fresh: Weights | None = None

    def begin(self, epoch: str) -> None:
        """The master lives its life `epoch`; versions start anew if that is another one."""
        if epoch != self.epoch:
            self.epoch, self.version, self._fresh = epoch, -1, None

    def offer_frame(self, frame: bytes) -> None:
        """Decode a broadcast and keep it if it is newer.

        Raises:
            WireError: malformed, or weights of another network.
        """
        self.offer(*decode_weights(frame, self._shapes))

    def offer(self, epoch: str, weights: Weights) -> None:
        """Keep weights if they are newer."""
        if epoch == self.epoch and weights.version > self.version:
            self.version, self._fresh = weights.version, weights

    def take(self) -> Weights | None:
        """The newest weights, unless they were taken before."""
        fresh, self._fresh = self._fresh, None
        return fresh
