"""What may be played in a batch of environments: scenes as tensors, and candidates in them.

Legend: B environments, K tokens, M candidates of all environments, row after row.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from tangram_agent.pairs import Pairs


@dataclass(frozen=True, eq=False)
class Candidates:
    """M actions that may be played: each takes a token to a piece of the target.

    Attributes:
        row: (M,) environment, in order.
        token: (M,) which token.
        flip: (M,) 1 where it is turned over.
        piece: (M,) which piece it is meant for.
    """

    row: Tensor
    token: Tensor
    flip: Tensor
    piece: Tensor

    def at(self, index: Tensor) -> "Candidates":
        """Some of them."""
        return Candidates(*(part[index] for part in vars(self).values()))

    def best(self, value: Tensor, most: int) -> Tensor:
        """Indices (M',) of the best of each row by a value (M,), row after row."""
        table, first = self._table(value)
        best = table.topk(min(most, table.shape[1]), dim=1)
        return (best.indices + first[:, None])[best.values > -torch.inf]

    def _table(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """Values (M,) row by row, (B, L), filled up with -inf, and where each row begins, (B,)."""
        counts = torch.bincount(self.row)
        first = counts.cumsum(0) - counts
        table = torch.full((len(counts), int(counts.max())), -torch.inf)
        table[self.row, torch.arange(len(self.row)) - first[self.row]] = value
        return table, first


@dataclass(frozen=True, eq=False)
class Scene:
    """B environments as tensors; sides are 1 where a token lies on its other one.

    Attributes:
        pose: (B, K, 3) of the tokens.
        flipped: (B, K) their sides.
        goal: (B, K, 3) of the target's pieces.
        goal_flipped: (B, K) their sides.
        covered: (B, K, K) share of the second, a piece, that tokens other than the first cover.
        worth: (B, K) sum of the values of what each token covers.
    """

    pose: Tensor
    flipped: Tensor
    goal: Tensor
    goal_flipped: Tensor
    covered: Tensor
    worth: Tensor

    def pairs(self, c: Candidates) -> Pairs:
        """The pairs (M,) of candidates; a token that is turned over has changed its side."""
        return Pairs(
            pose=self.pose[c.row, c.token],
            flipped=self._side(c),
            token=c.token,
            goal=self.goal[c.row, c.piece],
            goal_flipped=self.goal_flipped[c.row, c.piece],
            piece=c.piece,
            covered=self.covered[c.row, c.token, c.piece],
        )

    def meetings(self, movers: Candidates, other: Candidates, where: Tensor) -> Pairs:
        """Pairs (M,) of tokens that move and of others that lie at poses (M, 3) in the same rows.

        Where tokens meet, the other one has the place of a piece that nothing covers.
        """
        return Pairs(
            pose=self.pose[movers.row, movers.token],
            flipped=self._side(movers),
            token=movers.token,
            goal=where,
            goal_flipped=self._side(other),
            piece=other.token,
            covered=torch.zeros(len(where)),
        )

    def _side(self, c: Candidates) -> Tensor:
        return (self.flipped[c.row, c.token] - c.flip).abs()
