"""tangram-report check: every score of a page is in a file that its section links."""

import json
from pathlib import Path

import pytest

from tangram_lab.experiments.check import check, read_known
from tests.test_docs import PRESENT, ROOT

pytestmark = pytest.mark.fast

PAGE = """# Page

[rows](results/game.csv) and [speeds](results/bench.json)

## Scores

It has 0.500 (0.250 to 0.750), solves 12.5 % and is 0.1235 fast; `0.999` is code.

## Another

Only [speeds](results/bench.json): 0.123.
"""
ROWS = """training,seed,test,policy,mean_reward,solved
one,0,a,agent,0.25,0.125
one,1,a,agent,0.5,0.125
one,2,a,agent,0.75,0.125
one,,a,exact,0.90625,
"""


@pytest.fixture
def page(tmp_path: Path) -> Path:
    """A page whose scores are all right."""
    read_known.cache_clear()
    results = tmp_path / "results"
    results.mkdir()
    (results / "game.csv").write_text(ROWS)
    (results / "bench.json").write_text(json.dumps({"rows": [{"ours": 0.12345}]}))
    (results / "published.csv").write_text("source,value\nthe paper,0.758\n")
    path = tmp_path / "page.md"
    path.write_text(PAGE)
    return path


def told(page: Path) -> list[str]:
    read_known.cache_clear()
    return check(page.parent / "results", [page])


def test_every_score_of_readme_and_docs_is_in_its_files() -> None:
    read_known.cache_clear()
    pages = [path for path in PRESENT if path.parent in (ROOT, ROOT / "docs")]
    assert len(pages) > 10
    assert check(ROOT / "docs" / "results", pages) == []


def test_scores_that_are_there_are_fine(page: Path) -> None:
    assert told(page) == []


@pytest.mark.parametrize(
    ("before", "after", "wrong"),
    [
        ("0.500 (0.250", "0.501 (0.250", "## Scores: 0.501 (0.250 to 0.750) is not in"),
        ("to 0.750)", "to 0.751)", "## Scores: 0.500 (0.250 to 0.751) is not in"),
        ("12.5 %", "12.6 %", "## Scores: 12.6 % is not in"),
        ("0.1235", "0.1236", "## Scores: 0.1236 is not in"),
        (": 0.123.", ": 0.500.", "## Another: 0.500 is not in bench.json"),
        ("and [speeds]", "and 0.759 [speeds]", "# Page: 0.759 is not in game.csv, bench.json"),
    ],
)
def test_another_number_on_a_page_is_told(before: str, after: str, wrong: str, page: Path) -> None:
    assert before in PAGE
    page.write_text(PAGE.replace(before, after))
    (line,) = told(page)
    assert line.startswith(f"page.md: {wrong}")


@pytest.mark.parametrize(
    ("cell", "other"), [("one,0,a,agent,0.25", "one,0,a,agent,0.26"), ("0.125\n", "0.135\n")]
)
def test_another_cell_in_a_csv_is_told(cell: str, other: str, page: Path) -> None:
    (page.parent / "results" / "game.csv").write_text(ROWS.replace(cell, other))
    assert len(told(page)) == 1


def test_a_row_with_links_is_checked_against_these_alone(page: Path) -> None:
    row = "| [speeds](results/bench.json) | 0.123 | 0.500 |"
    page.write_text(PAGE.replace("## Scores", f"{row}\n\n## Scores"))
    assert told(page) == ["page.md: # Page: 0.500 is not in bench.json"]


def test_what_the_paper_reports_may_stand_everywhere(page: Path) -> None:
    page.write_text(PAGE + "The paper has 0.758, a rival 0.906.\n")
    (line,) = told(page)
    assert "0.906 is not in bench.json" in line


def test_scores_without_a_link_are_told(page: Path) -> None:
    page.write_text("# Page\n\nIt has 0.500.\n")
    assert told(page) == ["page.md: # Page: it has scores but links no file of results"]
