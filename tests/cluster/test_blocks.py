"""Blocks of README and docs, pasted as they stand; every block says whether it runs."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.blocks import Block, all_blocks, blocks_of, prepare, run

pytestmark = pytest.mark.slow


def _marks(block: Block) -> list[pytest.MarkDecorator]:
    """Those that need the session's training run where it is."""
    trained = [pytest.mark.xdist_group("trained")] * (block.says("run") is not None)
    return trained + [pytest.mark.check] * (block.says("when") == "check")


PASTED = [
    pytest.param(block, id=block.name, marks=_marks(block))
    for block in all_blocks()
    if block.says("when") in ("quick", "check")
]


@pytest.mark.parametrize("block", PASTED)
def test_it_runs_without_a_warning(
    block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    if "stable_baselines3" in block.code:
        pytest.importorskip("stable_baselines3", reason="pip install '.[peers]'")
    folder = prepare(block, tmp_path, request.getfixturevalue)
    if block.language == "bash":
        done = run(block, folder)
        assert done.returncode == 0, done.stdout
        return
    before = {*folder.iterdir()}
    monkeypatch.chdir(folder)
    names: dict[str, Any] = {}
    exec(compile(block.code, block.name, "exec"), names)  # noqa: S102
    for told in {"reward", "rewards"} & names.keys() if "agent" in names else ():
        assert np.min(names[told]) > 0.99
    if "over" in names:
        assert names["info"]["is_success"]
    if "coverage" in names:
        assert names["coverage"] > 0.99
    if "model" in names:
        assert names["model"]._n_updates > 100
    assert {*folder.iterdir()} == before


def test_commands_mean_the_same_to_bash_and_to_zsh() -> None:
    """Zsh looks for files where brackets are bare, and a # that is typed is a word to it."""
    quoted = re.compile(r"'[^']*'|\"[^\"]*\"")
    special = re.compile(r"[\[\]*?^!#]|\{.*\}|(?<!\S)=")
    bare = [
        f"{block.name}: {line}"
        for block in all_blocks()
        if block.language == "bash"
        for line in block.code.splitlines()
        if special.search(quoted.sub("", line))
    ]
    assert bare == []


def test_every_block_says_what_becomes_of_it() -> None:
    assert [block.name for block in all_blocks() if block.fault] == []


@pytest.mark.parametrize(
    ("before", "language", "fault"),
    [
        ("", "bash", True),
        ("", "", True),
        ("", "text", False),
        ("<!-- run: quick -->", "bash", False),
        ("<!-- run: quick -->\n", "bash", True),  # not on the line before
        ("<!-- run: check -->", "bash", False),
        ("<!-- run: often -->", "bash", True),
        ("<!-- run: never -->", "bash", True),  # and why?
        ("<!-- run: never, needs Docker -->", "bash", False),
        ("<!-- run: on request, in terminals -->", "bash", False),
        ("<!-- run: quick, with runs/square -->", "json", True),
        ("<!-- file: mine.json -->", "json", False),
    ],
)
def test_a_block_without_its_tag_is_a_fault(before: str, language: str, fault: bool) -> None:
    text = f"{before}\n```{language}\nline\n```\n\n   ```text\n   a\n   ```\n"
    first, second = blocks_of(text, "page.md")
    assert (first.fault, first.code, second.fault, second.code) == (fault, "line\n", False, "a\n")
