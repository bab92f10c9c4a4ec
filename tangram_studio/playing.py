"""One move after the other: a player chooses a token and a motion, the engine moves it.

What is carried is moved by the agent, what is pushed by a rule that learned nothing.

Nothing is kept between two moves but what is given, so a page may change the scene at any time.
"Placed" is what lies in its piece: what was dragged or pushed away is moved again.

Legend: K tokens, F frames.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch

from tangram_agent.runs import Run, load_changed
from tangram_core.arrays import Bools, Floats, Singles
from tangram_core.task import History
from tangram_sim.batch import BatchedEnv, Starts
from tangram_sim.config import RewardConfig
from tangram_sim.geometry.overlap import overlap_share
from tangram_sim.motion.actions import chosen_tokens
from tangram_sim.world.world import World, make_world
from tangram_tasks.metrics import iou
from tangram_tasks.pairing import paired
from tangram_tasks.rivals.sweeps import sweep_policy
from worker.play.rollout import greedy

AGENT = "pretrained/tangram7"
SIM = {"lift": {}, "slide": {"motion": "slide", "actions_per_token": 2}}
PARTS = 20  # of a push, as it is shown
_NEAR, _STRAIGHT = 0.01, 0.03  # arena units and radians: what lies in its piece
_STILL = 1e-3  # what moved less has not moved
_SEEDS = 2**31


class Sides(NamedTuple):
    """Poses (K, 3), and (K,) which tokens lie on their other side."""

    poses: Floats
    flipped: Bools


@dataclass(frozen=True, eq=False)
class Round:
    """What was done since the tokens had all their actions: the agent may use each of them again.

    Attributes:
        corners: (T, V, 2) of the tokens before each action.
        actions: (T, A).
    """

    corners: Singles
    actions: Singles


@dataclass(frozen=True, eq=False)
class Move:
    """What one move came to.

    Attributes:
        token: that was moved; None where none was.
        frames: (F, K, 3) poses at equal times of a second, the first before it and the last after.
        blocked: the token could not be set down on others, and lies where it was.
        coverage: share of the figure that is covered after it.
        iou: area that tokens and figure share over the area of both together.
        done: the round until now.
        ended: no token has an action left in this round.
    """

    token: int | None
    frames: Floats
    blocked: bool
    coverage: float
    iou: float
    done: Round
    ended: bool


class _Player:
    """Who moves tokens, and the arena."""

    def __init__(self, motion: str) -> None:
        torch.set_num_threads(1)  # more are slower for so little, above all beside other work
        self.run: Run = load_changed(AGENT, {"sim": SIM[motion]})
        task = self.run.task
        self.layout, self.motion = task.layout, motion
        sim = replace(task.sim.blind, starts="outside")
        self.env = BatchedEnv(self.layout, sim, RewardConfig(), 1)
        slides = motion == "slide"
        self.choose = sweep_policy(self.layout, sim) if slides else greedy(self.run.actor)
        self._shown: World | None = make_world(self.layout, sim) if slides else None

    def frames(self, before: Floats, after: Floats, flipped: Bools, token: int) -> Floats:
        """(F, K, 3) of a move: what is carried goes straight, a push is played again in parts."""
        if self._shown is None:
            return np.stack([before, after])
        way = (after - before)[token]
        way[2] = (way[2] + np.pi) % (2.0 * np.pi) - np.pi
        self._shown.place(before, flipped)
        frames = [before]
        for _ in range(PARTS - 1):
            self._shown.move(token, way / PARTS)
            frames.append(self._shown.poses())
        return np.stack([*frames, after])


@lru_cache(maxsize=2)
def player(motion: str) -> _Player:
    """Who carries tokens, or pushes them."""
    return _Player(motion)


def begin(goal: Sides, motion: str, seed: int) -> Floats:
    """(K, 3) where the tokens lie at first, anywhere beside the figure.

    Raises:
        SamplingError: they find no room.
    """
    env = player(motion).env
    env.reset([np.random.default_rng(seed % _SEEDS)], (goal.poses[None], goal.flipped[None]))
    poses: Floats = env.layout.poses(env.corners)[0]
    return poses


def _nothing_done() -> Round:
    env = player("lift").env
    corners = np.zeros((0, env.layout.corner_count, 2), np.float32)
    return Round(corners, np.zeros((0, env.action_size), np.float32))


def next_move(scene: Sides, goal: Sides, motion: str, done: Round | None) -> Move:
    """The next move.

    Args:
        scene: the tokens as they lie.
        goal: the figure.
        motion: carried or pushed.
        done: the round until now; None: nothing yet.
    """
    done = _nothing_done() if done is None else done
    own = player(motion)
    env, layout = own.env, own.layout
    used = np.bincount(
        chosen_tokens(done.actions.astype(np.float64), layout.tokens), minlength=layout.tokens
    )
    placed = used >= env.sim.actions_per_token
    if motion == "lift":  # what is pushed may have to make room
        placed |= _placed(scene, goal)
    starts = Starts(scene.poses[None], scene.flipped[None], placed[None])
    targets = goal.poses[None], goal.flipped[None]
    env.reset([np.random.default_rng(0)], targets, starts=starts)
    token, blocked, frames = None, False, scene.poses[None]
    if not placed.all():
        before = layout.poses(env.corners)[0]
        here = env.corners.astype(np.float32)
        corners = np.concatenate([done.corners, here])[None]
        past = History({"corners": corners}, done.actions[None])
        seen = {"corners": env.seen, "placed": env.closed, "goals": env.seen_goals}
        actions = own.choose(seen, past, [])
        result = env.step(actions.astype(np.float64))
        done = Round(np.concatenate([done.corners, here]), np.concatenate([done.actions, actions]))
        after = layout.poses(env.corners)[0]
        if result.blocked[0] or np.abs(after - before).max() > _STILL:
            token, blocked = int(result.tokens[0]), bool(result.blocked[0])
            frames = own.frames(before, after, scene.flipped, token)
    coverage = overlap_share(env.corners, env.goals, layout)
    shared = float(iou(layout, env.corners, coverage)[0])
    return Move(token, frames, blocked, float(coverage[0]), shared, done, bool(placed.all()))


def _placed(scene: Sides, goal: Sides) -> Bools:
    """(K,) tokens that lie in their pieces."""
    layout = player("lift").layout
    here, there = (layout.corners(one.poses, one.flipped)[None] for one in (scene, goal))
    pairing = paired(layout, here, there)
    far = np.linalg.norm(pairing.way[0, :, :2], axis=-1)
    placed: Bools = (
        (far < _NEAR) & (np.abs(pairing.way[0, :, 2]) < _STRAIGHT) & ~pairing.other_side[0]
    )
    return placed
