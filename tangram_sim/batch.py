"""B environments that play in step: every episode has exactly `horizon` actions.

Episodes of equal length keep everything an array: geometry and rewards are computed once for the
whole batch, and a batch of episodes travels as a few raw frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tangram_sim.arrays import Bools, Floats, Ints
from tangram_sim.config import RewardConfig, SimConfig
from tangram_sim.geometry import overlap_share
from tangram_sim.layout import Layout
from tangram_sim.rewards import TargetPictures, make_reward, scaled_overlap
from tangram_sim.sampling import sample_batch
from tangram_sim.sensing import noise_bound, see
from tangram_sim.world import make_world

_ROUNDING = 1.0 + 1e-6


@dataclass(frozen=True, eq=False)
class StepResult:
    """What one step of all environments gave.

    Attributes:
        rewards: (B,) of the configured reward.
        overlap: (B,) raw overlap in [0, 1] on exact polygons.
        camera_rewards: (B,) Eq. 14 from the pictures, or None with the camera off.
        refused: (B,) where the action named a placed token: nothing moved.
        done: whether the episodes are over, all at once.
    """

    rewards: Floats
    overlap: Floats
    camera_rewards: Floats | None
    refused: Bools
    done: bool


def action_size(tokens: int) -> int:
    """A: 3 velocities, and before them which token to move if there are several."""
    return 3 if tokens == 1 else 4


def horizon(tokens: int, sim: SimConfig) -> int:
    """T: the actions of an episode, which is over when every token has had its own."""
    return tokens * sim.actions_per_token


def corner_bound(sim: SimConfig) -> float:
    """The largest |coordinate| that a corner can reach in an episode, arena units.

    A start lies inside the arena, and each action moves a token by at most the arena's width in x
    and in y; turning keeps a corner within the start's margin for every angle. What an agent sees
    may lie further out by the noise's bound.
    """
    return (sim.arena * (0.5 + sim.actions_per_token) + noise_bound(sim)) * _ROUNDING


def chosen_tokens(actions: Floats, tokens: int) -> Ints:
    """(B,) the token that each action (B, A) moves: the first entry cuts [-1, 1] into K parts."""
    if tokens == 1:
        return np.zeros(len(actions), dtype=np.int64)
    share = (np.asarray(actions)[:, 0] + 1.0) / 2.0
    return np.clip(np.floor(share * tokens), 0, tokens - 1).astype(np.int64)


def velocities(actions: Floats, sim: SimConfig) -> Floats:
    """(B, 3) of actions (B, A): full scale crosses the arena and makes half a turn in a second.

    So one action can reach every pose of the arena from every other.
    """
    scale = np.array([sim.arena, sim.arena, np.pi])
    scaled: Floats = np.asarray(actions, dtype=np.float64)[:, -3:] * scale
    return scaled


class BatchedEnv:
    """`count` environments in one process.

    An action is (x, y, angular velocity) in [-1, 1], with one entry before them that names the
    token if there are several. A token that had its `actions_per_token` actions is placed. An
    action that names a placed token is refused: it moves nothing, but uses up its step.

    Attributes:
        count: B.
        horizon: steps of an episode, K * actions_per_token.
        action_size: A.
        bound: largest |coordinate| that a corner can reach, arena units.
        steps_done: steps taken in this episode.
        corners: (B, V, 2) of the tokens.
        placed: (B, K) which tokens are placed.
        goals: (B, V, 2) corners of the targets.
        seen: `corners` as an agent sees them, new noise at every step if there is any.
        seen_goals: `goals` as an agent sees them, with one noise for the whole episode.
    """

    def __init__(
        self, layout: Layout, sim: SimConfig, reward: RewardConfig, count: int = 1
    ) -> None:
        if count < 1:
            raise ValueError(f"count must be at least 1, got {count}")
        self.layout = layout
        self.sim = sim
        self._reward = reward
        self.reward_fn = make_reward(reward, layout, sim)
        self.count = count
        self.horizon = horizon(layout.tokens, sim)
        self.action_size = action_size(layout.tokens)
        self.bound = corner_bound(sim)
        self._worlds = [make_world(layout, sim) for _ in range(count)]
        self._targets: TargetPictures | None = None
        self._moves: Ints = np.zeros((count, layout.tokens), dtype=np.int64)
        self.steps_done = self.horizon  # no episode yet
        self.corners: Floats = np.zeros((count, layout.corner_count, 2))
        self.goals: Floats = np.zeros((count, layout.corner_count, 2))
        self.seen, self.seen_goals = self.corners, self.goals
        self._generators: Sequence[np.random.Generator] = ()

    @property
    def placed(self) -> Bools:
        """(B, K), see the class."""
        placed: Bools = self._moves >= self.sim.actions_per_token
        return placed

    def reset(self, generators: Sequence[np.random.Generator]) -> None:
        """Begin an episode in every environment: a new target and a new start.

        Args:
            generators: one per environment; all of the episode's randomness comes from it.

        Raises:
            SamplingError: no layout without overlap was found.
        """
        if len(generators) != self.count:
            raise ValueError(f"need {self.count} generators, got {len(generators)}")
        targets = sample_batch(self.layout, self.sim, generators)
        starts = sample_batch(self.layout, self.sim, generators)
        self._begin(targets, starts)
        self._generators = generators
        self.goals = self.layout.corners(targets)
        self.seen_goals = see(self.goals, self.sim, generators)
        self._look(np.stack([world.poses() for world in self._worlds]))
        self._moves[:] = 0
        self.steps_done = 0

    def step(self, actions: Floats) -> StepResult:
        """Play one action in every environment.

        Args:
            actions: (B, A); entries beyond [-1, 1] count as the bound.

        Raises:
            ValueError: wrong shape, or not finite.
            RuntimeError: the episodes are over, or none was begun.
        """
        if self.steps_done >= self.horizon:
            raise RuntimeError(f"the episode of {self.horizon} steps is over: call reset first")
        actions = self._checked(actions)
        tokens = chosen_tokens(actions, self.layout.tokens)
        refused = self.placed[np.arange(self.count), tokens]
        self._moves[np.flatnonzero(~refused), tokens[~refused]] += 1
        camera = self._move(tokens, velocities(actions, self.sim), refused)
        self.steps_done += 1
        return self._result(refused, camera)

    def close(self) -> None:
        """Close all worlds; calling it twice does no harm."""
        for world in self._worlds:
            world.close()

    def _begin(self, targets: Floats, starts: Floats) -> None:
        """Photograph the targets and put the tokens at their starts."""
        # World after world, here and in `_move`: the engine's memory of each fills the cache.
        pictures = []
        for world, target, start in zip(self._worlds, targets, starts, strict=True):
            if self.sim.camera:
                world.place(target)
                pictures.append(world.picture())
            world.place(start)
        if self.sim.camera:
            self._targets = TargetPictures(np.stack(pictures))

    def _move(self, tokens: Ints, velocity: Floats, refused: Bools) -> Floats | None:
        """Move in every world and look at it; (B,) Eq. 14 of the pictures with the camera on."""
        poses, pictures = [], []
        for b, world in enumerate(self._worlds):
            if not refused[b]:
                world.move(int(tokens[b]), velocity[b])
            poses.append(world.poses())
            if self.sim.camera:
                pictures.append(world.picture())
        self._look(np.stack(poses))
        return None if self._targets is None else self._targets.rewards(np.stack(pictures))

    def _result(self, refused: Bools, camera: Floats | None) -> StepResult:
        share = overlap_share(self.corners, self.goals, self.layout)
        if camera is not None and self._reward.source == "camera":
            rewards = camera
        elif self._reward.name == "overlap":
            rewards = scaled_overlap(share)  # what reward_fn gives, without doing it twice
        else:
            rewards = self.reward_fn(self.corners, self.goals)
        return StepResult(
            rewards=rewards,
            overlap=share,
            camera_rewards=camera,
            refused=refused,
            done=self.steps_done == self.horizon,
        )

    def _checked(self, actions: Floats) -> Floats:
        actions = np.asarray(actions, dtype=np.float64)
        if actions.shape != (self.count, self.action_size):
            raise ValueError(
                f"actions must have shape {(self.count, self.action_size)}, got {actions.shape}"
            )
        if not np.isfinite(actions).all():
            raise ValueError("actions must be finite")
        return np.clip(actions, -1.0, 1.0)

    def _look(self, poses: Floats) -> None:
        self.corners = self.layout.corners(poses)
        self.seen = see(self.corners, self.sim, self._generators)
