"""Puzzles as targets of a run: read, checked against its tokens, turned and played.

Legend: E episodes, K tokens.
"""

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tangram_core.agent import AT_ONCE, Actor
from tangram_core.arrays import Bools, Floats, Ints
from tangram_core.errors import ConfigError
from tangram_core.seeding import episode_generator
from tangram_core.spec import Arrays
from tangram_core.task import Chooser, Env, Generators
from tangram_sim.config import SILHOUETTE, RewardConfig
from tangram_sim.puzzles.assembly import Puzzle, PuzzleRules
from tangram_sim.puzzles.figures import SPLITS, library, read_puzzles
from tangram_sim.targets.targets import placement, turned_figure
from tangram_tasks.place import Place
from tangram_tasks.played import Played
from worker.play import rollout

Player = Callable[[Env], Chooser]  # makes a policy for environments
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Figure:
    """A puzzle at one angle, as the target of a run's tokens.

    Attributes:
        name: name of the puzzle.
        degrees: turn relative to the drawing.
        poses: (K, 3) poses of the tokens in the figure.
        flipped: (K,) tokens that lie on their other side.
    """

    name: str
    degrees: float
    poses: Floats
    flipped: Bools

    @property
    def title(self) -> str:
        """Name and turn, as the title of a picture."""
        name = self.name.replace("_", " ")
        return f"{name} {self.degrees:g}°" if self.degrees else name


def find_figures(
    source: str | None,
    task: Place,
    names: Sequence[str] | None = None,
    turns: int = 1,
) -> tuple[Figure, ...]:
    """The puzzles of a file or of the library as targets of a run.

    Args:
        source: a file, or a split of the library; None: the whole library.
        task: the task of the run.
        names: names of the puzzles wanted; None: all of the source.
        turns: number of angles of each puzzle, evenly spread from that of the drawing.

    Raises:
        ConfigError: a file cannot be used, a name is unknown, or pieces differ from the tokens.
    """
    puzzles = _named(_read(source, task.tokens.scale), names, source)
    return tuple(figure for puzzle in puzzles for figure in _turns(puzzle, task, turns))


def by(actor: Actor) -> Player:
    """A player that follows an actor, without exploration."""
    return lambda _: rollout.greedy(actor)


def play_figures(
    task: Place, figures: Sequence[Figure], player: Player, seed: int, touching: bool = True
) -> Played:
    """Assemble E figures, one episode each; seed and figure decide where the tokens start.

    Args:
        task: the task of the run.
        figures: the E figures.
        player: makes the policy that plays.
        seed: seed of the starts.
        touching: whether pieces touch, so that they cannot be told apart in pictures.

    Raises:
        ConfigError: agents observe pictures, and pieces touch.
        SamplingError: the tokens find no room to start.
    """
    looks = task.sim.observe == "pictures"
    if looks and touching:
        raise ConfigError(
            "sim.observe=pictures cannot tell the pieces of a puzzle apart, which touch: set "
            "sim.observe=corners"
        )
    shows = looks or task.sim.observe == SILHOUETTE
    sim = task.sim if shows else task.sim.blind
    targets = (np.stack([f.poses for f in figures]), np.stack([f.flipped for f in figures]))
    shown = replace(task, sim=sim, reward=RewardConfig())
    with closing(shown.make(min(AT_ONCE, len(figures)))) as env:

        def generator(number: int) -> np.random.Generator:
            return _generator(figures[number], seed)

        def begin(numbers: Ints, generators: Generators) -> Arrays:
            return env.reset(generators, (targets[0][numbers], targets[1][numbers]))

        choose, count = player(env), len(figures)
        return Played.of(
            rollout.play(env, shown.spec, choose, generator, count, begin=begin, facts=True)
        )


def _generator(figure: Figure, seed: int) -> np.random.Generator:
    """The generator of a figure, the same whatever other figures are played."""
    return episode_generator(seed, f"puzzle {figure.name}", 0, 0, round(figure.degrees * 1000))


def _read(source: str | None, scale: float) -> tuple[Puzzle, ...]:
    if source is None or source in SPLITS:
        return library(source, scale)
    return read_puzzles(Path(source), PuzzleRules(scale, subset=True))


def _named(
    puzzles: Sequence[Puzzle], names: Sequence[str] | None, source: str | None
) -> list[Puzzle]:
    if names is None:
        return list(puzzles)
    found = {puzzle.name: puzzle for puzzle in puzzles}
    for name in names:
        if name not in found:
            raise ConfigError(
                f"no puzzle '{name}' in {source or 'the library'}: choose from "
                f"{', '.join(found) or 'none'}"
            )
    return [found[name] for name in names]


def _turns(puzzle: Puzzle, task: Place, turns: int) -> list[Figure]:
    poses, flipped = _placed(puzzle, task)
    figures = []
    for degrees in (360.0 * i / turns for i in range(turns)):
        there = turned_figure(task.layout, (poses, flipped), np.radians(degrees))
        check_inside(
            f"puzzle '{puzzle.name}'",
            task,
            task.layout.corners(there, flipped),
            "name a run of a larger arena or of smaller tokens",
        )
        figures.append(Figure(puzzle.name, degrees, there, flipped))
    return figures


def _placed(puzzle: Puzzle, task: Place) -> tuple[Floats, Bools]:
    try:
        return placement(puzzle, task.layout)
    except ConfigError:
        tokens = ", ".join(shape.name for shape in task.layout.shapes)
        raise ConfigError(
            f"puzzle '{puzzle.name}' has the pieces {', '.join(puzzle.pieces)}, and the run moves "
            f"{tokens} of scale {task.tokens.scale:g}: name a run of the puzzle's pieces"
        ) from None


def check_inside(what: str, task: Place, corners: Floats, remedy: str) -> None:
    """Raise ConfigError where corners (V, 2) around the middle reach out of a run's arena."""
    reach, half = float(np.abs(corners).max()), task.sim.arena / 2.0
    if reach > half + _ROUNDING:
        raise ConfigError(
            f"{what} reaches {reach:.3g} from its middle, and the arena only {half:.3g}: {remedy}"
        )
