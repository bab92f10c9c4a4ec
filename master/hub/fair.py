"""A fair queue: what waits is served by turns of those it is from, not in the order it came.

Start-time fair queueing (Goyal, Vin and Cheng, 1996): whoever was served least is next. Who had
nothing to be served meanwhile saves nothing up.
"""

from collections import defaultdict, deque
from typing import Generic, TypeVar

Item = TypeVar("Item")


class FairQueue(Generic[Item]):
    """What waits, of each key in the order it came."""

    def __init__(self) -> None:
        self._of = dict[str, deque[Item]]()  # only keys that have something here
        self._served = defaultdict[str, float](float)
        self._turn, self._now = "", 0.0

    def __len__(self) -> int:
        return sum(map(len, self._of.values()))

    def put(self, key: str, item: Item) -> None:
        """One more of a key."""
        if key not in self._of:
            self._of[key] = deque()
            self._served[key] = max(self._served[key], self._now)
        self._of[key].append(item)

    def first(self) -> Item:
        """The next one, which stays until it is served; IndexError where there is none."""
        if not self._of:
            raise IndexError("nothing waits")
        self._turn = min(self._of, key=self._served.__getitem__)
        return self._of[self._turn][0]

    def serve(self, cost: float) -> Item:
        """Take out what `first` has shown, and note what it cost."""
        waiting = self._of[self._turn]
        self._now = self._served[self._turn]
        self._served[self._turn] += cost
        item = waiting.popleft()
        if not waiting:
            del self._of[self._turn]
        if not self._of:  # who has been served alone owes nobody
            self._now = max(self._served.values())
        return item
