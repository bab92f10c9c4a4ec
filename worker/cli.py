"""The commands tangram-worker, tangram-status, tangram-eval and tangram-play.

Everything heavy is imported after the config was composed, so --help and wrong input are instant.
"""

import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from conf.cli import entry, tell
from conf.commands import Plain

if TYPE_CHECKING:
    from tangram_agent.setup import Setup
    from worker.config import EvalConfig, PlayConfig


def worker() -> int:
    """tangram-worker: plays for a master, or scores what it has learned."""
    return entry("worker", _worker, _of_the_run)


def status() -> int:
    """tangram-status: how a run stands."""
    return entry("status", _status)


def evaluate() -> int:
    """tangram-eval: scores a finished run."""
    return entry("eval", _evaluate)


def play() -> int:
    """tangram-play: draws a finished run at play."""
    return entry("play", _play)


def _of_the_run(settings: Plain) -> tuple[str, Plain] | None:
    """What the connection file says of the run; nothing where only an address is given."""
    from tangram_core.process import watch_parent
    from worker.talk.discovery import as_address, await_master

    watch_parent()  # already here: a parent may end while the file is waited for
    connect = settings.get("connect")
    if not isinstance(connect, str) or not connect.strip() or as_address(connect) is not None:
        return None
    found = await_master(connect, partial(print, file=sys.stderr, flush=True)).settings
    return None if found is None else (f"connect={connect}", dict(found))


def _worker(settings: Plain) -> int:
    from tangram_agent.setup import SECTIONS, from_mapping, make_setup
    from tangram_sim.rewards import check_reward
    from tangram_sim.world.world import check_shown, check_world
    from worker.config import WorkerConfig

    rest = {name: value for name, value in settings.items() if name not in SECTIONS}
    config = from_mapping(WorkerConfig, rest)
    setup = make_setup(settings)
    check_shown(setup.sim, setup.fills)  # before anything is connected
    check_world(setup.layout, setup.sim)
    check_reward(setup.reward, setup.layout, setup.sim)

    from worker.play.session import keep_part

    if config.role == "evaluator":
        from worker.score.evaluator import run_evaluator

        return keep_part(run_evaluator, config, setup)
    from worker.play.player import run_player

    return keep_part(run_player, config, setup)


def _status(settings: Plain) -> int:
    from tangram_agent.setup import from_mapping
    from worker.config import StatusConfig

    config = from_mapping(StatusConfig, settings)

    from worker.status import show_status

    return show_status(config)


def _evaluate(settings: Plain) -> int:
    from tangram_agent.setup import from_mapping
    from tangram_core.store.files import check_writable
    from worker.config import EvalConfig

    config = from_mapping(EvalConfig, with_changes(with_absolute_paths(settings)))
    for name, path in (("out", config.out), ("sheet", config.sheet)):
        if path is not None:
            check_writable(name, Path(path))
    _check_played([config.run], config)
    tell(f"loads and plays {config.run}")

    from tangram_game.evaluate import evaluate_run

    return evaluate_run(config)


def _play(settings: Plain) -> int:
    from tangram_agent.setup import from_mapping
    from tangram_core.store.files import check_writable
    from worker.config import PlayConfig, check_compare

    check_compare(settings.get("compare"))  # before a text is taken for a list of letters
    paths = with_absolute_paths(settings)
    config = from_mapping(PlayConfig, with_changes(paths))
    check_writable("out", Path(config.out).absolute())
    _check_drawings(config)
    setups = _check_played(config.run_dirs, config)
    if config.target is not None:
        from tangram_game.figures.photographs import read_photograph

        read_photograph(config.target, setups[0])
    filled = None
    if config.silhouette is not None:
        from tangram_game.figures.silhouettes import read_silhouette

        out = Path(config.out)
        filled = read_silhouette(config.silhouette, setups[0], config.solutions, out)
    tell(f"loads and plays {', '.join(config.run_dirs)}")

    if config.compare is not None:
        from tangram_game.play import compare_runs

        return compare_runs(config)
    from tangram_game.play import play_run

    return play_run(config, filled)


def _check_played(run_dirs: Sequence[str], config: "EvalConfig | PlayConfig") -> list["Setup"]:
    """Refuse what cannot be played before torch is loaded; returns what the runs play."""
    from tangram_agent.runs import read_changed

    setups = [read_changed(run_dir, config.changes).setup for run_dir in run_dirs]
    if config.puzzle is not None:
        from tangram_game.figures.puzzles import find_figures
        from worker.config import source_and_names

        source, names = source_and_names(config.puzzle)
        find_figures(source, setups[0], names)
    return setups


def _check_drawings(config: "PlayConfig") -> None:
    """Refuse a drawing that is not there before what reads drawings is loaded."""
    from tangram_sim.puzzles.sketches import check_file

    for name, path in (("target", config.target), ("silhouette", config.silhouette)):
        # A silhouette may be the name of a puzzle.
        if path is not None and (name == "target" or Path(path).suffix):
            check_file(Path(path), f"{name}={path}")


def with_changes(settings: Plain) -> Plain:
    """The settings that are laid over a run's, in one mapping; null is as the run was trained."""
    laid = {name: values for name, values in settings.items() if isinstance(values, dict)}
    given = {s: {n: v for n, v in own.items() if v is not None} for s, own in laid.items()}
    rest = {name: value for name, value in settings.items() if name not in laid}
    return rest | {"changes": {section: own for section, own in given.items() if own}}


def with_absolute_paths(settings: Plain) -> Plain:
    """Folders and files seen from where the command was started; what is no text is left alone.

    Puzzles and splits of the library stay names.
    """
    from tangram_sim.puzzles.figures import SPLITS
    from worker.config import check_puzzle, is_puzzle_source

    result = dict(settings)
    for name in ("run_dir", "out", "sheet", "target"):
        result[name] = _absolute(result.get(name), is_run=name == "run_dir")
    silhouette = result.get("silhouette")
    if isinstance(silhouette, str) and Path(silhouette).suffix:  # else a puzzle's name
        result["silhouette"] = _absolute(silhouette, is_run=False)
    puzzle = check_puzzle(result.get("puzzle"))
    if puzzle is not None and is_puzzle_source(puzzle[0]) and puzzle[0] not in SPLITS:
        puzzle = (str(_absolute(puzzle[0], is_run=False)), *puzzle[1:])
    result["puzzle"] = puzzle
    if isinstance(result.get("compare"), list):
        result["compare"] = [_absolute(run, is_run=True) for run in result["compare"]]
    return {name: value for name, value in result.items() if name in settings}


def _absolute(value: object, is_run: bool) -> object:
    """A path made absolute; `pretrained/<name>` stays a name unless a folder here is called so."""
    from tangram_agent.pretrained import is_name

    if not isinstance(value, str) or not value.strip():
        return value
    path = Path(value).expanduser()
    if is_run and is_name(path) and not path.is_dir():
        return str(path)
    return str(path.absolute())
