"""What players in lockstep are to play next; told again until it has come."""

from collections.abc import Iterable, Mapping

from master.peers import Peer
from master.post import Post
from tangram_agent.messages import Go


class Orders:
    """The orders of a round that are not carried out yet."""

    def __init__(self, post: Post) -> None:
        self._post = post
        self._open: dict[int, Go] = {}

    def give(self, orders: Mapping[int, Go], peers: Iterable[Peer]) -> None:
        """Tell these players; those that join later are reminded."""
        self._open = dict(orders)
        for peer in peers:
            self.remind(peer)

    def remind(self, peer: Peer) -> None:
        """Tell a player, who may have missed it."""
        if peer.role == "player" and peer.index in self._open:
            self._post.send(peer.identity, self._open[peer.index])

    def done(self, peer: Peer) -> None:
        """Its batch has come."""
        self._open.pop(peer.index, None)
