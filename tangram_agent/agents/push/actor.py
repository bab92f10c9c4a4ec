"""The actor in workers: it plays the push of the best value.

Legend: B environments, K tokens.
"""

from functools import cached_property

import numpy as np
import torch
from torch import nn

from tangram_agent.agents.push.agent import PushingConfig
from tangram_agent.agents.push.choosing import NEVER, Search, best
from tangram_agent.agents.push.networks import Table, Twins
from tangram_agent.agents.push.scenes import PUSHES, Scene, Tokens
from tangram_agent.agents.push.seen import beside
from tangram_agent.base.acting import NetworkActor
from tangram_core.arrays import Bools, Floats, Singles
from tangram_core.spec import Array, Arrays
from tangram_core.task import Generators, History
from tangram_tasks.push.order import come_next
from tangram_tasks.push.task import Push
from tangram_tasks.push.trials import Trials, middle

CPU = torch.device("cpu")
_THEN = 32  # pushes of each token that are valued after a push that was tried in an engine
_SURE = 4  # times as many pushes are valued without exploration
_SAME = 0.003  # a token that moves and turns less counts as unmoved
_STILL = 1e-4  # if all corners move less, nothing has moved
_AGAIN = 100.0  # cost of a push that leads back to an earlier state


class Played(nn.Module):
    """The networks in a broadcast: the critics and the table of pushes."""

    def __init__(self, task: Push, width: int) -> None:
        super().__init__()
        corners = task.layout.padded_corners.shape[1]
        self.critic, self.table = Twins(corners, width), Table(task.layout.tokens)


class PushActor(NetworkActor):
    """Plays the push that the critics value most."""

    network: Played

    def __init__(self, task: Push, config: PushingConfig) -> None:
        super().__init__(Played(task, config.width))
        self._task, self._config, self._tokens = task, config, Tokens(task, CPU)

    def act(self, seen: Arrays, past: History, explore: Generators | None = None) -> Singles:
        """Actions (B, 4) for corners and goals (B, V, 2).

        While exploring, new pushes are drawn at each step, and a share of actions is random.
        """
        tokens, tried = self._tokens, self._config.tried
        corners, goals = seen["corners"], seen["goals"]
        scene = tokens.scene(corners, goals)
        drawn, any_push = self._drawn(len(corners), explore)
        times = 1 if explore is not None else _SURE
        most = max(1, tried) if explore is None else 1
        count = min(times * self._config.looked_at, PUSHES)
        search = Search(drawn, count, most, self._next(scene, corners, goals))
        values, slots, found = self._best(scene, self._pairs(scene), search)
        which = scene.which.gather(1, slots)
        if most > 1:
            options = tokens.actions[which.numpy(), found.numpy()]
            possible = (values > NEVER).numpy() & ~_made_here(corners, options, past)
            at = self._tried(corners, goals, options, possible, past)[:, None]
            which, found = which.gather(1, at), found.gather(1, at)
        chosen, pushes = (one[:, 0].numpy().copy() for one in (which, found))
        if explore is not None:
            other = any_push[:, 0] < self._config.uniform_share
            there = scene.present.sum(1).numpy()
            slot = (any_push[:, 1] * there).astype(np.int64)
            any_of = scene.which.numpy()[np.arange(len(slot)), slot]
            chosen = np.where(other, any_of, chosen)
            pushes = np.where(other, (any_push[:, 2] * PUSHES).astype(np.int64), pushes)
        actions: Singles = tokens.actions[chosen, pushes].astype(np.float32)
        return actions

    def _best(self, scene: Scene, pairs: torch.Tensor, search: Search) -> tuple[torch.Tensor, ...]:
        """See `best`."""
        with torch.no_grad():
            network = self.network
            return best(network.critic, network.table.moved, self._tokens, scene, pairs, search)

    def _next(self, scene: Scene, corners: Array, goals: Array) -> torch.Tensor:
        """(B, K) which tokens may be pushed."""
        rows = zip(corners, goals, self._task.placed(corners, goals), strict=True)
        following = np.stack([come_next(self._task.layout, *row) for row in rows])
        return torch.from_numpy(following).gather(1, scene.which)

    def _tried(
        self, corners: Array, goals: Array, actions: Floats, possible: Bools, past: History
    ) -> torch.Tensor:
        """Index (B,) of the best of pushes (B, M, 4), tried in a physics engine.

        The gain of a push is the value of the tokens that it moves afterwards, minus their value
        now. A push that leads to the present or an earlier state costs `_AGAIN`, unless it brings a
        token home. Pushes that are not possible (B, M) or that the engine refuses are excluded.
        """
        after, refused = self._followed(corners, goals, actions, possible)
        tokens, times = self._tokens, actions.shape[1]
        before = tokens.scene(corners, goals).repeated(times)
        then = tokens.scene(after.reshape(-1, *corners.shape[1:]), goals.repeat(times, axis=0))
        moved = (then.poses - before.poses).abs().amax(-1) > _SAME
        gained = (self._values(then, moved) - self._values(before, moved)).sum(1)
        comes_home = tokens.placed(then).sum(1) > tokens.placed(before).sum(1)
        nearest = np.full(refused.shape, np.inf)  # from each result to any state so far
        for moment in np.moveaxis(past.seen["corners"], 1, 0):
            np.minimum(nearest, np.abs(after - moment[:, None]).max(axis=(2, 3)), out=nearest)
        again = torch.from_numpy(nearest < self._task.config.within / 2.0).flatten() & ~comes_home
        gained = torch.where(again, gained - _AGAIN, gained)
        gained[torch.from_numpy(refused).flatten()] = -torch.inf
        return gained.view(len(corners), -1).argmax(1)

    def _followed(
        self, corners: Array, goals: Array, actions: Floats, possible: Bools
    ) -> tuple[Array, Bools]:
        """Corners (B, M, V, 2) after pushes (B, M, 4) in an engine; which (B, M) are refused."""
        known = middle(self._task)
        after = np.repeat(corners[:, None], actions.shape[1], axis=1)
        refused = ~possible
        for table in np.flatnonzero(~self._task.placed(corners, goals).all(axis=1)).tolist():
            self._trials.begin(corners[table], goals[table], known)
            for number in np.flatnonzero(possible[table]).tolist():
                found = self._trials.after(actions[table, number])
                refused[table, number] = found is None
                after[table, number] = corners[table] if found is None else found
        return after, refused

    def _values(self, scene: Scene, wanted: torch.Tensor) -> torch.Tensor:
        """Values (n, K) of the wanted tokens (n, K), each with the one beside it.

        0 for other tokens, and for those in their places.
        """
        asked = scene.present & wanted & ~self._tokens.placed(scene)
        rows, slots = asked.nonzero(as_tuple=True)
        some = scene.only(rows)
        pairs = torch.stack([slots, beside(some, slots)])[..., None]
        value = self._best(some, pairs, Search(_all_pushes(len(rows)), _THEN))[0][:, 0]
        least = -1.0 / (1.0 - self._config.gamma)
        found = torch.zeros(asked.shape)
        found[rows, slots] = value.clamp(least, -0.5)  # at least one more push is needed
        return found

    def _pairs(self, scene: Scene) -> torch.Tensor:
        """Slots (2, n, K) of all tokens, and of those beside them."""
        count = self._task.count
        slots = torch.arange(count).expand(len(scene.poses), -1)
        others = beside(scene.repeated(count), slots.flatten())
        return torch.stack([slots, others.view_as(slots)])

    @cached_property
    def _trials(self) -> Trials:
        return Trials(self._task)

    def _drawn(self, count: int, explore: Generators | None) -> tuple[torch.Tensor, Floats]:
        """Indices (B * K, P) of pushes to value, and random numbers (B, 3) in [0, 1) to explore."""
        each = self._task.count
        if explore is None:  # all of them, always in the same order
            return _all_pushes(count * each), np.ones((count, 3))
        size = (each, 2 * self._config.looked_at)
        drawn = [(one.integers(PUSHES, size=size), one.random(3)) for one in explore]
        pushes, numbers = (np.stack(part) for part in zip(*drawn, strict=True))
        return torch.from_numpy(pushes.reshape(count * each, -1)), numbers  # float64: below 1


def _made_here(corners: Array, actions: Floats, past: History) -> Bools:
    """(B, M) whether pushes (B, M, 4) were made before, when all corners (B, V, 2) were as now."""
    off = np.abs(past.seen["corners"][:, :-1] - corners[:, None])
    same = np.isclose(past.actions[:, None], actions[:, :, None]).all(axis=-1)
    made: Bools = (same & (off.max(axis=(2, 3)) < _STILL)[:, None]).any(axis=-1)
    return made


def _all_pushes(rows: int) -> torch.Tensor:
    """Indices (rows, 1024) of all pushes, in the same order in each row."""
    return torch.arange(PUSHES).expand(rows, -1)
