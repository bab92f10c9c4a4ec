"""Whether what pages show is in the data: every score of a page names its source.

A comment above a paragraph, a list or a table says where its numbers are from:

    <!-- data: fig4 table2 -->       these experiments' sections of the tables
    <!-- data: paper_size/fig4 -->   the same of the report in that folder of docs/results
    <!-- data: silhouettes.json -->  a file of docs/results
    <!-- data: paper -->             the paper's own numbers
    <!-- data: commit 0123abc -->    an older commit, which the text must name, too
    <!-- data: none -->              no score: a setting, a size
"""

import json
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from tangram_lab.experiments.report.data import read_data
from tangram_lab.experiments.report.fingerprints import (
    MakeSetup,
    differences,
    families,
    make_fingerprints,
)
from tangram_lab.experiments.report.page import DATA, TABLES, tables_page
from tangram_lab.experiments.report.references import VALUES
from tangram_lab.experiments.report.study import Study
from tangram_sim.errors import RunError

MARK = re.compile(r"<!-- data: (?P<sources>[^>]+?) -->")
# Three decimals and more: scores have as many, and little else has.
SCORE = re.compile(r"(?<![\w.])\d+\.\d{3,}(?!\w|\.\d)")
CODE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`[^`\n]*`|\]\([^)]*\)")
SECTION = re.compile(r'^<a id="(?P<name>[^"]+)"></a>$', re.MULTILINE)
NO_SCORE, OLDER, PAPERS = "none", "commit", "paper"
CHANGED = "-dirty"  # of a commit in a result: the source tree was not as committed


def check(results: Path, pages: Iterable[Path], make: MakeSetup) -> list[str]:
    """What is wrong; nothing where every figure is in the data, and the data are of this code.

    Args:
        results: folder that tangram-report made; folders in it may hold further reports.
        pages: that show figures.
        make: the setup that a training's arguments come to.

    Raises:
        RunError: the data cannot be read.
        ConfigError: this code refuses a training of them.
    """
    found, tables, commits = list[str](), dict[str, str](), set[str | None]()
    for prefix, folder in reports(results).items():
        study, fingerprints = read_data(folder / DATA)
        tables[prefix] = (folder / TABLES).read_text(encoding="utf-8")
        if tables_page(study, folder) != tables[prefix]:
            found.append(f"{folder / TABLES} is not what {DATA} gives: make it anew")
        found += (f"{prefix}{line}" for line in _lacks(study))
        commits |= {seed.result.get("commit") for one in study.trainings for seed in one.finished}
        trainings = study.plan["trainings"]
        now = make_fingerprints(trainings, make)
        found += (f"{prefix}{line}" for line in differences(families(trainings), fingerprints, now))
    found += _of_commits(commits)
    numbers = Sources(results, tables)
    for page in pages:
        found += check_page(page.name, page.read_text(encoding="utf-8"), numbers)
    return found


def reports(results: Path) -> dict[str, Path]:
    """What stands before the names of a report's experiments -> its folder."""
    others = sorted(path.parent for path in results.glob(f"*/{DATA}"))
    return {"": results, **{f"{folder.name}/": folder for folder in others}}


def _of_commits(commits: Collection[str | None]) -> Iterator[str]:
    if len(commits) > 1:
        yield f"the runs are of several commits: {', '.join(sorted(map(str, commits)))}"
    if changed := sorted(str(one) for one in commits if not one or one.endswith(CHANGED)):
        yield f"the runs are of a tree that was changed, or of none: {', '.join(changed)}"


def _lacks(study: Study) -> Iterator[str]:
    """Seeds that were planned and not trained, tests that were not made."""
    for training in study.trainings:
        left = [seed.number for seed in training.seeds if not seed.finished]
        if left:
            yield f"{training.name} lacks the seeds {left}"
    for experiment in study.experiments:
        for training in experiment.trainings:
            for test in experiment.tests:
                if any(test.name not in seed.tests for seed in training.finished):
                    yield f"{training.name} lacks the test {test.name} of {experiment.name}"


class Sources:
    """The numbers that may stand on pages, by the names of their sources."""

    def __init__(self, results: Path, tables: Mapping[str, str]) -> None:
        """Take the tables of each report; files are read when they are named."""
        self._results = results
        self._sections = dict[str, str]()
        for prefix, text in tables.items():
            parts = SECTION.split(text)[1:]
            names = (prefix + name for name in parts[::2])
            self._sections |= zip(names, parts[1::2], strict=True)

    def has(self, source: str, text: str) -> bool:
        """Whether a number, as it is written, is one of a source.

        Raises:
            RunError: there is no such source.
        """
        if source == NO_SCORE:
            return True
        if source == PAPERS:
            return text.rstrip("0") in json.dumps(VALUES)
        if source in self._sections:
            return bool(re.search(rf"(?<![\d.]){re.escape(text)}(?![\d])", self._sections[source]))
        return any(_rounds_to(number, text) for number in self._file(source))

    def _file(self, name: str) -> Iterator[float]:
        path = self._results / name
        if not (path.suffix == ".json" and path.is_file()):
            raise RunError(
                f"no source is called {name}: name an experiment of {TABLES}, a .json file of "
                f"{self._results}, {PAPERS}, {OLDER} or {NO_SCORE}"
            )
        yield from _numbers(json.loads(path.read_text(encoding="utf-8")))


def _numbers(content: Any) -> Iterator[float]:
    if isinstance(content, Mapping):
        content = list(content.values())
    if isinstance(content, list):
        for one in content:
            yield from _numbers(one)
    elif isinstance(content, int | float) and not isinstance(content, bool):
        yield float(content)


def _rounds_to(number: float, text: str) -> bool:
    """Whether a number is written so, as it is or halfway between two."""
    digits = len(text.partition(".")[2])
    return abs(abs(number) - float(text)) <= 0.500001 * 10.0**-digits


def check_page(name: str, text: str, numbers: Sources) -> Iterator[str]:
    """The scores of a page that have no source, or are not in it."""
    sources: str | None = None
    for line, block in _blocks(text):
        marks = [found["sources"] for found in MARK.finditer(block)]
        sources = marks[-1] if marks else sources
        bare = INLINE.sub("", MARK.sub("", block))
        for score in dict.fromkeys(SCORE.findall(bare)):
            if wrong := _wrong(sources, score, bare, numbers):
                yield f"{name}:{line}: {score} {wrong}"
        if bare.strip():
            sources = None  # a mark holds for what comes next


def _wrong(sources: str | None, score: str, block: str, numbers: Sources) -> str:
    if sources is None:
        return "has no source: put <!-- data: ... --> above it"
    first, *rest = sources.split()
    if rest and NO_SCORE in (first, *rest):
        return f"has the source {sources}: {NO_SCORE} stands alone"
    if first == OLDER:
        missing = [one for one in rest if one not in block]
        return f"is of commit {missing[0]}, which the text does not say" if missing else ""
    if any(numbers.has(source, score) for source in (first, *rest)):
        return ""
    return f"is not in {sources}"


def _blocks(text: str) -> Iterator[tuple[int, str]]:
    """What blank lines and marks set apart, with the number of its first line; without code."""
    blank = CODE.sub(lambda found: "\n" * found[0].count("\n"), text)
    line = 1
    for block in re.split(r"(\n[ \t]*\n|\n(?=<!-- data: ))", blank):
        if block.strip():
            yield line + len(block) - len(block.lstrip("\n")), block
        line += block.count("\n")
