"""Buffers of a worker: unacknowledged batches, and the newest weights."""

from tangram_core.agent import Weights


class Outbox:
    """Unacknowledged messages by number, in the order of sending; at most `window` of them.

    Attributes:
        window: upper bound of the messages kept.
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
        """Number of the oldest message kept, or of the next one if the outbox is empty."""
        return next(iter(self._messages), self.next)

    @property
    def free(self) -> int:
        """How many messages may be added now."""
        return max(0, self.window - len(self._messages))

    @property
    def messages(self) -> list[list[bytes]]:
        """The frames of all messages kept, oldest first."""
        return list(self._messages.values())

    def add(self, frames: list[bytes]) -> None:
        """Add the next message; the caller must check `free` before."""
        self._messages[self.next] = frames
        self.next += 1

    def remove(self, sequence: int) -> bool:
        """Remove a message; False if it is not there, as after a second acknowledgement."""
        return self._messages.pop(sequence, None) is not None


class NewestWeights:
    """The newest weights that were broadcast or answered, until they are taken.

    Weights of another epoch (one start of the master) are dropped. The version is -1 at first.
    """

    def __init__(self) -> None:
        self.epoch = ""
        self.version = -1
        self._fresh: Weights | None = None

    @property
    def waits(self) -> bool:
        """Whether there are weights that were not taken yet."""
        return self._fresh is not None

    def begin(self, epoch: str) -> None:
        """Set the epoch; in a new epoch (a restarted master) versions begin again."""
        if epoch != self.epoch:
            self.epoch, self.version, self._fresh = epoch, -1, None

    def offer(self, epoch: str, weights: Weights) -> None:
        """Keep weights if they are newer."""
        if epoch == self.epoch and weights.version > self.version:
            self.version, self._fresh = weights.version, weights

    def take(self) -> Weights | None:
        """The newest weights; None if they were already taken."""
        fresh, self._fresh = self._fresh, None
        return fresh
