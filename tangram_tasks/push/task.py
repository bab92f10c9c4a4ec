"""Task `push`: a finger pushes tokens into place, with hidden friction in each episode.

Legend: E episodes, T pushes of an episode, K tokens, V corners, n rows.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, ClassVar, cast

import numpy as np

from tangram_core.arrays import Bools, Floats, Ints, Pixels
from tangram_core.errors import ConfigError
from tangram_core.scores import Score
from tangram_core.settings import LEARNING, Settings, setting, told
from tangram_core.spec import Array, EpisodeSpec, Field
from tangram_core.task import Chooser, Env, Json, Played, Purpose, Task
from tangram_sim.config import MIN_PIXELS
from tangram_sim.geometry.layout import Layout, TokensConfig, make_layout
from tangram_tasks.push.places import ARENA, begin, errors, figures_of, on_table

if TYPE_CHECKING:
    from tangram_tasks.push.env import PushEnv

PER_TOKEN = 8  # pushes of an episode for each token
FURTHEST = 8.0  # largest coordinate of a corner; only errors lie beyond
PICTURES, PIXELS = 12, 216
DRAWS = 8  # layouts that must find room before a run begins


@dataclass(frozen=True)
class PushConfig(Settings, section="task"):
    """Tokens and finger, their hidden friction, and the tolerances of a place."""

    count: int = setting(
        0,
        "tokens on the table, drawn from the set for each episode; 0: all tokens",
        low=0,
        high=16,
    )
    fewer: tuple[float, ...] = setting(
        (),
        "in training, odds of episodes with 1, 2, 3, ... tokens; []: always task.count",
        low=0,
        part=LEARNING,
    )
    puzzle: tuple[str, ...] = setting(
        (),
        "figures of the library that the seven tans must make, one in each episode, at a random "
        "angle: names, or train or test for a whole split; []: random layouts of touching tokens, "
        "or figures of train",
    )
    within: float = setting(
        0.03, "distance within which a token is in place", low=1e-4, high=1, unit="arena units"
    )
    turned: float = setting(
        0.1, "turn within which a token is in place", low=1e-4, high=4, unit="rad"
    )
    finger: float = setting(0.04, "radius of the finger", low=0.005, high=0.2, unit="arena units")
    hand: str = setting(
        "finger",
        "what pushes: finger, a finger that reaches every place; panda, a finger on a robot's arm, "
        "as far as its joints allow",
        choices=("finger", "panda"),
    )
    longest: float = setting(
        0.5, "length of the longest push", low=0.05, high=1, unit="arena units"
    )
    pixels: int = setting(
        0,
        "side of the pictures in which tokens are found, from 16; 0: agents see exact corners",
        low=0,
        high=1024,
    )
    table_friction: tuple[float, ...] = setting(
        (0.5, 1.5),
        "range of the friction coefficient of each token on the table; only ratios count",
        low=0.01,
        high=100,
    )
    spread: tuple[float, ...] = setting(
        (0.9, 2.0),
        "range of (friction torque / force)^2, in squared radii of gyration of the token: 0.9 for "
        "even pressure, 2 and more if the corners carry it",
        low=0.1,
        high=5,
    )
    finger_friction: tuple[float, ...] = setting(
        (0.1, 0.6), "range of the friction coefficient of finger and token", low=0, high=2
    )
    centre: float = setting(
        0.15,
        "largest distance from centre of area to centre of mass, in radii of the token",
        low=0,
        high=0.5,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0 < self.pixels < MIN_PIXELS:
            raise ConfigError(
                f"task.pixels must be 0 or at least {MIN_PIXELS}, got {self.pixels}: set it to 128"
            )
        for name in ("table_friction", "spread", "finger_friction"):
            value = getattr(self, name)
            if len(value) != 2 or value[0] > value[1]:
                low, high = min(value, default=0.5), max(value, default=0.5)
                raise ConfigError(
                    f"task.{name} must be a range, the lower end first, got {told(value)}: write "
                    f"it as [{low:g},{high:g}]"
                )


@dataclass(frozen=True)
class Push(Task):
    """Tokens on a table, and a finger that comes down, pushes along a straight line, and lifts.

    An action is a push: which token, where on its edge, in which direction, how far. If the finger
    cannot come down, nothing moves, and the push counts. The reward is the share of tokens that
    are in place, minus 1. The episode terminates when all are in place; nothing moves any more.
    """

    agent: ClassVar[str] = "push"
    sections: ClassVar = {"tokens": TokensConfig, "task": PushConfig}
    scores: ClassVar = (
        Score("solved", "solved (all in place)"),
        Score("placed", "tokens in place"),
        Score("coverage", "coverage"),
        Score("pushes", "pushes", digits=1),
        Score("refused", "pushes refused", digits=2),
    )
    tokens: TokensConfig
    config: PushConfig = PushConfig()

    def __post_init__(self) -> None:
        """Raise ConfigError if task.count is more than the tokens of the set."""
        if self.config.count > self.layout.tokens:
            raise ConfigError(
                f"task.count={self.config.count}, and the set has {self.layout.tokens} tokens: set "
                f"it to at most {self.layout.tokens}, or choose more tokens"
            )

    @cached_property
    def layout(self) -> Layout:
        """The fixed geometry of the token set."""
        return make_layout(self.tokens)

    @property
    def count(self) -> int:
        """Number of tokens in an episode, unless `fewer` draws fewer."""
        return self.config.count or self.layout.tokens

    @cached_property
    def figures(self) -> tuple[Floats, ...]:
        """Poses (K, 3) of the tokens in each figure of task.puzzle.

        Raises:
            ConfigError: a figure is unknown or has other pieces, or the table is too small.
        """
        named = self.config.puzzle
        if named and self.count < self.layout.tokens:
            raise ConfigError(
                f"task.puzzle needs all seven tans on the table, got task.count={self.count}: set "
                "task.count=0, or leave puzzle out"
            )
        return tuple(figures_of(self.layout, self.tokens.scale, named))

    @cached_property
    def spec(self) -> EpisodeSpec:
        """Corners and goals of all tokens; AWAY for a token that is not on the table."""
        shape = (self.layout.corner_count, 2)
        fields = (
            Field("corners", shape, -FURTHEST, FURTHEST),
            Field("goals", shape, -FURTHEST, FURTHEST, "episode"),
        )
        horizon = PER_TOKEN * self.count
        return EpisodeSpec(horizon, 4, fields, "corners", "goals", rewards=(-1.0, 0.0))

    def placed(self, achieved: Array, desired: Array) -> Bools:
        """(n, K) which tokens are in place, or not on the table."""
        corners, goals = achieved.astype(np.float64), desired.astype(np.float64)
        distance, turn = errors(self.layout, corners, goals)
        near = (distance <= self.config.within) & (turn <= self.config.turned)
        return near | ~on_table(goals, self.layout)

    def paid(self, placed: Bools, present: Bools) -> Floats:
        """Rewards (n,): the share of tokens in place, minus 1."""
        counts = present.sum(axis=1)
        share: Floats = (placed & present).sum(axis=1) / np.maximum(counts, 1)
        return share - 1.0

    def rewards(self, achieved: Array, desired: Array) -> Floats:
        """Rewards (n,) of achieved and desired corners (n, V, 2)."""
        return self.paid(self.placed(achieved, desired), on_table(desired, self.layout))

    def ended(self, achieved: Array, desired: Array, recorded: Bools) -> Bools:  # noqa: ARG002
        """(n,) whether all tokens are in place."""
        return np.asarray(self.placed(achieved, desired).all(axis=1))

    def check(self, *, plays: bool) -> None:
        """Refuse wrong weights, tokens without room, and play without PyBullet or OpenCV.

        Raises:
            ConfigError: names the setting and the remedy.
            SamplingError: the tokens find no room on the table.
        """
        fewer = self.config.fewer
        if not plays and fewer and (len(fewer) > self.count or not sum(fewer)):
            raise ConfigError(
                f"task.fewer={told(fewer)} must have at most {self.count} odds, for 1, 2, ... "
                f"tokens, with one above 0: write it as {told((1,) * self.count)}"
            )
        for seed in range(DRAWS):
            begin(self.layout, self.count, np.random.default_rng(seed), self.figures)
        if plays and find_spec("pybullet") is None:
            raise ConfigError(
                "task=push needs PyBullet, which is missing: pip install pybullet with Python 3.11 "
                "on x86-64, otherwise pip install pybullet-arm64"
            )
        if plays and self.config.pixels and find_spec("cv2") is None:
            raise ConfigError(
                f"task.pixels={self.config.pixels} needs OpenCV, which is missing: pip install "
                "opencv-python-headless, or set task.pixels=0"
            )

    def make(self, count: int, purpose: Purpose = "play") -> Env:
        """Make `count` tables in this process."""
        from tangram_tasks.push.env import PushEnv  # noqa: PLC0415

        return PushEnv(self, count, self.config.fewer if purpose == "play" else ())

    def rivals(self) -> Mapping[str, Callable[[Env], Chooser]]:
        """Random pushes, a table of pushes of single tokens, and planners that simulate."""
        from tangram_tasks.push.rivals import TRIED, Planner  # noqa: PLC0415

        def planner(env: Env, knows: str) -> Chooser:
            return Planner(self, cast("PushEnv", env), TRIED, knows)

        return {
            "random": super().rivals()["random"],
            "table": lambda env: Planner(self, cast("PushEnv", env)),
            "planner": partial(planner, knows="middle"),
            "planner_told": partial(planner, knows="all"),
            "planner_wrong": partial(planner, knows="wrong"),
        }

    def score(self, played: Played) -> dict[str, float]:
        """Compute the scores at the first moment with all tokens in place, else at the end."""
        solved, last, ends = _ends(played)
        goals = played.facts["goals"][:, 0]
        present = on_table(goals, self.layout)
        refused = played.facts["refused"][:, 1:].astype(bool)
        refused &= np.arange(refused.shape[1]) < last[:, None]
        return {
            "solved": float(solved.mean()),
            "placed": float(1.0 + self.paid(self.placed(ends, goals), present).mean()),
            "coverage": float(self._covered(ends, goals).mean()),
            "pushes": float(last.mean()),
            "refused": float(refused.sum(axis=1).mean()),
        }

    def draw(self, played: Played) -> Pixels:
        """Draw how the first episodes ended."""
        from tangram_sim.drawing.scenes import episode_sheet  # noqa: PLC0415

        starts, goals = (played.facts[name][:PICTURES, 0] for name in ("corners", "goals"))
        ends = _ends(played)[2][:PICTURES]
        shares = self._covered(ends, goals)
        sheet = episode_sheet(self.layout, ARENA, starts, ends, goals, 4, PIXELS, shares)
        return np.asarray(sheet.convert("RGB"))

    def film(self, played: Played) -> Iterator[Pixels]:
        """Frames of the finger from above, or of the arm that holds it."""
        from tangram_tasks.push.film import from_above, from_the_side  # noqa: PLC0415

        shown = from_the_side if self.config.hand == "panda" else from_above
        return (np.asarray(one) for one in shown(self, played))

    def plan(self, played: Played) -> Json:
        """Way points of the finger in the first episode; see `plan_of`."""
        from tangram_tasks.push.plan import plan_of  # noqa: PLC0415

        return plan_of(self, played)

    def _covered(self, corners: Floats, goals: Floats) -> Floats:
        """(n,) shares of the places that tokens with corners (n, V, 2) cover."""
        from tangram_sim.geometry.overlap import overlap_area  # noqa: PLC0415

        areas = (on_table(goals, self.layout) * self.layout.areas).sum(axis=1)
        shares: Floats = overlap_area(corners, goals, self.layout) / areas
        return shares

    def identity(self) -> Json:
        """Settings and token geometry, which must be equal on master and workers."""
        return super().identity() | {"tokens": {"layout": self.layout.fingerprint()}}

    def facts(self) -> Json:
        """The number of tokens, for result.json."""
        return {"task": f"push of {self.count}"}


def _ends(played: Played) -> tuple[Bools, Ints, Floats]:
    """(E,) whether all came into place, (E,) after how many pushes, and corners (E, V, 2) then."""
    solved = np.asarray(played.episodes.terminated.any(axis=1))
    last = played.episodes.lengths
    return solved, last, played.facts["corners"][np.arange(len(last)), last]
