"""What the hub sends, and what it refuses: counted by name and told."""

from master.keys import Keys
from master.sockets import Sockets
from master.tally import Tally
from tangram_agent.schema import Plain


class Post:
    """Messages to peers.

    Attributes:
        sockets: open.
        counters: traffic and refusals by name.
    """

    def __init__(self, bind: str, port: int, keys: Keys | None, weights_port: int) -> None:
        self.counters = Tally()
        self.sockets = Sockets(bind, port, self.counters, keys, weights_port)

    def send(self, identity: bytes, answer: Plain) -> None:
        """Send to a peer, unless it is gone or does not read."""
        self.sockets.send(identity, answer.encode())

    def refuse(self, identity: bytes, counter: str, answer: Plain) -> None:
        """Send a reason, count it and tell it."""
        self.counters.note(counter, getattr(answer, "reason", "a connection without HELLO"))
        self.send(identity, answer)
