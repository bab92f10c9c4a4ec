"""Whether every score on a page stands in the CSV files that its section links.

A score is a number of three decimals and more, or a percentage with one. A section is what stands
under a heading; where it links no file of results, those of the page's beginning count, or else all
that the page links. What stands in code is no score.
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
HEADING = re.compile(r"^#+ .*$", re.MULTILINE)
EVERYWHERE = "published.csv"  # what others report, the paper above all
SCORED = (*("mean_reward", "mean_reward_dense", "coverage", "solved", "filled"),)
SLACK = 0.500001  # of the last digit: as it is, or halfway between two


class Known(NamedTuple):
    """The numbers of some files.

    Attributes:
        single: (N,) that may stand alone.
        spreads: (M, 3) median, least and most that may stand together.
        cells: (K,) of files without runs, where any three may stand together.
    """

    single: Floats
    spreads: Floats
    cells: Floats


def check(results: Path, pages: Iterable[Path]) -> list[str]:
    """What is wrong: scores of pages that stand in none of the files that they link.

    Args:
        results: folder of the CSV files.
        pages: that show scores.

    Raises:
        RunError: a file cannot be read.
    """
    return [f"{page.name}: {wrong}" for page in pages for wrong in check_page(results, page)]


def check_page(results: Path, page: Path) -> Iterator[str]:
    """The scores of one page that have no source."""
    text = page.read_text(encoding="utf-8")
    starts = [0, *(found.start() for found in HEADING.finditer(text)), len(text)]
    sections = [text[one:other] for one, other in pairwise(starts)]
    every = list(dict.fromkeys(_linked(results, page, text)))
    for section in sections:
        scores = dict.fromkeys(_scores(section))
        if not scores:
            continue
        files = list(dict.fromkeys(_linked(results, page, section))) or every
        if not files:
            yield f"{section.splitlines()[0]}: it has scores and links no file of results"
            continue
        known = _together((*files, results / EVERYWHERE))
        for score in scores:
            if not _stands(score, known):
                names = ", ".join(one.name for one in files)
                yield f"{section.splitlines()[0]}: {_told(score)} is not in {names}"


def _scores(section: str) -> Iterator[tuple[str, ...]]:
    """Every spread as three numbers, every range as two, every other score as one."""
    bare = CODE.sub("", section)
    for pattern in (SPREAD, RANGE, SCORE):
        for found in pattern.finditer(bare):
            yield found.groups()
        bare = pattern.sub("", bare)


def _told(score: tuple[str, ...]) -> str:
    return f"{score[0]} ({score[1]} to {score[2]})" if len(score) == 3 else " to ".join(score)


def _linked(results: Path, page: Path, text: str) -> Iterator[Path]:
    """The files of numbers that a text links; a page of tables stands for its CSV."""
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
    """The numbers of one file.

    Raises:
        RunError: it cannot be read.
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
    """Whether a number, a least and a most, or a median with both, are among those that are known.

    A least and a most may be of two trainings.
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
    """(N,) whether a number is written so."""
    value = text.replace("\N{MINUS SIGN}", "-").rstrip("% ")
    slack = SLACK * 10.0 ** -len(value.partition(".")[2])
    shown = numbers * (100.0 if text.endswith("%") else 1.0)
    return np.abs(shown - float(value)) <= slack
