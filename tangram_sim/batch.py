"""A batch of B environments that step together; every episode has exactly `horizon` actions.

Equal lengths allow plain arrays: geometry and rewards are computed once for the whole batch, and a
batch of episodes is sent as a few raw frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tangram_core.arrays import Bools, Floats, Ints, Pixels
from tangram_core.errors import ConfigError
from tangram_sim.config import MAX_OVERLAP, RewardConfig, SimConfig
from tangram_sim.episodes import spec_of
from tangram_sim.geometry.layout import Layout
from tangram_sim.geometry.overlap import covered_share, outlines, shared_area
from tangram_sim.motion.actions import (
    action_size,
    chosen_tokens,
    flips,
    goal_rows,
    horizon,
    velocities,
)
from tangram_sim.rewards import TargetPictures, make_reward, scaled_overlap
from tangram_sim.sight.perception import Eye, Sight
from tangram_sim.targets.targets import Sides, sample_starts, sample_targets
from tangram_sim.world.world import check_shown, make_world


@dataclass(frozen=True, eq=False)
class StepResult:
    """Results of one step of all environments.

    Attributes:
        rewards: (B,) by the configured reward function.
        coverage: (B,) covered share of the target in [0, 1] on exact polygons.
        camera_rewards: (B,) rewards by Eq. 14 on the pictures; None with the camera off.
        refused: (B,) whether the action named a placed token; then nothing moved.
        blocked: (B,) whether the token would have covered others too much; then nothing moved.
        tokens: (B,) number of the token that the action moved, or would have moved.
        covered: (B,) share of that token's area that overlaps others where it is set down, or
            would have been.
        done: whether the episodes are over; all end in the same step.
    """

    rewards: Floats
    coverage: Floats
    camera_rewards: Floats | None
    refused: Bools
    blocked: Bools
    tokens: Ints
    covered: Floats
    done: bool


class Starts(NamedTuple):
    """Initial states of the tokens in B episodes.

    Attributes:
        poses: (B, K, 3) x, y and angle.
        flipped: (B, K) tokens that are turned over.
        placed: (B, K) tokens that are already placed.
    """

    poses: Floats
    flipped: Bools
    placed: Bools


class BatchedEnv:
    """`count` environments in one process.

    An action ends with velocities in x, y and angle, each in [-1, 1]. With several tokens, its
    first entry names the token. With `sim.allow_flip`, the entry before the velocities turns the
    token over before it moves, if above 0 (see `actions.flips`).

    A token is placed after its `actions_per_token` actions. When all are placed, the episode is
    over: a terminal state. A single token with several actions is never placed: only a time limit
    ends its episode. An action that names a placed token is refused: nothing moves, but the step
    counts. An action is blocked if more than `MAX_OVERLAP` of the token's area would cover others:
    nothing moves, but the action counts for the token.

    Attributes:
        count: B.
        spec: names, shapes and bounds of the arrays in an episode.
        horizon: steps of an episode, K * actions_per_token.
        action_size: A.
        goal_rows: G, rows of a target as agents see it.
        steps_done: steps taken in this episode.
        corners: (B, V, 2) of the tokens.
        placed: (B, K) which tokens are placed.
        goals: (B, V, 2) corners of the targets.
        seen: `corners` as an agent sees them: exact, or found in pictures.
        seen_goals: (B, G, 2) `goals` as an agent sees them: exact, found in pictures, or rows of
            outlines (see `rings`).
        sight: tokens found in pictures; None unless `sim.observe=pictures`.
        pictures: (B, P, P) the camera's last pictures of the tokens.
    """

    def __init__(
        self,
        layout: Layout,
        sim: SimConfig,
        reward: RewardConfig,
        count: int = 1,
        eye: Eye | None = None,
        outlines: bool = False,
    ) -> None:
        """Open `count` worlds.

        Args:
            layout: the tokens.
            sim: settings of the world.
            reward: settings of the reward.
            count: B, at least 1.
            eye: function that finds tokens in a picture; needed for `sim.observe=pictures`.
            outlines: whether agents take outlines as goals; needed for `sim.observe=silhouette`.

        Raises:
            ConfigError: `sim.observe` needs an eye or outlines, and this is missing.
        """
        if count < 1:
            raise ValueError(f"count must be at least 1, got {count}")
        check_shown(sim, outlines)
        if sim.looks and eye is None:
            raise ConfigError(
                f"sim.observe={sim.observe} needs an eye, which finds tokens in pictures: set "
                "sim.observe=corners"
            )
        self.layout = layout
        self.sim = sim
        self.spec = spec_of(layout, sim, reward, outlines)
        self._reward = reward
        self.reward_fn = make_reward(reward, layout, sim)
        self.count = count
        self.horizon = horizon(layout.tokens, sim)
        self.action_size = action_size(layout.tokens, sim)
        self.goal_rows = goal_rows(layout, sim)
        self._ends_by_placing = layout.tokens > 1 or sim.actions_per_token == 1
        self._worlds = [make_world(layout, sim) for _ in range(count)]
        observed = eye if sim.looks else None
        self.sight = None if observed is None else Sight(layout, observed, count, sim.arena)
        self._targets: TargetPictures | None = None
        self.pictures: Pixels = np.zeros((count, sim.pixels, sim.pixels), np.uint8)
        self._moves: Ints = np.zeros((count, layout.tokens), dtype=np.int64)
        self.steps_done = self.horizon  # no episode yet
        self.corners: Floats = np.zeros((count, layout.corner_count, 2))
        self.goals: Floats = np.zeros((count, layout.corner_count, 2))
        self.seen, self.seen_goals = self.corners, self.goals

    @property
    def placed(self) -> Bools:
        """(B, K) which tokens are placed."""
        placed: Bools = (self._moves >= self.sim.actions_per_token) & self._ends_by_placing
        return placed

    @property
    def closed(self) -> Bools:
        """(B, K) tokens that no action should name: placed, or unseen while others are seen."""
        placed = self.placed
        if self.sight is None:
            return placed
        either = placed | self.sight.missing
        return np.where(either.all(axis=1, keepdims=True), placed, either)

    def reset(
        self,
        generators: Sequence[np.random.Generator],
        targets: Sides | None = None,
        starts: Starts | None = None,
    ) -> None:
        """Begin an episode in every environment, with a new target and a new start.

        Args:
            generators: one per environment, the only source of randomness in its episode.
            targets: poses (B, K, 3) and sides (B, K) to assemble; None: random.
            starts: initial states of the tokens; None: random, with no token placed. With
                `sim.observe=pictures` no token may be placed: equal ones cannot be told apart.

        Raises:
            SamplingError: no target or start without overlap was found.
        """
        if len(generators) != self.count:
            raise ValueError(f"need {self.count} generators, got {len(generators)}")
        if targets is None:
            targets = sample_targets(self.layout, self.sim, generators)
        self.goals = self.layout.corners(*targets)
        if starts is None:
            none = np.zeros((self.count, self.layout.tokens), np.bool_)
            starts = Starts(*sample_starts(self.layout, self.sim, targets, generators), none)
        self._begin(targets, starts)
        if self.sim.observe == "silhouette":
            self.seen_goals = self._outlined()
        elif self.sight is None:
            self.seen_goals = self.goals
        else:
            self.seen_goals = self.sight.goals
        self._look()
        self._moves[:] = self.sim.actions_per_token * starts.placed
        self.steps_done = 0

    def _outlined(self) -> Floats:
        """(B, G, 2) rows of the targets' outlines."""
        # Imported here, because most runs need no shapely.
        from tangram_sim.geometry.rings import as_rows, covered_area  # noqa: PLC0415

        areas = [covered_area(own, self.layout) for own in self.goals]
        return np.stack([as_rows(area, self.layout, self.goal_rows) for area in areas])

    def step(self, actions: Floats) -> StepResult:
        """Play one action in every environment.

        Args:
            actions: (B, A); entries are clipped to [-1, 1].

        Raises:
            ValueError: the actions have a wrong shape or are not finite.
            RuntimeError: the episodes are over, or `reset` was never called.
        """
        if self.steps_done >= self.horizon:
            raise RuntimeError(f"the episode of {self.horizon} steps is over: call reset first")
        actions = self._checked(actions)
        named = chosen_tokens(actions, self.layout.tokens)
        refused = self.placed[np.arange(self.count), named]
        self._moves[np.flatnonzero(~refused), named[~refused]] += 1
        tokens = named if self.sight is None else self.sight.hands(named, self.corners)
        velocity, flip = velocities(actions, self.sim), flips(actions, self.layout, self.sim)
        command = tokens, velocity, flip
        covered = self._covered(*command)
        blocked = (covered > MAX_OVERLAP) & ~refused
        camera = self._move(*command, refused | blocked)
        if self.sight is not None:
            self.sight.follow(self.pictures, named, np.where(refused[:, None], 0.0, velocity))
        self._look()
        self.steps_done += 1
        share = covered_share(self.corners, self.goals, self.layout)
        return StepResult(
            rewards=self._rewards(share, camera),
            coverage=share,
            camera_rewards=camera,
            refused=refused,
            blocked=blocked,
            tokens=tokens,
            covered=covered,
            done=self.steps_done == self.horizon,
        )

    def close(self) -> None:
        """Close all worlds; further calls do nothing."""
        for world in self._worlds:
            world.close()

    def _covered(self, tokens: Ints, velocity: Floats, flip: Bools) -> Floats:
        """(B,) share of each token's area that would overlap others after its motion."""
        layout, rows = self.layout, np.arange(self.count)
        if layout.tokens == 1:
            return np.zeros(self.count)
        poses, sides = self._poses.copy(), self._flipped.copy()
        poses[rows, tokens] += velocity
        sides[rows, tokens] ^= flip
        pieces = outlines(layout.corners(poses, sides), layout)
        own = np.repeat(pieces[rows, tokens], layout.tokens, axis=0)
        common = shared_area(own, pieces.reshape(own.shape)).reshape(self.count, -1)
        common[rows, tokens] = 0.0
        covered: Floats = common.sum(axis=1) / layout.areas[tokens]
        return covered

    def _begin(self, targets: Sides, starts: Starts) -> None:
        """Take pictures of the targets and put the tokens at their starts."""
        # One world after the other, here and in `_move`: the memory of one fills the CPU's cache.
        pictures = []
        for b, world in enumerate(self._worlds):
            if self.sim.pixels:
                world.place(targets[0][b], targets[1][b])
                pictures.append(world.picture())
            world.place(starts.poses[b], starts.flipped[b])
        if self.sim.pixels:
            self._targets = TargetPictures(np.stack(pictures))
        if self.sight is not None:
            self.pictures = np.stack([world.picture() for world in self._worlds])
            self.sight.begin(np.stack(pictures), self.pictures)

    def _move(self, tokens: Ints, velocity: Floats, flip: Bools, idle: Bools) -> Floats | None:
        """Move in every world; return (B,) rewards by Eq. 14 on the pictures, if any."""
        pictures = []
        for b, world in enumerate(self._worlds):
            if not idle[b]:
                world.move(int(tokens[b]), velocity[b], bool(flip[b]))
            if self.sim.pixels:
                pictures.append(world.picture())
        if self._targets is None:
            return None
        self.pictures = np.stack(pictures)
        return self._targets.rewards(self.pictures)

    def _rewards(self, share: Floats, camera: Floats | None) -> Floats:
        """(B,) configured rewards, given the coverage and the rewards from pictures."""
        observed = self._reward.source == "camera" or self.sight is not None
        if camera is not None and observed and self._reward.name == "overlap":
            return camera
        if self.sight is not None:
            return self.reward_fn(self.seen, self.seen_goals)
        if self._reward.name == "overlap":
            return scaled_overlap(share)  # as reward_fn, without computing it twice
        return self.reward_fn(self.corners, self.goals)

    def _checked(self, actions: Floats) -> Floats:
        actions = np.asarray(actions, dtype=np.float64)
        if actions.shape != (self.count, self.action_size):
            raise ValueError(
                f"actions must have shape {(self.count, self.action_size)}, got {actions.shape}"
            )
        if not np.isfinite(actions).all():
            raise ValueError("actions must be finite")
        return np.clip(actions, -1.0, 1.0)

    def _look(self) -> None:
        self._poses = np.stack([world.poses() for world in self._worlds])
        self._flipped = np.stack([world.flipped() for world in self._worlds])
        self.corners = self.layout.corners(self._poses, self._flipped)
        if self.sight is None:
            self.seen = self.corners
        else:
            self.seen = self.sight.corners
