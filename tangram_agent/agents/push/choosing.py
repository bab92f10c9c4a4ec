"""Choice of the best push by critics, among many that are drawn.

Legend: n tables, k tokens of each that may be pushed, S tokens of the set, P pushes drawn for each
token, N of them that are valued, M results.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tangram_agent.agents.push.networks import Twins
from tangram_agent.agents.push.scenes import Scene, Tokens
from tangram_agent.agents.push.seen import Seen, pushes, seen_by

NEVER = -1e3  # value of impossible pushes


@dataclass(frozen=True, eq=False)
class Search:
    """Which pushes are valued.

    Attributes:
        drawn: (n * k, P) indices of the drawn pushes.
        count: N. Half are the pushes after which the token, if alone, is nearest to its place; the
            other half are the first ones drawn.
        most: M, results for each table: the pushes nearest in value to the best of their token.
        eligible: (n, k) which tokens to push if any of them can be; None: all out of place.
    """

    drawn: Tensor
    count: int
    most: int = 1
    eligible: Tensor | None = None


def best(
    critics: Twins, moved: Tensor, tokens: Tokens, scene: Scene, pairs: Tensor, search: Search
) -> tuple[Tensor, Tensor, Tensor]:
    """The best pushes of each table: values, slots of their tokens, and indices, each (n, M).

    The first critic chooses; the value is the lower one of both critics. It counts until a token
    and the one beside it are in place. Pushes that are impossible or not allowed have the value
    NEVER. Tokens in place must not be pushed.

    Args:
        critics: two critics.
        moved: (S, 1024, 3) motions of tokens that are pushed alone.
        tokens: the set of tokens.
        scene: n tables.
        pairs: (2, n, k) slots of the tokens that may be pushed, and of those beside them.
        search: which pushes to value.
    """
    _, size, each = pairs.shape
    flat, beside = pairs.flatten(1)
    seen = seen_by(tokens, scene.repeated(each), flat, beside)
    count = search.count
    which = _looked_at(tokens, seen, moved, search.drawn, count)
    own = seen.which[:, None]
    numbers, never = pushes(
        tokens, seen, tokens.begins[own, which], tokens.ends[own, which], moved[own, which]
    )
    one = torch.arange(size, device=flat.device).repeat_interleave(each)
    left = scene.present & ~tokens.placed(scene)
    never = (never | ~left[one, flat][:, None]).view(size, each, count)
    if search.eligible is not None:
        others = never | ~search.eligible[..., None]
        never = torch.where(others.all((1, 2), keepdim=True), never, others)
    values = critics.one(0, seen, numbers).view(size, each, count)
    values = torch.where(never, NEVER, values).flatten(1)
    most = min(search.most, values.shape[1])
    if most > 1:
        own_best = values.view(size, each, count).amax(2, keepdim=True).expand(-1, -1, count)
        less = torch.where(values > NEVER, values - own_best.reshape(size, -1), NEVER)
        at = less.topk(most, dim=1).indices
        values = values.gather(1, at)
    else:
        values, at = values.max(1, keepdim=True)
    slot, push = at // count, at % count
    row = torch.arange(size, device=flat.device)[:, None] * each + slot
    rows = row.flatten()
    other = critics.one(1, _only(seen, rows), numbers[row, push].flatten(0, 1)[:, None])
    return torch.minimum(values, other.view_as(values)), pairs[0].gather(1, slot), which[row, push]


def _looked_at(tokens: Tokens, seen: Seen, moved: Tensor, drawn: Tensor, count: int) -> Tensor:
    """Indices (n, N) of the pushes to value, among those drawn (n, P)."""
    own = seen.which[:, None]
    left = tokens.after(seen.left[:, None], moved[own, drawn], own)
    far = left[..., :2].square().sum(-1) / tokens.within**2
    cost = far + (left[..., 2] / tokens.turned).square()
    half = cost.topk(count // 2, dim=1, largest=False).indices
    return torch.cat([drawn.gather(1, half), drawn[:, : count - count // 2]], dim=1)


def _only(seen: Seen, rows: Tensor) -> Seen:
    """A copy with the critics' inputs of only these rows."""
    return replace(seen, token=seen.token[rows], other=seen.other[rows], there=seen.there[rows])
