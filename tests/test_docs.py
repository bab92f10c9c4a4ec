"""What README and docs name exists: files, settings, and what their commands set.

Links and anchors: tests/test_house_slow.py.
"""

import re
import shlex
from collections.abc import Iterator
from contextlib import chdir
from pathlib import Path

import pytest

from conf.commands import COMMANDS
from conf.help import choices, setting_names
from conf.kinds import every_kind, kinds_of, with_usual_agent
from conf.own import with_named_code, without_named_code
from tangram_lab.benchmarks.cli import _parser as bench_parser
from tests.blocks import PAGES

pytestmark = pytest.mark.fast

ROOT = Path(__file__).parents[1]
FOLDERS = [p.name for p in ROOT.iterdir() if p.is_dir() and p.name[0] != "." and p.name != "site"]
GENERATED = ("settings.md", "bench.md")  # of settings or of runs, as what lies beside a CSV
PRESENT = [p for p in PAGES if p.name not in GENERATED and not p.with_suffix(".csv").exists()]
SUFFIXES = ("py", "md", "sh", "sbatch", "def", "yaml", "toml", "txt")
PRIMARIES = {command.name: name for name, command in COMMANDS.items()}


def spans(text: str) -> set[str]:
    """The inline code of a page."""
    return {
        " ".join(span.split())
        for span in re.findall(r"`([^`]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    }


def dead_paths(text: str) -> list[str]:
    """Names of files in inline code that are nowhere in this repository."""
    named = rf"[\w*./-]+\.(?:{'|'.join(SUFFIXES)})|(?:{'|'.join(FOLDERS)})/[\w*./-]*"
    names = [span for span in spans(text) if re.fullmatch(named, span)]
    return [n for n in names if not any(ROOT.glob(n)) and not found_below(n)]


def found_below(name: str) -> bool:
    """Whether one of our folders has a file of this name, as `test_journal.py` or `report/`."""
    return any(True for folder in FOLDERS for _ in (ROOT / folder).rglob(name.rstrip("/")))


def dead_settings(text: str) -> list[str]:
    """Settings of a group in inline code that no command has."""
    every = [*every_kind("task"), *every_kind("agent")]
    known = {name for kinds in every for name in setting_names("train", kinds)}
    groups = {name.partition(".")[0] for name in known if "." in name}
    dotted = rf"(?:{'|'.join(groups)})\.\w+"
    named = [
        match[0] for span in spans(text) if (match := re.match(rf"{dotted}(?![\w.(/:-])", span))
    ]
    return [name for name in named if name not in known]


def commands(text: str) -> Iterator[list[str]]:
    """The words of every tangram-* command that can be read to its end."""
    lines = [
        line
        for block in re.findall(r"```bash\n(.*?)```", text, re.DOTALL)
        for line in block.splitlines()
    ]
    for line in [*lines, *spans(text)]:
        words = shlex.split(line, comments=True) if line.startswith("tangram-") else []
        if len(words) > 1 and "..." not in line and not re.search(r"\b[A-Z]{3,}\b", line):
            yield words


def unknown(words: list[str]) -> list[str]:
    """What a command would refuse: its settings by name, its groups by the names of presets."""
    if words[0] == "tangram-bench":
        bench_parser().parse_args([f"--{word}" if "=" in word else word for word in words[1:]])
        return []
    name = PRIMARIES[words[0]]
    groups = COMMANDS[name].groups
    with chdir(ROOT):  # where a page's commands find the examples
        words = with_usual_agent(with_named_code(words))
    settings = set(setting_names(name, kinds_of(words)))
    words = words if "task" in groups else without_named_code(words)
    refused = []
    for word in words[1:]:
        key, _, value = word.partition("=")
        presets = value.strip("[]").split(",") if key in groups else []
        known = set(presets) <= set(choices(key)) if presets else key in settings
        if not known and not word.startswith(("--", "hydra")):
            refused.append(word)
    return refused


@pytest.mark.parametrize("page", PRESENT, ids=lambda page: page.name)
def test_files_and_settings_that_are_named_exist(page: Path) -> None:
    text = page.read_text()
    assert (dead_paths(text), dead_settings(text)) == ([], [])


@pytest.mark.parametrize("page", PRESENT, ids=lambda page: page.name)
def test_commands_know_their_settings(page: Path) -> None:
    assert [word for words in commands(page.read_text()) for word in unknown(words)] == []


def test_what_is_not_there_is_found() -> None:
    text = "`tests/gone.py` `gone.py` `service.gone=1` `agent.gone`\n"
    assert sorted(dead_paths(text)) == ["gone.py", "tests/gone.py"]
    assert sorted(dead_settings(text)) == ["agent.gone", "service.gone"]
    block = "```bash\ntangram-train sim.gone=1 agent=gone agent=paper seed=1  # a comment\n```"
    (words,) = commands(block)
    assert unknown(words) == ["sim.gone=1", "agent=gone"]
    with pytest.raises(SystemExit):
        unknown(["tangram-bench", "gone"])
