"""Play single moves: an agent chooses a token and a motion, and the engine moves the token.

One agent carries tokens. Another one leads a finger that pushes them.

A page may change the scene at any time. So a move depends only on its arguments. A token is
"placed" if it lies in its piece. A token that was dragged or pushed away is moved again.

Legend: K tokens, F frames.
"""

from contextlib import closing
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple, cast

import numpy as np
import torch

from tangram_agent.runs import Run, load_changed, load_run
from tangram_core.arrays import Bools, Floats, Singles
from tangram_core.task import History
from tangram_sim.batch import BatchedEnv, Starts
from tangram_sim.config import RewardConfig
from tangram_sim.geometry.overlap import covered_share
from tangram_sim.motion.actions import chosen_tokens
from tangram_sim.world.pushing import PushTable
from tangram_tasks.metrics import iou
from tangram_tasks.pairing import paired
from tangram_tasks.push.env import PushEnv
from tangram_tasks.push.places import push_of
from tangram_tasks.push.task import Push

AGENT, FINGER = "pretrained/tangram7", "pretrained/hand"
PARTS = 20  # steps of a push that a page shows
_NEAR, _STRAIGHT = 0.01, 0.03  # a token this near to its piece (arena units, radians) is placed
_STILL = 1e-3  # a token that moved less has not moved
_SEEDS = 2**31


class Sides(NamedTuple):
    """Poses (K, 3) of tokens, and whether each is turned over (K,)."""

    poses: Floats
    flipped: Bools


class Action(NamedTuple):
    """An action of a round: its token, and what the agent saw and chose.

    With a token that is turned over, the finger's agent sees a mirror image.

    Attributes:
        token: index of the token.
        corners: (V, 2) of the tokens before it.
        chosen: (A,) the agent's action.
    """

    token: int
    corners: Floats
    chosen: Singles


@dataclass(frozen=True, eq=False)
class Move:
    """The result of one move.

    Attributes:
        token: index of the token that was moved; None if none was.
        frames: (F, K, 3) poses at equal time steps, from before the move to after it.
        finger: (F, 2) places of the finger at these times; None if tokens are carried.
        blocked: whether other tokens were in the way, so that the token lies where it was.
        coverage: share of the figure that is covered after the move.
        iou: intersection over union of tokens and figure after the move.
        done: actions of this round, this one included.
        ended: whether no token has an action left in this round.
    """

    token: int | None
    frames: Floats
    blocked: bool
    coverage: float
    iou: float
    done: tuple[Action, ...]
    ended: bool
    finger: Floats | None = None


class _Player:
    """The agent that carries tokens, and its arena."""

    def __init__(self) -> None:
        torch.set_num_threads(1)  # more threads are slower for so small a network
        self.run: Run = load_run(AGENT)
        self.layout = self.run.task.layout
        sim = replace(self.run.task.sim.blind, starts="outside")
        self.env = BatchedEnv(self.layout, sim, RewardConfig(), 1)


class _Finger:
    """The agent that pushes tokens, on a table of unknown friction."""

    def __init__(self) -> None:
        torch.set_num_threads(1)
        self._run: Run = load_changed(FINGER, {"task": {"count": 0}})
        self._task = cast("Push", self._run.setup.task)
        with closing(PushEnv(self._task, 1)) as env:
            env.reset([np.random.default_rng(0)])
            self._unknowns = env.unknowns[0]
        self._table = PushTable(self._task.layout, self._task.config.finger)
        self.most = self._task.spec.horizon

    def push(
        self, scene: Sides, goal: Sides, done: tuple[Action, ...]
    ) -> tuple[Action, Floats, Floats] | None:
        """The next push: the action, frames (F, K, 3), and places of the finger (F, 2).

        None if all tokens are placed, or if the finger cannot come down. The agent knows the pushes
        of this round, so it does not repeat a push that had no effect.

        No push turns a token over. If one is turned over, the push is computed in a mirror image.
        """
        layout, config = self._task.layout, self._task.config
        image = bool((scene.flipped & layout.chiral).any())
        if image:
            scene, goal = (Sides(*layout.mirrored(*one)) for one in (scene, goal))
        corners, goals = (layout.corners(one.poses) for one in (scene, goal))
        if self._task.placed(corners[None], goals[None]).all():
            return None
        seen = {"corners": corners[None], "goals": goals[None]}
        moments = np.stack([*(one.corners for one in done), corners])[None]
        actions = np.reshape([one.chosen for one in done], (1, -1, 4)).astype(np.float32)
        action = self._run.act(seen, History({"corners": moments}, actions))
        push = push_of(layout, corners, action[0], config.finger, config.longest)
        if push.refused:
            return None
        self._table.place(scene.poses, np.ones(layout.tokens, np.bool_), self._unknowns)
        path = push.begin + np.linspace(0.0, 1.0, PARTS + 1)[:, None] * push.way
        frames = np.repeat(scene.poses[None], len(path), axis=0)
        for at in self._table.follow(path):
            frames[at:] = self._table.poses()
        if image:
            frames, path = layout.mirrored(frames, scene.flipped)[0], path * (1.0, -1.0)
        token = int(chosen_tokens(action.astype(np.float64), layout.tokens)[0])
        return Action(token, corners, action[0]), frames, path


@lru_cache(maxsize=1)
def player() -> _Player:
    """The agent that carries tokens, loaded once."""
    return _Player()


@lru_cache(maxsize=1)
def finger() -> _Finger:
    """The agent that pushes tokens, loaded once."""
    return _Finger()


def begin(goal: Sides, seed: int) -> Floats:
    """(K, 3) random poses of the tokens beside the figure.

    Raises:
        SamplingError: there is no room for the tokens.
    """
    env = player().env
    env.reset([np.random.default_rng(seed % _SEEDS)], (goal.poses[None], goal.flipped[None]))
    poses: Floats = env.layout.poses(env.corners)[0]
    return poses


def next_move(scene: Sides, goal: Sides, motion: str, done: tuple[Action, ...]) -> Move:
    """The next move towards a figure.

    Args:
        scene: the tokens as they lie.
        goal: the figure.
        motion: lift to carry a token, push to push it.
        done: actions of this round. A round carries each token once, or has as many pushes as an
            episode.
    """
    return (_push if motion == "push" else _carry)(scene, goal, done)


def _carry(scene: Sides, goal: Sides, done: tuple[Action, ...]) -> Move:
    own = player()
    env, layout = own.env, own.layout
    placed = _placed(scene, goal)
    placed[[one.token for one in done]] = True
    starts = Starts(scene.poses[None], scene.flipped[None], placed[None])
    targets = goal.poses[None], goal.flipped[None]
    env.reset([np.random.default_rng(0)], targets, starts=starts)
    token, blocked, frames = None, False, scene.poses[None]
    if not placed.all():
        corners, before = env.corners[0].copy(), layout.poses(env.corners)[0]
        seen = {"corners": env.seen, "placed": env.closed, "goals": env.seen_goals}
        action = own.run.act(seen)
        result = env.step(action.astype(np.float64))
        tried = int(result.tokens[0])
        done = (*done, Action(tried, corners, action[0]))
        after = layout.poses(env.corners)[0]
        if result.blocked[0] or np.abs(after - before).max() > _STILL:
            token, blocked, frames = tried, bool(result.blocked[0]), np.stack([before, after])
    scores = _scores(Sides(frames[-1], scene.flipped), goal)
    return Move(token, frames, blocked, *scores, done, bool(placed.all()))


def _push(scene: Sides, goal: Sides, done: tuple[Action, ...]) -> Move:
    own = finger()
    found = own.push(scene, goal, done) if len(done) < own.most else None
    if found is None:
        return Move(None, scene.poses[None], False, *_scores(scene, goal), done, ended=True)
    action, frames, path = found
    scores = _scores(Sides(frames[-1], scene.flipped), goal)
    done = (*done, action)
    return Move(action.token, frames, False, *scores, done, ended=False, finger=path)


def _scores(scene: Sides, goal: Sides) -> tuple[float, float]:
    """Coverage and IoU."""
    layout = player().layout
    here, there = (layout.corners(one.poses, one.flipped)[None] for one in (scene, goal))
    coverage = covered_share(here, there, layout)
    return float(coverage[0]), float(iou(layout, here, coverage)[0])


def _placed(scene: Sides, goal: Sides) -> Bools:
    """(K,) whether a token lies in its piece."""
    layout = player().layout
    here, there = (layout.corners(one.poses, one.flipped)[None] for one in (scene, goal))
    pairing = paired(layout, here, there)
    far = np.linalg.norm(pairing.way[0, :, :2], axis=-1)
    placed: Bools = (
        (far < _NEAR) & (np.abs(pairing.way[0, :, 2]) < _STRAIGHT) & ~pairing.other_side[0]
    )
    return placed
