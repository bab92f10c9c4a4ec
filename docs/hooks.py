"""What goes into the documentation site: the repository's own pages, each at its own path.

Links between them hold on the site as they do in the repository, and no page is copied. In are the
pages of mkdocs.yml, all of docs/, and the files that they link to. A page of api/ is named after
the module whose docstrings it shows.
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
    docs = [*(ROOT / "docs").rglob("*.md"), *(ROOT / "docs").glob("*.css")]
    kept = {name for name in named if (ROOT / name).is_file()}
    kept |= {str(path.relative_to(ROOT)) for path in docs}
    kept |= {name for page in kept for name in _linked(ROOT / page)}
    modules = {name: Path(name).stem for name in named if name.startswith("api/")}
    return Files(
        [
            *ours,
            *(File.generated(config, name, abs_src_path=str(ROOT / name)) for name in kept),
            *(
                File.generated(config, name, content=f"# {module}\n\n::: {module}\n")
                for name, module in modules.items()
            ),
        ]
    )


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
