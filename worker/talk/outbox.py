"""What a worker keeps: batches until the master has them, and the newest weights."""

from tangram_core.agent import Weights
from tangram_core.wire.arrays import WeightShapes
from tangram_core.wire.messages import decode_weights


class Outbox:
    """Unacknowledged messages by number, in the order of their first sending; never over a window.

    Attributes:
        window: most messages that may be kept.
        next: number of the next message, from 1.
    """

    def __init__(self, window: int) -> None:
        self.window = window
        self.next = 1
        self._messages: dict[int, list[bytes]] = {}

    def __len__(self) -> int:
        return len(self._messages)

    @property
    def first(self) -> int:
        """Number of the oldest message kept, or of the next where there is none."""
        return next(iter(self._messages), self.next)

    @property
    def free(self) -> int:
        """Messages that may be added now."""
        return max(0, self.window - len(self._messages))

    @property
    def messages(self) -> list[list[bytes]]:
        """All that must be sent again, oldest first."""
        return list(self._messages.values())

    def add(self, frames: list[bytes]) -> None:
        """Keep the next message; the caller has seen to it that there is room."""
        self._messages[self.next] = frames
        self.next += 1

    def remove(self, sequence: int) -> bool:
        """Forget a message; False if it was not kept, as after a second acknowledgement."""
        return self._messages.pop(sequence, None) is not None


class NewestWeights:
    """The newest weights of the master's present life, whichever way they came, until taken.

    Weights of another epoch are dropped; before the first the version is -1.
    """

    def __init__(self, shapes: WeightShapes | None) -> None:
        self._shapes = shapes
        self.epoch = ""
        self.version = -1
        self._fresh: Weights | None = None

    @property
    def waits(self) -> bool:
        """Whether weights wait to be taken."""
        return self._fresh is not None

    def begin(self, epoch: str) -> None:
        """Note the master's epoch; a restarted master has another, and versions start anew."""
        if epoch != self.epoch:
            self.epoch, self.version, self._fresh = epoch, -1, None

    def offer_frame(self, frame: bytes) -> None:
        """Decode a broadcast and keep it if it is newer; WireError as in `decode_weights`."""
        self.offer(*decode_weights(frame, self._shapes))

    def offer(self, epoch: str, weights: Weights) -> None:
        """Keep weights if they are newer."""
        if epoch == self.epoch and weights.version > self.version:
            self.version, self._fresh = weights.version, weights

    def take(self) -> Weights | None:
        """The newest weights, unless they were taken before."""
        fresh, self._fresh = self._fresh, None
        return fresh
