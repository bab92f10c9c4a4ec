"""Settings of the worker's commands: each wrong value is refused with what to do."""

from pathlib import Path

import pytest

from tangram_core.errors import ConfigError
from tangram_game.cli import with_absolute_paths, with_changes
from tangram_game.config import (
    EvalConfig,
    PlayConfig,
    check_puzzle,
    source_and_names,
)
from worker.config import WorkerConfig

pytestmark = pytest.mark.fast

RUN = {"run_dir": "runs/one"}
TESTED = RUN | {"puzzle": ("test",)}
OF_A_RUN = [
    ({"run_dir": ""}, "set run_dir=runs/my_run"),
    ({"seed": 2**63}, "seed must be between 0 and"),
]
WRONG = {
    WorkerConfig: [
        ({"connect": " "}, "set connect=RUN_DIR"),
        ({"role": "dancer"}, "role must be one of player, evaluator, got 'dancer'"),
    ],
    EvalConfig: [
        *OF_A_RUN,
        *[({"out": out}, "out must name a file") for out in ("", "/", ".")],
        *[
            (TESTED | {"changes": {"sim": {name: 1}}}, f"sim.{name}=1 changes nothing with puzzle:")
            for name in ("targets", "mirrored")
        ],
    ],
    PlayConfig: [
        *OF_A_RUN,
        *[
            ({"out": out}, "out must end with .gif, .mp4, .png, .json, .svg, got")
            for out in ("film.webm", "film.GIF.txt")
        ],
        ({"run_dir": None}, "say which run: run_dir=runs/..."),
        *[
            (
                {"puzzle": ("cat",), "changes": {"sim": {name: 1}}},
                f"sim.{name}=1 changes nothing with puzzle: leave it out, or leave puzzle out",
            )
            for name in ("targets", "mirrored", "starts")
        ],
    ],
}
CASES = [(kind, *case) for kind, cases in WRONG.items() for case in cases]


@pytest.mark.parametrize(("kind", "wrong", "reason"), CASES)
def test_wrong_settings_are_refused_with_what_to_do(kind: type, wrong: dict, reason: str) -> None:
    right = {"connect": "tcp://127.0.0.1:5555"} if kind is WorkerConfig else RUN
    kind(**right)
    with pytest.raises(ConfigError) as caught:
        kind(**(right | wrong))
    assert reason in str(caught.value)


@pytest.mark.parametrize(
    ("value", "names"),
    [
        (None, None),
        ("cat", (None, ("cat",))),
        (8, (None, ("8",))),
        (["cat", "dog"], (None, ("cat", "dog"))),
        ("test", ("test", None)),
        ("mine.SVG", ("mine.SVG", None)),
        (["my/own.json", "cat"], ("my/own.json", ("cat",))),
    ],
)
def test_one_puzzle_or_several_perhaps_of_a_file(value: object, names: object) -> None:
    puzzle = check_puzzle(value)
    assert (None if puzzle is None else source_and_names(puzzle)) == names


@pytest.mark.parametrize("later", ["a.json", "test"])
def test_puzzles_come_from_one_file(later: str) -> None:
    with pytest.raises(ConfigError, match=f"one file or split, first in its list, got {later}"):
        check_puzzle(["cat", later])


@pytest.mark.parametrize("value", ["", [], {"a": 1}, [["cat"]]])
def test_what_names_no_puzzle_is_refused(value: object) -> None:
    with pytest.raises(ConfigError, match="set puzzle=cat, puzzle=.cat,dog. or puzzle=mine.json"):
        check_puzzle(value)


@pytest.mark.parametrize(
    ("settings", "run_dir"),
    [
        ({"run_dir": "a"}, "a"),
        ({"puzzle": ("cat",)}, "pretrained/tangram7"),
    ],
)
def test_which_run_is_played(monkeypatch: pytest.MonkeyPatch, settings: dict, run_dir: str) -> None:
    monkeypatch.setattr("tangram_game.config.agent_names", lambda: ["tangram7"])
    assert PlayConfig(**settings).run == run_dir


def test_puzzles_are_for_the_agent_of_the_game_if_there_is_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("tangram_game.config.agent_names", lambda: ["square", "tangram7"])
    assert EvalConfig(puzzle=("test",)).run == "pretrained/tangram7"
    with pytest.raises(ConfigError, match="^out=.* would overwrite puzzle=.*: name another"):
        EvalConfig(puzzle=(__file__,), out=__file__)
    assert EvalConfig("runs/one", puzzle=("test",)).run == "runs/one"
    with pytest.raises(ConfigError, match="say which run: run_dir=runs/..."):
        EvalConfig()
    monkeypatch.setattr("tangram_game.config.agent_names", lambda: ["square"])
    for without in (lambda: EvalConfig(puzzle=("test",)), lambda: PlayConfig(puzzle=("cat",))):
        with pytest.raises(ConfigError, match="say which run"):
            without()


def test_paths_are_seen_from_the_callers_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "pretrained" / "mine").mkdir(parents=True)
    for name, given, seen in (
        ("run_dir", None, None),
        ("run_dir", "pretrained/x", "pretrained/x"),
        ("run_dir", "runs/a", f"{tmp_path}/runs/a"),
        ("run_dir", "/b", "/b"),
        ("run_dir", "pretrained/mine", f"{tmp_path}/pretrained/mine"),
        ("out", "pretrained/x.png", f"{tmp_path}/pretrained/x.png"),
        ("puzzle", "mine.json", (f"{tmp_path}/mine.json",)),
        ("puzzle", ["mine.json", "cat"], (f"{tmp_path}/mine.json", "cat")),
        ("puzzle", "test", ("test",)),
        ("puzzle", ["cat", 8], ("cat", "8")),
        ("silhouette", "it.svg", f"{tmp_path}/it.svg"),
        ("silhouette", "~/it.png", f"{tmp_path}/home/it.png"),
        ("silhouette", "cat", "cat"),
    ):
        assert with_absolute_paths({name: given}) == {name: seen}


def test_what_is_laid_over_a_run_is_what_was_given() -> None:
    given = {"sim": {"arena": None, "mirrored": 0.0}, "agent": {"reapply": None}, "seed": 3}
    assert with_changes(given) == {"seed": 3, "changes": {"sim": {"mirrored": 0.0}}}
