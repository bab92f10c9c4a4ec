"""The fenced blocks of README and docs, each with what becomes of it.

A comment on the line before a block tells it, and is not seen where the page is read:

    <!-- run: quick -->             runs in the gate, pasted as it stands into an empty folder
    <!-- run: check -->             the same by make check: it takes many seconds
    <!-- run: on request -->        the same, but only with python -m tests.blocks
    <!-- run: on request, in a clone -->    in one clone of this repository, in the page's order
    <!-- run: on request, in terminals -->  each line beside the ones before; the last when they end
    <!-- run: quick, with runs/square -->   beside the folder of a short training that has ended
    <!-- run: never, needs Docker -->       and why
    <!-- file: mine.json -->        lies under this name in each folder that a block runs in

What is printed or drawn is ```text and needs none. A block without a tag is a fault.

    python -m tests.blocks [PAGE[:LINE] ...]

runs the blocks of these pages, or at these lines, with a line for each; without any, all that can
run, which takes many hours. It ends with status 1 when one has not held.
"""

import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from textwrap import dedent

ROOT = Path(__file__).parents[1]
BIN = Path(sys.executable).parent
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    ROOT / "docker" / "README.md",
    ROOT / "tangram_lab" / "benchmarks" / "README.md",
]
FENCED = re.compile(
    r"^(?: *<!-- (?P<tag>.*?) -->\n)? *(?P<fence>```+|~~~+)(?P<language>.*)\n"
    r"(?P<code>(?:.*\n)*?) *(?P=fence)$",
    re.MULTILINE,
)
TAG = re.compile(
    r"run: (?P<when>quick|check|on request)(?:, in (?P<place>a clone|terminals))?"
    r"(?:, with (?P<run>runs/\w+))?|run: never, \S.*|file: (?P<file>[\w.]+)"
)
SHORT = ("max_updates=800", "service.eval_seconds=10")  # a training of some 25 s


@dataclass(frozen=True)
class Block:
    """A fenced block and its tag, if it has one that can be read."""

    page: str
    line: int  # of its fence
    language: str
    code: str
    tag: re.Match[str] | None

    @property
    def name(self) -> str:
        return f"{self.page}:{self.line}"

    def says(self, group: str) -> str | None:
        return self.tag[group] if self.tag else None

    @property
    def fault(self) -> bool:
        """Whether nobody said what becomes of it, or nobody could do it."""
        if not self.says("when"):
            return self.tag is None and self.language != "text"
        return self.language not in ("bash", "python")


def blocks_of(text: str, page: str) -> Iterator[Block]:
    for found in FENCED.finditer(text):
        line = text[: found.start("fence")].count("\n") + 1
        tag = TAG.fullmatch(found["tag"] or "")
        yield Block(page, line, found["language"], dedent(found["code"]), tag)


@cache
def all_blocks() -> tuple[Block, ...]:
    named = [(page.read_text(), str(page.relative_to(ROOT))) for page in PAGES]
    return tuple(block for text, page in named for block in blocks_of(text, page))


def prepare(block: Block, folder: Path, made: Callable[[str], Path]) -> Path:
    """Fill a folder with what the tags promise; where the block runs."""
    if block.says("place") == "a clone":
        return made("clone")
    for other in all_blocks():
        if name := other.says("file"):
            (folder / name).write_text(other.code)
    if run := block.says("run"):
        shutil.copytree(made("trained"), folder / run)
    return folder


def run(block: Block, folder: Path) -> subprocess.CompletedProcess[str]:
    """In a process of its own; a shell stops at the first line that fails."""
    code = block.code
    if block.says("place") == "terminals":
        *others, last = [line.partition("#")[0].strip() for line in code.splitlines()]
        started = "".join(f"{line} & started+=($!)\n" for line in others)
        code = f'{started}for one in "${{started[@]}}"; do wait "$one"; done\n{last}'
    shell = ["bash", "-euo", "pipefail", "-c", code]
    return subprocess.run(
        shell if block.language == "bash" else [BIN / "python", "-c", code],
        cwd=folder,
        env=os.environ | {"PATH": f"{BIN}:{os.environ['PATH']}", "SDL_VIDEODRIVER": "dummy"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )


def main(wanted: list[str]) -> int:
    can = [block for block in all_blocks() if block.says("when")]
    unknown = {*wanted} - {name for block in can for name in (block.name, block.page)}
    if unknown:
        print(f"no block that can run: {', '.join(sorted(unknown))}", file=sys.stderr)
        return 2
    chosen = [block for block in can if not wanted or {block.name, block.page} & {*wanted}]
    held = 0
    with TemporaryDirectory(prefix="blocks-") as scratch:

        @cache
        def made(what: str) -> Path:
            path = Path(scratch) / what
            train = [f"{BIN}/tangram-train", f"run_dir={path}", *SHORT]
            clone = ["git", "clone", "--quiet", str(ROOT), str(path)]
            subprocess.run(clone if what == "clone" else train, check=True)
            return path

        for number, block in enumerate(chosen):
            folder = Path(scratch) / str(number)
            folder.mkdir()
            start = time.monotonic()
            done = run(block, prepare(block, folder, made))
            took = f"{block.name} ({time.monotonic() - start:.0f} s)"
            held += done.returncode == 0
            if done.returncode == 0:
                print(f"held      {took}", flush=True)
            else:
                said = done.stdout.strip().splitlines()[-1:] or ["nothing printed"]
                print(f"NOT HELD  {took}: status {done.returncode}, {said[0]}", flush=True)
    print(f"{held} of {len(chosen)} held")
    return 0 if held == len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
