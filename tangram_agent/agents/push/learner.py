"""The learner in the master: Q-learning with hindsight over a sample of pushes.

Values count two tokens, the pushed one and the one beside it: as if no other token were pushed
until both are in place. To push a third token out of its place has a fixed cost.

Legend: B transitions, K tokens, V corners, P pushes drawn for each token.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from tangram_agent.agents.push.actor import Played
from tangram_agent.agents.push.agent import PushingConfig
from tangram_agent.agents.push.choosing import Search, best
from tangram_agent.agents.push.networks import Alone, Twins
from tangram_agent.agents.push.scenes import PUSHES, Scene, Tokens, rotated
from tangram_agent.agents.push.seen import beside, pushes, seen_by
from tangram_agent.base.learning import Loss, NetworkLearner, Rates
from tangram_agent.flat.config import EpisodeConfig
from tangram_agent.flat.replay import EpisodeReplay
from tangram_agent.nets.weights import to_arrays
from tangram_core.agent import Streams, Tensors
from tangram_core.arrays import Ints
from tangram_core.spec import TERMINATED, Array, Arrays, Episodes
from tangram_tasks.push.places import ways_of
from tangram_tasks.push.task import Push

_DRAWN = 96  # P: drawn pushes, from which a target takes those that it values
_PAIR = 2  # tokens whose pushes a target values
_LOST = 2.0  # cost of a third token that is pushed out of place: pushes that bring it back
_RENEWED = 20  # updates between two renewals of the table of pushes
_LAST = 0.1  # share of the learning rate that is left at the end of a budget
_LOOKED_AT = 8  # pushes of each token that a target values
_SOME_SHARE = 0.3  # share of hindsight goals that replace the goals of only some tokens
_STILL = 1e-4  # a token that moves less did not move
_TURN = 0.2  # length that a turn by one radian counts as


@dataclass(frozen=True, eq=False)
class Batch:
    """A batch for the losses.

    Attributes:
        poses, following, goals: (B, K, 3) poses of tokens before and after the push, and goals.
        which, present: (B, K) see `Scene`.
        slots, others: (B,) slots of the pushed token, and of the one beside it.
        begins, ends: (B, 2) first and last position of the finger, on the table.
        drawn: (2 * B, P) indices of drawn pushes, among which the target finds the next one.
    """

    poses: Tensor
    following: Tensor
    goals: Tensor
    which: Tensor
    present: Tensor
    slots: Tensor
    others: Tensor
    begins: Tensor
    ends: Tensor
    drawn: Tensor

    @property
    def arrays(self) -> Arrays:
        """The arrays of the batch, by name."""
        return {name: one.cpu().numpy() for name, one in vars(self).items()}

    def at(self, poses: Tensor) -> Scene:
        """The scene with tokens at the given poses."""
        return Scene(poses, self.goals, self.which, self.present)


class PushReplay(EpisodeReplay):
    """Replay buffer whose hindsight goals are reached poses of all tokens, or of some."""

    def chosen(self, config: EpisodeConfig, rng: Streams) -> tuple[Ints, Ints, Array]:
        """Draw episodes (B,), steps (B,) before their termination, and goals (B, V, 2).

        Raises:
            ValueError: the replay is empty.
        """
        slots = self._slots()
        if not len(slots):
            raise ValueError("cannot sample from an empty replay")
        first = np.cumsum(self._lengths[slots])
        drawn = rng["replay"].integers(first[-1], size=config.batch_size)
        at = np.searchsorted(first, drawn, side="right")
        rows = slots[at]
        ends = self._lengths[rows]
        steps = drawn - first[at] + ends
        return rows, steps, self.goals(config, rows, steps, ends, rng["hindsight"])[0]

    def relabelled(self, desired: Array, reached: Array, rng: np.random.Generator) -> Array:
        """See `EpisodeReplay.relabelled`."""
        layout = self._task.layout  # type: ignore[attr-defined]
        own = rng.random((len(desired), layout.tokens)) < 0.5
        own |= (rng.random(len(desired)) >= _SOME_SHARE)[:, None]
        mask = own[:, layout.token_of_corner, None]
        return np.where(mask, reached, desired)

    def _look(self, slots: Ints) -> None:
        """Store the lengths of new episodes."""
        ends = {TERMINATED: self.arrays[TERMINATED][slots]}
        self._lengths[slots] = Episodes(ends).lengths

    @cached_property
    def _lengths(self) -> Ints:
        return np.zeros(self.capacity, np.int64)


class PushLearner(NetworkLearner):
    """Learner of the critics, and of the model of a token that is pushed alone."""

    replay: PushReplay

    def __init__(
        self, task: Push, config: PushingConfig, seed: int, device: str, *, compiled: bool = False
    ) -> None:
        """Initialise the networks from a seed and make an empty replay buffer."""
        self.config, self.polyak, self._task = config, config.polyak, task
        place = torch.device(device)
        self._tokens = Tokens(task, place)
        self.replay = PushReplay(task, config.replay_capacity)
        self.capacity = self.replay.capacity * task.spec.horizon
        corners = task.layout.padded_corners.shape[1]
        with torch.random.fork_rng(devices=[]):  # leaves torch's global generator unchanged
            torch.default_generator.manual_seed(seed)
            played, self.alone = Played(task, config.width), Alone(corners, config.width)
        self.critic, self.table = played.critic, played.table
        learned = {"critic": self.critic, "alone": self.alone}
        others = {"table": self.table}
        super().__init__(learned, ("critic",), device, compiled=compiled, others=others)
        self.table.renew(self.alone, self._tokens)  # with zeros all pushes would look alike

    def rates(self, share: float) -> Rates:
        """Equal rates for all networks; they fall along a cosine as the budget is used."""
        falls = 0.5 * (1.0 + math.cos(math.pi * min(max(share, 0.0), 1.0)))
        rate = self.config.learning_rate * (_LAST + (1.0 - _LAST) * falls)
        return Rates(rate, rate, 0.0)

    @property
    def kept(self) -> int:
        """Number of transitions in the replay buffer."""
        return len(self.replay) * self._task.spec.horizon

    def insert(self, episodes: Episodes, rng: Streams) -> int:  # noqa: ARG002
        """Add whole episodes; their goals are relabelled when a batch is drawn."""
        self.put_back()
        self.replay.add(episodes)
        return int(episodes.lengths.sum())

    def update(self, share: float, rng: Streams) -> dict[str, float]:
        """Make one update of all networks; every 20th time renew the table of pushes."""
        numbers = super().update(share, rng)
        if self.updates % _RENEWED == 0:
            self.table.renew(self.alone, self._tokens)
        return numbers

    def drawn(self, rng: Streams) -> Batch:
        """Draw the batch of an update from the replay buffer."""
        task, config, arrays = self._task, self.config, self.replay.arrays
        rows, steps, desired = self.replay.chosen(config, rng)
        before, following = (arrays["corners"][rows, steps + i] for i in (0, 1))
        actions = arrays["actions"][rows, steps]
        finger, longest = task.config.finger, task.config.longest
        corners = before.astype(np.float64)
        pushed, begins, ways = ways_of(task.layout, corners, actions, finger, longest)
        scene = self._tokens.scene(before, desired)
        slots = (scene.which == self.tensor(pushed, np.int64)[:, None]).int().argmax(1)
        size = (_PAIR * config.batch_size, _DRAWN)
        self.batch = batch = Batch(
            scene.poses,
            self._tokens.poses(following, scene.which),
            scene.goals,
            scene.which,
            scene.present,
            slots,
            beside(scene, slots),
            self.tensor(begins),
            self.tensor(begins + ways),
            self.tensor(rng["replay"].integers(PUSHES, size=size), np.int64),
        )
        return batch

    def blanks(self) -> Iterator[Batch]:
        """An example batch to compile for: all tokens at the middle of the table."""
        size, count = self.config.batch_size, self._task.count
        poses = torch.zeros(size, count, 3, device=self.place)
        which = torch.zeros(size, count, dtype=torch.int64, device=self.place)
        ways = torch.zeros(size, 2, device=self.place)
        drawn = torch.zeros(_PAIR * size, _DRAWN, dtype=torch.int64, device=self.place)
        scene = poses, poses.clone(), poses.clone(), which, which == 0
        push = which[:, 0].clone(), which[:, 0].clone(), ways, ways.clone()
        yield Batch(*scene, *push, drawn)

    def losses(self, seen: Batch) -> Iterator[Loss]:
        """Yield the loss of the model of tokens pushed alone, then that of the critics."""
        tokens = self._tokens
        with torch.no_grad():
            target = self._target(seen)
            view = seen_by(tokens, seen.at(seen.poses), seen.slots, seen.others)
            turn = -view.pose[:, 2]
            ends = (rotated(at - view.pose[:, :2], turn) for at in (seen.begins, seen.ends))
            begin, end = ends
        moved = self.alone(tokens.outlines[view.which], begin, end)
        yield self._alone(seen, moved)
        moved = moved.detach()
        with torch.no_grad():
            numbers, _ = pushes(tokens, view, begin[:, None], end[:, None], moved[:, None])
        values = self.critic(view, numbers)[..., 0]
        error = (values - target).square().mean(1).sum()
        yield Loss("critic", error, {"q": values.mean()})

    def _target(self, seen: Batch) -> Tensor:
        """Targets (B,) r + gamma (1 - d) max Q', clamped to the possible sums of rewards."""
        tokens, config = self._tokens, self.config
        critic: Twins = self.targets["critic"]  # type: ignore[assignment]
        scene, count = seen.at(seen.following), _LOOKED_AT
        pair = torch.stack([seen.slots, seen.others], dim=1)
        pairs = torch.stack([pair, pair.flip(1)])
        search = Search(seen.drawn, count)
        value = best(critic, self.table.moved, tokens, scene, pairs, search)[0][:, 0]
        least = -1.0 / (1.0 - config.gamma)
        before, after = (tokens.placed(one) for one in (seen.at(seen.poses), scene))
        lost = (before & ~after & scene.present).scatter(1, pair, value=False).sum(1)
        there, placed = scene.present.gather(1, pair), after.gather(1, pair)
        reward = (
            (placed & there).sum(1) / there.sum(1).clamp_min(1) - 1.0 - _LOST * lost
        )  # as in the task
        goes_on = ~(placed | ~there).all(1)
        target = reward + config.gamma * goes_on * value.clamp(least, 0.0)
        return target.clamp(least, 0.0)

    def _alone(self, seen: Batch, moved: Tensor) -> Loss:
        """The loss of the model of tokens pushed alone, over pushes that moved no other token."""
        rows = torch.arange(len(moved), device=moved.device)
        still = (seen.following - seen.poses).abs().amax(-1) < _STILL
        pushed = torch.arange(still.shape[1], device=moved.device) == seen.slots[:, None]
        counts = (still != pushed).all(1)
        before, after = seen.poses[rows, seen.slots], seen.following[rows, seen.slots]
        way = rotated(after[:, :2] - before[:, :2], -before[:, 2])
        turn = torch.remainder(after[:, 2] - before[:, 2] + np.pi, 2.0 * np.pi) - np.pi
        true = torch.cat([way, turn[:, None] * _TURN], dim=1)
        found = torch.cat([moved[:, :2], moved[:, 2:] * _TURN], dim=1)
        size = functional.smooth_l1_loss(found, true, reduction="none", beta=0.02)
        mean = (size.sum(1) * counts).sum() / counts.sum().clamp_min(1)
        return Loss("alone", mean, {"alone": counts.to(moved.dtype).mean()})

    def broadcast(self) -> Tensors:
        """The averaged critics and the table of pushes."""
        averaged = to_arrays(self.targets["critic"])
        critic = {f"critic.{name}": value for name, value in averaged.items()}
        return {**critic, "table.moved": to_arrays(self.table)["moved"]}
