"""Check that every score on a page is in the CSV or JSON files that its section links.

A score is a number with three or more decimals, or a percentage with at least one. A section is
the text under one heading. A section that links no file of results is checked against all files
that the page links, a table's row with links against these alone. Numbers in code are no scores.
"""

import json
import re
from collections.abc import Iterable, Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tangram_core.arrays import Floats
from tangram_core.errors import RunError
from tangram_lab.experiments.rows import of_a_study, read_rows, spreads

NUMBER = r"[-\N{MINUS SIGN}]?\d*\.(?:\d+\s?%|\d{3,})"
SCORE = re.compile(rf"(?<![\w.,/])(?P<score>{NUMBER})(?![\w.]*\d)")
SPREAD = re.compile(rf"({NUMBER})\s+\(({NUMBER})\s+to\s+({NUMBER})\)")
RANGE = re.compile(rf"({NUMBER})\s+to\s+({NUMBER})")
LINK = re.compile(r"\]\((?P<file>[^)#\s]+\.(?:csv|md|json))(?:#[^)]*)?\)")
CODE = re.compile(r"^```.*?^```[ \t]*$|`[^`\n]*`|\]\([^)]*\)", re.MULTILINE | re.DOTALL)
ROW = re.compile(r"^\|.*$", re.MULTILINE)
HEADING = re.compile(r"^#+ .*$", re.MULTILINE)
EVERYWHERE = "published.csv"  # scores that the paper and others report, valid in every section
SCORED = (*("mean_reward", "mean_reward_dense", "coverage", "solved", "filled"),)
SLACK = 0.500001  # tolerance of rounding, in units of the last digit shown


class Known(NamedTuple):
    """The numbers of some files, by the way a page may show them.

    Attributes:
        single: (N,) numbers that may be shown alone.
        spreads: (M, 3) median, least and most, which may be shown together.
        cells: (K,) numbers of files that hold no runs; any three may be shown together.
    """

    single: Floats
    spreads: Floats
    cells: Floats


def check(results: Path, pages: Iterable[Path]) -> list[str]:
    """Error texts for all scores on the pages that are in none of the linked files.

    Args:
        results: folder of the CSV files.
        pages: Markdown files.

    Raises:
        RunError: a file of results cannot be read.
    """
    return [f"{page.name}: {wrong}" for page in pages for wrong in check_page(results, page)]


def check_page(results: Path, page: Path) -> Iterator[str]:
    """Error texts for the scores of one page that are in none of the linked files."""
    text = page.read_text(encoding="utf-8")
    starts = [0, *(found.start() for found in HEADING.finditer(text)), len(text)]
    sections = [text[one:other] for one, other in pairwise(starts)]
    every = list(dict.fromkeys(_linked(results, page, text)))
    for section in sections:
        for part, linked in _parts(results, page, section):
            scores = dict.fromkeys(_scores(part))
            if not scores:
                continue
            heading, files = section.splitlines()[0], linked or every
            if not files:
                yield f"{heading}: it has scores but links no file of results"
                continue
            known = _together((*files, results / EVERYWHERE))
            for score in scores:
                if not _stands(score, known):
                    names = ", ".join(one.name for one in files)
                    yield f"{heading}: {_told(score)} is not in {names}"


def _parts(results: Path, page: Path, section: str) -> Iterator[tuple[str, list[Path]]]:
    """Each row of a section's tables that links files, and all else, with the files they link."""
    rows = {row: list(dict.fromkeys(_linked(results, page, row))) for row in ROW.findall(section)}
    own = {row: files for row, files in rows.items() if files}
    yield from own.items()
    rest = ROW.sub(lambda found: "" if found[0] in own else found[0], section)
    yield rest, list(dict.fromkeys(_linked(results, page, section)))


def _scores(section: str) -> Iterator[tuple[str, ...]]:
    """Scores of a section: a spread as three numbers, a range as two, any other score as one."""
    bare = CODE.sub("", section)
    for pattern in (SPREAD, RANGE, SCORE):
        for found in pattern.finditer(bare):
            yield found.groups()
        bare = pattern.sub("", bare)


def _told(score: tuple[str, ...]) -> str:
    return f"{score[0]} ({score[1]} to {score[2]})" if len(score) == 3 else " to ".join(score)


def _linked(results: Path, page: Path, text: str) -> Iterator[Path]:
    """CSV and JSON files that a text links; a link to a page of tables counts as its CSV."""
    for found in LINK.finditer(text):
        path = (page.parent / found["file"]).resolve()
        if path.suffix == ".md" and path.parent == results.resolve():
            path = path.with_suffix(".csv")
        if path.suffix in (".csv", ".json") and path.exists():
            yield path


def _together(files: tuple[Path, ...]) -> Known:
    found = [known for path in files if path.exists() for known in [read_known(path)]]
    return Known(*map(np.concatenate, zip(*found, strict=True)))


@cache
def read_known(path: Path) -> Known:
    """The numbers of one CSV or JSON file.

    Raises:
        RunError: the file cannot be read.
    """
    none, empty = np.zeros((0, 3)), np.zeros(0)
    if path.suffix == ".json":
        try:
            cells = np.array([*_numbers(json.loads(path.read_text()))], float)
        except (OSError, ValueError) as error:
            raise RunError(f"{path}: cannot be read ({error}): restore it") from None
        return Known(cells, none, cells)
    rows = read_rows(path)
    if not of_a_study(rows):
        cells = rows.select_dtypes("number").to_numpy(float).ravel()
        return Known(cells, none, cells)
    groups = [spreads(rows, name).values() for name in SCORED if name in rows]
    three = np.array([one for group in groups for one in group], float).reshape(-1, 3)
    return Known(three[:, 0], three, empty)


def _numbers(content: Any) -> Iterator[float]:
    if isinstance(content, dict):
        content = list(content.values())
    if isinstance(content, list):
        for one in content:
            yield from _numbers(one)
    elif isinstance(content, int | float):
        yield float(content)


def _stands(score: tuple[str, ...], known: Known) -> bool:
    """Whether one number, a range (2) or a median with its range (3) is among the known numbers.

    The two ends of a range may come from different trainings.
    """
    if len(score) == 1:
        return bool(_near(known.single, score[0]).any())
    if len(score) == 2:
        ends = zip(known.spreads.T[1:], score, strict=True)
        return all(_near(column, text).any() for column, text in ends)
    near = [_near(column, text) for column, text in zip(known.spreads.T, score, strict=True)]
    loose = all(_near(known.cells, text).any() for text in score)
    return loose or bool(np.logical_and.reduce(near).any())


def _near(numbers: Floats, text: str) -> np.ndarray[Any, Any]:
    """(N,) whether each number, rounded like `text`, is the number in `text`."""
    value = text.replace("\N{MINUS SIGN}", "-").rstrip("% ")
    slack = SLACK * 10.0 ** -len(value.partition(".")[2])
    shown = numbers * (100.0 if text.endswith("%") else 1.0)
    return np.abs(shown - float(value)) <= slack
