"""Whether what pages show is in the data: every score of a page names its source.

A comment above a paragraph, a list or a table says where its numbers are from:

    <!-- data: worlds/robustness --> that experiment's section of the tables in docs/results/worlds
    <!-- data: silhouettes.json -->  a file of docs/results
    <!-- data: pretrained/square --> the card of an agent that comes with the package
    <!-- data: paper -->             the paper's own numbers
    <!-- data: commit 0123abc -->    an older commit, which the text must name, too
    <!-- data: none -->              no score: a setting, a size
"""

import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.progress import track

from master.console import sturdy_console
from tangram_agent.pretrained import CARD, PACKAGED, is_name
from tangram_lab.experiments.fingerprints import (
    UPDATES,
    differences,
    make_facts,
    make_fingerprints,
)
from tangram_lab.experiments.jobs import BOUNDS, changed_settings
from tangram_lab.experiments.plan import KEPT, StudyConfig, plan_content
from tangram_lab.experiments.report.data import DATA, read_data
from tangram_lab.experiments.report.page import (
    FIGURES,
    TABLES,
    arguments,
    drawn_again,
    figure_sums,
)
from tangram_lab.experiments.report.reading import parsed, read_bytes
from tangram_lab.experiments.report.references import VALUES
from tangram_lab.experiments.report.study import Row, Study, Training
from tangram_lab.experiments.report.whole import COMMIT, contradicts, lacks
from tangram_sim.errors import RunError

MARK = re.compile(r"<!-- data: (?P<sources>[^>]+?) -->")
# Three decimals and more, or a percentage with one: scores have as many, and little else has. How
# the tables write none is found, too, and told.
SCORE = re.compile(
    r"(?<![^\W_])(?<![^\W_]\.)[-\N{MINUS SIGN}]?\d*\."
    r"(?:\d+(?:\s|&\w+;)*%|\d{3,}(?![^\W_]|\.\d))"
)
WRITTEN = re.compile(r"-?\d+\.(?:\d+ %|\d+)")
CODE = re.compile(r"^(?P<fence>```+)[^`\n]*\n.*?^(?P=fence)`*[ \t]*$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`[^`\n]*`|\]\([^)]*\)")
FILE = r"(?:[\w-]+/)?(?!data\.)[\w-]+\.json"  # beside the reports
LAST = "\n## How it was made\n"  # where the last section of tables ends
SECTION = re.compile(r'^<a id="(?P<name>[^"]+)"></a>$', re.MULTILINE)
MEND = "make it anew"
NO_SCORE, OLDER, PAPERS = "none", "commit", "paper"
Resolve = Callable[[Sequence[str]], Mapping[str, Any]]  # of tangram-train -> the whole config
Choose = Callable[[list[str]], StudyConfig]  # of tangram-experiment -> the study


def check(results: Path, pages: Iterable[Path], resolve: Resolve, choose: Choose) -> list[str]:
    """What is wrong; nothing where every figure is in the data, and the data are of this code.

    Args:
        results: folder whose folders were made by tangram-report; files of benchmarks lie beside.
        pages: that show figures.
        resolve: the whole config that a training's arguments come to.
        choose: the study that the arguments of tangram-experiment come to.

    Raises:
        RunError: the data cannot be read.
        ConfigError: this code refuses a training or an experiment of them.
    """
    found, tables, studies = list[str](), dict[str, str](), dict[str, Study]()
    for folder in reports(results):
        study, figures = read_data(folder / DATA)
        tables[folder.name], studies[folder.name] = _text(folder / TABLES), study
        text, drawn = drawn_again(study)
        again = f"make it anew with tangram-report runs={folder} out={folder}"
        if text != tables[folder.name]:
            found.append(f"{folder / TABLES} is not what {DATA} gives: {again}")
        kept = figure_sums(folder).items()
        if others := (figures.items() ^ kept) | (drawn.items() ^ kept):
            wrong = min(others)[0]
            found.append(f"{folder / FIGURES} has not the figures of {DATA}, as {wrong}: {again}")
        found += (
            f"{folder.name}/{line}"
            for line in (*lacks(study), *contradicts(study), *_planned_otherwise(study, choose))
        )
    found += _trained_otherwise(studies, resolve)
    numbers = Sources(results, tables)
    for page in pages:
        found += check_page(page.name, _text(page), numbers)
    return found


def reports(results: Path) -> list[Path]:
    """The folders of all reports.

    Raises:
        RunError: there are none, or one has no data.
    """
    folders = sorted({path.parent for name in (DATA, TABLES) for path in results.glob(f"*/{name}")})
    for folder in folders:
        if not (folder / DATA).exists():
            raise RunError(f"{folder} has {TABLES} and no {DATA}: make them with make evidence")
    if not folders:
        raise RunError(f"no report is in {results}: make them with make evidence")
    return folders


def _text(path: Path) -> str:
    text = read_bytes(path, "make it anew with tangram-report")
    try:
        return text.decode().replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError:
        raise RunError(f"{path}: it is not UTF-8; mend it") from None


def _planned_otherwise(study: Study, choose: Choose) -> Iterator[str]:
    """Where the commands that the page prints would plan something else now."""
    config = choose(arguments(study, [one.name for one in study.experiments]))
    now = plan_content(config, {}, {name: {} for name in config.wanted()})
    for key in ("experiments", "trainings", "tests"):
        for name, before in study.plan[key].items():
            if (planned := now[key].get(name)) is None:
                yield f"{name} would not be among the {key} now"
                continue
            for part, value in planned.items():
                # Settings are compared where they are resolved.
                if part != "settings" and _plain(before.get(part)) != _plain(value):
                    yield f"{name} would be made otherwise now: {part} is {value}"
    for part, value in now["budget"].items():
        if study.plan["budget"].get(part) != value:
            yield f"the budget's {part} is now {value}"


def _plain(value: object) -> object:
    """As JSON has it."""
    return list(value) if isinstance(value, tuple) else value


def _trained_otherwise(studies: Mapping[str, Study], resolve: Resolve) -> Iterator[str]:
    """The trainings that have other settings now, or would come to other numbers."""
    planned = [(report, study, one) for report, study in studies.items() for one in study.trainings]
    console = sturdy_console(sys.stderr)
    trainings = {
        f"{report}/{one.name}": (one, resolve(one.overrides), study.fingerprints.get(one.name, {}))
        for report, study, one in track(planned, "settings", console=console, transient=True)
    }
    for name, (one, config, _) in trainings.items():
        known = changed_settings(one.settings, config, one.settings)
        left = [part for part in KEPT if part in config and part not in one.settings]
        for change in (*known, *(f"nobody kept {part}" for part in left)):
            yield f"{name} has not the settings that it was trained with: {change}"
        yield from _of_another(name, one, config)
    now = make_fingerprints({name: config for name, (_, config, _) in trainings.items()})
    for name, (_, _, before) in trainings.items():
        if not before:
            yield f"{name} has no fingerprint: nothing tells whether this code trains alike"
        elif others := differences(before, now[name]):
            yield (
                f"{name} trains otherwise than when its figures were made: after {UPDATES} updates "
                f"{', '.join(others)}: make them anew with make evidence KEEP=yes"
            )


def _of_another(name: str, training: Training, config: Mapping[str, Any]) -> Iterator[str]:
    """Results that no run of a training can have: they are of another one."""
    values = {name: config[name] for name in BOUNDS if config.get(name)}
    bounds = [
        f"{name}={value if type(value) is int else f'{value:g}'}" for name, value in values.items()
    ]
    facts = make_facts(config) if training.finished else {}
    for seed in training.finished:
        told = f"{name}, seed {seed.number} is of another training"
        for key, fact in facts.items():
            if seed.result.get(key) != fact:
                yield f"{told}: its {key} is {seed.result.get(key)}, not {fact}"
        if seed.result["ended_by"] not in bounds:
            yield f"{told}: it was ended by {seed.result['ended_by']}, not by {' or '.join(bounds)}"


class Sources:
    """The numbers that may stand on pages, by the names of their sources."""

    def __init__(self, results: Path, tables: Mapping[str, str]) -> None:
        """Take the tables of each report by its name; files are read when they are named."""
        self._results = results
        self._sections = dict[str, str]()
        for report, text in tables.items():
            parts = SECTION.split(text)[1:]
            for name, section in zip(parts[::2], parts[1::2], strict=True):
                if f"{report}/{name}" in self._sections:
                    raise RunError(f"{TABLES} of {report} has {name} twice: {MEND}")
                self._sections[f"{report}/{name}"] = section.partition(LAST)[0]

    def has(self, source: str, text: str) -> bool:
        """Whether a number, as it is written, is one of a source.

        Raises:
            RunError: there is no such source.
        """
        if source == NO_SCORE:
            return True
        if source == PAPERS:
            return text in (f"{number:.3f}" for number in _numbers(VALUES))
        if source in self._sections:
            return bool(re.search(rf"(?<![\d.-]){re.escape(text)}(?!\d)", self._sections[source]))
        return any(_rounds_to(number, text) for number in self._file(source))

    def _file(self, name: str) -> Iterator[float]:
        ours = is_name(name)
        path = Path(str(PACKAGED), Path(name).name, CARD) if ours else self._results / name
        if not (ours or re.fullmatch(FILE, name)) or not path.is_file():
            raise RunError(
                f"no source is called {name}: name REPORT/EXPERIMENT, a .json file of "
                f"{self._results}, {PAPERS}, {OLDER} or {NO_SCORE}"
            )
        yield from _numbers(parsed(read_bytes(path, MEND), Row, str(path), MEND)[0])


def _numbers(content: Any) -> Iterator[float]:
    if isinstance(content, Mapping):
        content = list(content.values())
    if isinstance(content, list | tuple):
        for one in content:
            yield from _numbers(one)
    elif isinstance(content, float) or type(content) is int:
        yield content


def _rounds_to(number: float, text: str) -> bool:
    """Whether a number is written so, as it is or halfway between two."""
    written, percent, _ = text.partition(" %")
    digits = len(written.partition(".")[2])
    shown = 100.0 * number if percent else number
    return abs(shown - float(written)) <= 0.500001 * 10.0**-digits


def check_page(name: str, text: str, numbers: Sources) -> Iterator[str]:
    """The scores of a page that have no source, or are not in it."""
    sources: str | None = None
    for line, block in _blocks(text):
        mark = MARK.match(block.lstrip())
        sources = mark["sources"] if mark else sources
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
        if not (rest and all(re.fullmatch(COMMIT, one) for one in rest)):
            return f"has the source {sources}: name the commit by 7 digits or more"
        missing = [one for one in rest if one not in block]
        return f"is of commit {missing[0]}, which the text does not say" if missing else ""
    if first != NO_SCORE and not WRITTEN.fullmatch(score):
        return "is not written as in the tables: write 0.123, -0.123 or 12.3 %"
    try:
        found = any(numbers.has(source, score) for source in (first, *rest))
    except RunError as error:
        return f"has a source that is none: {error}"
    return "" if found else f"is not in {sources}"


def _blocks(text: str) -> Iterator[tuple[int, str]]:
    """What blank lines and marks set apart, with the number of its first line; without code."""
    blank = CODE.sub(lambda found: "\n" * found[0].count("\n"), text)
    line = 1
    for block in re.split(r"(\n[ \t]*\n|\n(?=<!-- data: ))", blank):
        if block.strip():
            yield line + len(block) - len(block.lstrip("\n")), block
        line += block.count("\n")
