"""What sliding tokens cost: what they push off the target now, and what pushes them away later.

Legend: B environments, K tokens, M candidates, N meetings of a token with another.
"""

from dataclasses import replace

import torch
from torch import Tensor

from tangram_agent.pair_networks import PairCritic
from tangram_agent.pair_scene import Candidates, Scene


def damage(
    critic: PairCritic,
    gamma: float,
    scene: Scene,
    candidates: Candidates,
    pose: Tensor,
    value: Tensor,
) -> Tensor:
    """(M,) what sliding to poses (M, 3) costs.

    Now: each other token's worth, times the share that it is pushed away. Later, with the weight
    gamma: the candidate's own value (M,), times the share that every token which is still to come
    pushes it away on the way to the best pose known for it. So what lies in the way of others is
    placed after them. A token without a candidate is not counted.
    """
    now = _pushed_now(critic, scene, candidates, pose)
    if gamma == 0.0:
        return now
    return now + gamma * value * _pushed_later(critic, scene, candidates, pose, value)


def _pushed_now(critic: PairCritic, scene: Scene, candidates: Candidates, pose: Tensor) -> Tensor:
    """(M,) sum over other tokens of the share that each is pushed away times its worth."""
    index, token = torch.nonzero(scene.worth[candidates.row] > 0.0, as_tuple=True)
    apart = candidates.token[index] != token
    index, token = index[apart], token[apart]
    movers = candidates.at(index)
    lying = replace(movers, token=token, flip=torch.zeros(len(token)))
    where = scene.pose[movers.row, token]
    share = _pushed(critic, scene, movers, pose[index], lying, where)
    cost = share * scene.worth[movers.row, token]
    return torch.zeros(len(pose)).index_add(0, index, cost)


def _pushed_later(
    critic: PairCritic, scene: Scene, candidates: Candidates, pose: Tensor, value: Tensor
) -> Tensor:
    """(M,) sum over the tokens to come of the share that each pushes a candidate away."""
    same = candidates.row[:, None] == candidates.row
    apart = candidates.token[:, None] != candidates.token
    index, mover = torch.nonzero(same & apart & _leaders(candidates, value), as_tuple=True)
    movers, lying = candidates.at(mover), candidates.at(index)
    share = _pushed(critic, scene, movers, pose[mover], lying, pose[index])
    return torch.zeros(len(pose)).index_add(0, index, share)


def _pushed(
    critic: PairCritic,
    scene: Scene,
    movers: Candidates,
    to: Tensor,
    lying: Candidates,
    where: Tensor,
) -> Tensor:
    """(N,) shares that tokens which slide to poses (N, 3) push others, at poses (N, 3), away."""
    return critic.pushed(scene.meetings(movers, lying, where), to).clamp(0.0, 1.0)


def _leaders(candidates: Candidates, value: Tensor) -> Tensor:
    """(M,) which candidate is the best one of its token in its row, by a value (M,)."""
    key = candidates.row * (int(candidates.token.max()) + 1) + candidates.token
    best = torch.full((int(key.max()) + 1,), -torch.inf).scatter_reduce(0, key, value, "amax")
    return value >= best[key]
