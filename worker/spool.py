"""Batches that are on their way: kept until the master has them, and never more than a window."""


class Spool:
    """Unacknowledged messages by number, in the order of their first sending.

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
