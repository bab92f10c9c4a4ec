"""A fair queue: the keys take turns, whatever the order in which their items came.

Start-time fair queueing (Goyal, Vin and Cheng, 1996): the key with the least service so far is
next. A key that had no items for a while does not save up service.
"""

from collections import defaultdict, deque
from typing import Generic, TypeVar

Item = TypeVar("Item")


class FairQueue(Generic[Item]):
    """A queue with fair turns between keys; the items of one key stay in order."""

    def __init__(self) -> None:
        self._of = dict[str, deque[Item]]()  # only keys with items
        self._served = defaultdict[str, float](float)
        self._turn, self._now = "", 0.0

    def __len__(self) -> int:
        return sum(map(len, self._of.values()))

    def put(self, key: str, item: Item) -> None:
        """Add an item of a key."""
        if key not in self._of:
            self._of[key] = deque()
            self._served[key] = max(self._served[key], self._now)
        self._of[key].append(item)

    def first(self) -> Item:
        """The next item, which stays in the queue until `serve`; IndexError if there is none."""
        if not self._of:
            raise IndexError("nothing waits")
        self._turn = min(self._of, key=self._served.__getitem__)
        return self._of[self._turn][0]

    def serve(self, cost: float) -> Item:
        """Remove and return the item of the last `first`, and count its cost for its key."""
        waiting = self._of[self._turn]
        self._now = self._served[self._turn]
        self._served[self._turn] += cost
        item = waiting.popleft()
        if not waiting:
            del self._of[self._turn]
        if not self._of:  # no other key had to wait, so the last key has no debt
            self._now = max(self._served.values())
        return item
