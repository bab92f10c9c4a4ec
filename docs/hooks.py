"""What goes into the documentation site: the repository's own pages, each at its own path.

Links between them hold on the site as they do in the repository, and no page is copied. In are the
pages of mkdocs.yml, all of docs/, and the files that they link to. A page of api/ is named after the
module whose docstrings it shows.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """The theme's files, and ours by their paths in the repository."""
    ours = [file for file in files if file.src_dir != config.docs_dir]
    named = set(_named(config.nav))
    pages = {name for name in named if (ROOT / name).is_file()}
    pages |= {str(page.relative_to(ROOT)) for page in (ROOT / "docs").rglob("*.md")}
    linked = {name for page in pages for name in _linked(ROOT / page)}
    for name in sorted({*pages, *linked, *map(str, config.extra_css)}):
        ours.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    for name in sorted(named - pages):
        if name.startswith("api/"):
            module = Path(name).stem
            text = f"# {module}\n\n::: {module}\n"
            ours.append(File.generated(config, name, content=text))
    return Files(ours)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """As GitHub does, read what is folded as Markdown, too."""
    return markdown.replace("<details>", '<details markdown="1">')


def _named(nav: Any) -> Iterator[str]:
    """The paths in a navigation."""
    if isinstance(nav, str):
        yield nav
    else:
        for part in nav.values() if isinstance(nav, dict) else nav:
            yield from _named(part)


def _linked(page: Path) -> Iterator[str]:
    """The files of the repository that a page links to and that are no pages."""
    for link in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
        target = (page.parent / link).resolve()
        if target.is_file() and target.suffix != ".md" and target.is_relative_to(ROOT):
            yield str(target.relative_to(ROOT))
