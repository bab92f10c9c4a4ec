"""The commands tangram-eval, tangram-play and tangram-export.

Heavy modules are imported after the settings are read, so that --help and refusals of wrong input
are instant.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from conf.cli import entry, tell
from conf.commands import Plain

if TYPE_CHECKING:
    from tangram_agent.runs import Run
    from tangram_game.config import EvalConfig, PlayConfig


def evaluate() -> int:
    """tangram-eval: scores a run."""
    return entry("eval", _evaluate)


def play() -> int:
    """tangram-play: draws a run at play."""
    return entry("play", _play)


def export() -> int:
    """tangram-export: writes an agent as ONNX."""
    return entry("export", _export)


def _evaluate(settings: Plain) -> int:
    from tangram_core.setup import from_mapping
    from tangram_core.store.files import check_writable
    from tangram_game.config import EvalConfig

    paths = _with_figures(with_changes(with_absolute_paths(settings)))
    config = from_mapping(EvalConfig, paths)
    if config.out is not None:
        check_writable("out", Path(config.out))
    _check_played(config)
    tell(f"loading and playing {config.run}")

    from tangram_game.evaluate import evaluate_run

    return evaluate_run(config)


def _play(settings: Plain) -> int:
    from tangram_core.setup import from_mapping
    from tangram_core.store.files import check_writable
    from tangram_game.config import PlayConfig

    paths = _with_figures(with_changes(with_absolute_paths(settings)))
    config = from_mapping(PlayConfig, paths)
    check_writable("out", Path(config.out).absolute())
    _check_drawings(config)
    stored = _check_played(config)
    _check_data(config, stored)
    name = "target" if config.target else "silhouette"
    if config.target is not None or config.data:
        recognised = _recognised(config, stored)
        if recognised is None:
            return 0
        config = recognised
    filled = None
    if config.silhouette is not None:
        from tangram_game.figures.silhouettes import read_silhouette

        source = f"{name}={config.silhouette}"
        filled = read_silhouette(config.silhouette, source, stored.task)
    tell(f"loading and playing {config.run}")
    from tangram_game.play import play_run

    return play_run(config, filled)


def _export(settings: Plain) -> int:
    from tangram_core.setup import from_mapping
    from tangram_core.store.files import check_writable
    from tangram_game.config import ExportConfig

    config = from_mapping(ExportConfig, with_changes(with_absolute_paths(settings)))
    check_writable("out", Path(config.out))
    tell(f"exporting {config.run_dir} and comparing it with torch: this takes a minute")
    from tangram_game.export import export_run

    return export_run(config)


def _check_data(config: "PlayConfig", stored: "Run") -> None:
    """Refuse .json and .svg that nothing writes: solutions need a figure, plans need pushes."""
    from tangram_core.errors import ConfigError
    from tangram_core.task import Task

    plans = type(stored.setup.task).plan is not Task.plan
    figure = config.target or config.silhouette
    if config.data and figure is None and not (plans and Path(config.out).suffix == ".json"):
        raise ConfigError(
            f"out={config.out} is for positions of tokens in a figure, or a plan of pushes: name "
            "the figure by target=cat or a file, or set run_dir=pretrained/hand out=plan.json"
        )


def _recognised(config: "PlayConfig", stored: "Run") -> "PlayConfig | None":
    """The settings with the kind of `target` resolved; None if only data was to be written.

    Raises:
        ConfigError: the target cannot be used.
    """
    from dataclasses import replace

    from tangram_core.errors import ConfigError
    from tangram_game.figures import targets
    from tangram_tasks.place import Place

    figure = config.target or config.silhouette
    if figure is None:
        return config
    if not isinstance(stored.setup.task, Place):
        raise ConfigError(
            f"{config.run} plays task={stored.setup.task_kind}, which takes only figures of the "
            "library: set puzzle=cat, or leave run_dir out"
        )
    kind = targets.SILHOUETTE
    if config.target is not None:
        kind = targets.told_apart(figure, stored.task)
        anew = ", which are searched anew" if config.data and kind == targets.PUZZLE else ""
        print(f"target={figure} is taken for {targets.TOLD[kind]}{anew}")
    if config.data:
        from tangram_core.store.files import write_whole

        source = f"{'target' if config.target else 'silhouette'}={figure}"
        solution = targets.solved(figure, source, stored.task, kind)
        as_json = Path(config.out).suffix == ".json"
        write_whole(Path(config.out), solution.json() if as_json else solution.svg())
        print(f"{config.out}: {solution.told}")
        return None
    if kind == targets.PUZZLE:
        return replace(config, target=None, puzzle=(figure,))
    if kind == targets.SILHOUETTE:
        return replace(config, target=None, silhouette=figure)
    return config


def _with_figures(settings: Plain) -> Plain:
    """The settings, with `puzzle` moved to task.puzzle if the run plays task=push.

    Raises:
        ConfigError: a file or `turns` is given, which task=push does not take.
    """
    from tangram_agent.runs import read_changed
    from tangram_core.errors import ConfigError
    from tangram_game.config import check_puzzle, game_run
    from tangram_tasks.push.task import Push

    puzzle, changes = check_puzzle(settings["puzzle"]), settings["changes"]
    if puzzle is None:
        return settings
    run = settings["run_dir"] or game_run()
    if not isinstance(read_changed(run, changes).setup.task, Push):
        return settings
    if settings["turns"] != 1 or Path(puzzle[0]).suffix:
        raise ConfigError(
            "task=push makes figures of the library at random angles: give only names, as in "
            "puzzle=cat or [cat,dog], without turns or file"
        )
    own = changes.get("task", {})
    if "puzzle" in own:
        raise ConfigError(
            "puzzle= and task.puzzle= are the same setting in task=push: leave one of them out"
        )
    own = own | {"puzzle": list(puzzle)}
    return settings | {"puzzle": None, "changes": changes | {"task": own}}


def _check_played(config: "EvalConfig | PlayConfig") -> "Run":
    """Refuse what cannot be played, before torch is loaded; returns the stored run."""
    from tangram_agent.runs import read_changed

    stored = read_changed(config.run, config.changes)
    if config.puzzle is not None:
        from tangram_game.config import source_and_names
        from tangram_game.figures.puzzles import find_figures

        source, names = source_and_names(config.puzzle)
        find_figures(source, stored.task, names)
    return stored


def _check_drawings(config: "PlayConfig") -> None:
    """Refuse a missing file of a drawing before slow libraries are loaded."""
    from tangram_sim.puzzles.sketches import check_file

    for name, path in (("target", config.target), ("silhouette", config.silhouette)):
        if path is not None and Path(path).suffix:  # else the name of a puzzle
            check_file(Path(path), f"{name}={path}")


def with_changes(settings: Plain) -> Plain:
    """The settings, with all that override the run's in a mapping `changes`; null: no override."""
    laid = {name: values for name, values in settings.items() if isinstance(values, dict)}
    given = {s: {n: v for n, v in own.items() if v is not None} for s, own in laid.items()}
    rest = {name: value for name, value in settings.items() if name not in laid}
    return rest | {"changes": {section: own for section, own in given.items() if own}}


def with_absolute_paths(settings: Plain) -> Plain:
    """The settings with absolute paths of folders and files; values that are no text stay.

    Names of puzzles and of splits of the library stay, too.
    """
    from tangram_game.config import check_puzzle, is_puzzle_source
    from tangram_sim.puzzles.figures import SPLITS

    result = dict(settings)
    for name in ("run_dir", "out"):
        result[name] = _absolute(result.get(name), is_run=name == "run_dir")
    for name in ("target", "silhouette"):
        value = result.get(name)
        if isinstance(value, str) and Path(value).suffix:  # else a puzzle's name
            result[name] = _absolute(value, is_run=False)
    puzzle = check_puzzle(result.get("puzzle"))
    if puzzle is not None and is_puzzle_source(puzzle[0]) and puzzle[0] not in SPLITS:
        puzzle = (str(_absolute(puzzle[0], is_run=False)), *puzzle[1:])
    result["puzzle"] = puzzle
    return {name: value for name, value in result.items() if name in settings}


def _absolute(value: object, is_run: bool) -> object:
    """A path made absolute; `pretrained/<name>` stays a name unless such a folder exists here."""
    from tangram_agent.pretrained import is_name

    if not isinstance(value, str) or not value.strip():
        return value
    path = Path(value).expanduser()
    if is_run and is_name(path) and not path.is_dir():
        return str(path)
    return str(path.absolute())
