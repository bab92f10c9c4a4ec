"""The page of a report with its figures and its data."""

import shlex
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory

from matplotlib.figure import Figure

from tangram_agent.files import write_whole
from tangram_lab.experiments.pictures import draw_paper_pictures
from tangram_lab.experiments.plan import PLAN
from tangram_lab.experiments.report.data import DATA, read_data, write_data
from tangram_lab.experiments.report.figures import (
    curve_parts,
    draw_curves,
    draw_ranking,
    draw_single_seeds,
    draw_sweep,
    draw_worlds,
    sweep_parts,
    sweeps,
)
from tangram_lab.experiments.report.numbers import ANGLE, DENSE, REWARD
from tangram_lab.experiments.report.profiles import draw_profile
from tangram_lab.experiments.report.reading import read_runs
from tangram_lab.experiments.report.references import lacking
from tangram_lab.experiments.report.study import Experiment, Study, Training
from tangram_lab.experiments.report.style import drawing, save
from tangram_lab.experiments.report.tables import (
    assembly_table,
    complexity_table,
    details,
    effort_table,
    order_table,
    picture,
    plain,
    puzzle_order_table,
    ranking_table,
    score_table,
    shell,
    table,
    test_table,
    worlds_table,
)
from tangram_sim.errors import RunError

TABLES, FIGURES = "tables.md", "figures"
HOW_TO_READ = (
    "Scores are those of the fixed tests, exploration off. The mean reward is Eq. 14 on exact "
    "polygons: -1 is no overlap, 1 is perfect. Where several seeds were trained, numbers are their "
    "median, with the least and the most in brackets. Three policies that learned nothing stand "
    "beside them: *position only* asks for the motion to the target's centre and never for a turn, "
    "*exact oracle* asks for the exact motion onto the target as it is seen, *random* is chance."
)
BAND = (
    "Mean over the seeds; the band is one standard deviation (n - 1). A curve is drawn over the "
    "range that all seeds of its training cover. An axis is logarithmic where curves rise early. A "
    "colour is an agent with its network, in every figure."
)
DOTS = (
    "Final scores: a dot for each seed, a tick at the median; the diamonds are what the "
    "position-only policy scores at the row's task."
)
SMALL = (
    "Every seed's test scores while it trains; the range of the first training stands in grey "
    "behind each."
)
PROFILE = (
    "The share of an agent's runs that fall short of a perfect mean reward by no more than so "
    "much, with a stratified bootstrap's interval (Agarwal et al. 2021)."
)
SWEEP = "Median over the seeds; the band goes from the least to the most."
WORLDS = (
    "Median over the seeds; the band goes from the least to the most. Where a world does as it is "
    "told, but for noise on actions, nothing is left to know: the other two lie on the formula."
)
REACHED = (
    "Between which episodes: at the last evaluation before, and at the first that had the mean "
    "reward; medians over the seeds."
)


def write_report(runs: Path, out: Path) -> list[Path]:
    """Report on a study; files of an earlier report in the same place are replaced.

    Args:
        runs: the study's folder, one whose folders are runs, or an earlier report.
        out: folder for tables.md, data.json and figures/.

    Returns:
        The page and the data.

    Raises:
        RunError: a file of the study is not what it should be, no run is finished, or `out` cannot
            be written.
    """
    study = read_runs(runs) if _is_study(runs) else read_data(runs / DATA)[0]
    if not any(one.finished for one in study.trainings):
        raise RunError(f"no run is finished in {runs}: wait for one, or name another folder")
    try:
        (out / FIGURES).mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=".report-", dir=out) as folder:
            made = Path(folder)
            _make(study, made)
            names = [f"{FIGURES}/{path.name}" for path in sorted((made / FIGURES).iterdir())]
            for name in (*names, DATA, TABLES):
                (made / name).replace(out / name)
    except OSError as error:
        raise RunError(
            f"cannot write to {out} ({error.strerror}): make room, or choose another folder with "
            "out=..."
        ) from None
    return [out / TABLES, out / DATA]


def _is_study(folder: Path) -> bool:
    """Whether runs are here; what has the data of a report alone is one."""
    return (folder / PLAN).exists() or not (folder / DATA).exists()


def _make(study: Study, out: Path) -> None:
    """All files of a report, in a folder of their own: an earlier one stays whole until then."""
    write_data(out / DATA, study, {})
    if study.plan:  # what is drawn is what the data have
        study, _ = read_data(out / DATA)
    write_whole(out / TABLES, _drawn(study, out).encode())
    write_data(out / DATA, study, figure_sums(out))


def _drawn(study: Study, out: Path) -> str:
    (out / FIGURES).mkdir()
    with drawing():
        return Page(study, out).text()


def drawn_again(study: Study) -> tuple[str, dict[str, str]]:
    """The page of a study, and the sums of its figures, as this code draws them."""
    with TemporaryDirectory() as folder:
        return _drawn(study, Path(folder)), figure_sums(Path(folder))


def figure_sums(out: Path) -> dict[str, str]:
    """File of a figure -> SHA-256 of its content; nothing without a folder of them."""
    files = sorted((out / FIGURES).glob("*"))  # git keeps no folder that is empty
    return {path.name: sha256(path.read_bytes()).hexdigest() for path in files if path.is_file()}


@dataclass(frozen=True)
class Page:
    """The page of a study, and the folder where its figures are drawn."""

    study: Study
    out: Path

    def text(self) -> str:
        """The whole page."""
        lines = [*self.opening(), *self.pictures()]
        for experiment in self.study.experiments:
            lines += self.section(experiment)
        return "\n".join([*lines, *closing(self.study)]).rstrip() + "\n"

    def opening(self) -> list[str]:
        """Title, how to read it, and the experiments."""
        study = self.study
        rows = [
            (f"[{plain(one.title)}](#{one.name})", one.source, finished_count(one.trainings))
            for one in study.experiments
        ]
        return [
            *(f"# Experiments, budget `{study.budget.name}`" if study.plan else "# Runs", ""),
            *(plain(study.budget.note), "", HOW_TO_READ, ""),
            *table(["experiment", "source", "runs finished"], rows, "---"),
            f"`tangram-report` wrote this page; [{DATA}]({DATA}) holds all of its numbers.",
            "",
        ]

    def pictures(self) -> list[str]:
        """The paper's Figs. 1 to 3, where other figures or tables of it are."""
        lines: list[str] = []
        if not any(one.source.startswith(("Fig.", "Table")) for one in self.study.experiments):
            return lines
        for title, file, caption in draw_paper_pictures(self.out / FIGURES):
            lines += [f"## {plain(title)}", "", *picture(title, f"{FIGURES}/{file}")]
            lines += [f"*{plain(caption)}*", ""]
        return lines

    def section(self, experiment: Experiment) -> list[str]:
        """All lines of an experiment; its figures are written on the way."""
        lines = [f'<a id="{experiment.name}"></a>', "", f"## {plain(experiment.title)}", ""]
        if self.study.plan:
            lines += [f"Source: {plain(experiment.source)}. {plain(experiment.note)}", ""]
        if any(one.finished for one in experiment.trainings):
            kinds: dict[str, Callable[[Experiment], list[str]]] = {
                "curves": self._curves,
                "rewards": self._curves,
                "complexity": complexity_table,
                "tests": self._tests,
                "ranking": self._ranking,
                "game": lambda one: [*assembly_table(one), *_orders(one)],
                "worlds": self._worlds,
            }
            lines += kinds[experiment.kind](experiment)
            left_out = lacking(self.study, experiment)
            if left_out and experiment.kind not in ("complexity", "game", "worlds"):
                told = plain("; ".join(left_out))
                lines += [f"Left out, since no test has their scores: {told}.", ""]
        gaps = [f"- {plain(gap)}" for one in experiment.trainings for gap in _gaps(experiment, one)]
        lines += ["Missing:", "", *gaps, ""] if gaps else []
        if not self.study.plan:
            return lines
        return [*lines, "Make it again:", "", *shell(command(self.study, experiment))]

    def _figure(
        self, name: str, title: str, caption: str, draw: Callable[[], Figure | None]
    ) -> list[str]:
        """Save a figure and embed it; nothing if there was nothing to draw."""
        if (drawn := draw()) is None:
            return []
        save(drawn, self.out / FIGURES, name)
        file = f"{FIGURES}/{name}"
        return [*picture(title, f"{file}.png"), f"*{caption}* ([SVG]({file}.svg))", ""]

    def _curves(self, one: Experiment) -> list[str]:
        """Of one reward or of both."""
        lines, both = [], one.kind == "rewards"
        for measure in (REWARD, DENSE) if both else (REWARD,):
            name, title = one.name + "_dense" * (measure is DENSE), f": {measure.label}" * both
            for number, part in enumerate(curve_parts(self.study, one), 1):
                draw = partial(draw_curves, self.study, one, measure, part)
                lines += self._figure(_numbered(name, number), one.title + title, BAND, draw)
            lines += score_table(self.study, one, measure)
        return [*lines, *effort_table(one), REACHED, ""]

    def _tests(self, one: Experiment) -> list[str]:
        lines = []
        for sweep in sweeps(one):
            name, title = f"{one.name}_{sweep.name}", f"{one.title}: {sweep.name}"
            for number, part in enumerate(sweep_parts(self.study, one), 1):
                draw = partial(draw_sweep, self.study, one, sweep, part)
                lines += self._figure(_numbered(name, number), title, SWEEP, draw)
        for measure in (REWARD, ANGLE):
            lines += test_table(self.study, one, measure)
        return lines

    def _ranking(self, one: Experiment) -> list[str]:
        dots = partial(draw_ranking, self.study, one)
        singles = partial(draw_single_seeds, self.study, one)
        return [
            *self._figure(one.name, one.title, DOTS, dots),
            *ranking_table(self.study, one),
            *self._figure(
                f"{one.name}_profile",
                f"{one.title}: performance profile",
                PROFILE,
                partial(draw_profile, one),
            ),
            *self._figure(f"{one.name}_seeds", f"{one.title}: curves", SMALL, singles),
        ]

    def _worlds(self, one: Experiment) -> list[str]:
        """A picture and a long table, or a short one where nothing is changed step by step."""
        draw = partial(draw_worlds, self.study, one)
        lines = self._figure(one.name, one.title, WORLDS, draw)
        rows = worlds_table(one)
        return lines + (details("Every test", rows) if lines else rows) + _orders(one)


def _orders(one: Experiment) -> list[str]:
    return [*order_table(one), *puzzle_order_table(one)]


def _numbered(name: str, number: int) -> str:
    return name if number == 1 else f"{name}_{number}"


def command(study: Study, experiment: Experiment) -> str:
    """What runs this experiment alone, into the same folder, with the study's other settings."""
    return " ".join(("tangram-experiment", *map(_quoted, arguments(study, [experiment.name]))))


def _quoted(word: str) -> str:
    return word if word.startswith(("experiment=[", "budget=")) else shlex.quote(word)


def arguments(study: Study, experiments: Sequence[str]) -> list[str]:
    """What tangram-experiment is told to run these experiments of a study again."""
    try:
        words = shlex.split(study.command)[1:]
    except ValueError:
        words = []
    kept = (word for word in words if _concerns(word, experiments))
    return [f"experiment=[{','.join(experiments)}]", f"budget={study.budget.name}", *kept]


def _concerns(word: str, experiments: Sequence[str]) -> bool:
    """Whether an argument has a meaning where these experiments are run alone."""
    key = word.partition("=")[0].lstrip("+~")
    if key.startswith("experiments."):
        return key.split(".")[1] in experiments
    return key not in ("experiment", "budget", "dry", "run_dir", "jobs", "keep")


def _gaps(experiment: Experiment, training: Training) -> Iterator[str]:
    """What is not there."""
    left = [f"seed {seed.number} {seed.state}" for seed in training.seeds if not seed.finished]
    if left:
        yield f"{training.label} ({finished_count([training])} seeds): {', '.join(left)}"
    for seed in training.finished:
        untested = [t.label for t in experiment.tests if t.name not in seed.tests]
        if untested:
            yield f"{training.label}: seed {seed.number} not tested with {', '.join(untested)}"


# How, where and with what everything was made


def closing(study: Study) -> list[str]:
    """Machine, versions, and every training with its settings."""
    return [
        *("## How it was made", ""),
        *table(["", ""], _facts(study), "---"),
        *(["The last command that ran trainings of it:", ""] if study.plan else []),
        *(shell(study.command) if study.plan else []),
        *details("All trainings and their settings", [*map(_settings, study.trainings), ""]),
    ]


def finished_count(trainings: Iterable[Training]) -> str:
    """How many runs are finished, of how many."""
    runs = [seed for one in trainings for seed in one.seeds]
    return f"{sum(seed.finished for seed in runs)} of {len(runs)}"


def _facts(study: Study) -> list[tuple[str, str]]:
    results = [seed.result for one in study.trainings for seed in one.finished]
    counts = [row.get("test_episodes") for row in results]
    while_training = _several(f"{n:,.0f}" for n in counts if isinstance(n, int | float))
    commits = [study.commit, *(row["commit"] for row in results)]
    names = dict.fromkeys(name for row in results for name in row["versions"])
    versions = [
        f"{name} {_several(row['versions'][name] for row in results if name in row['versions'])}"
        for name in names
    ]
    hours = sum(row["wall_s"] for row in results) / 3600
    planned = f"{study.budget.test_episodes:,}" if study.plan else while_training
    return [
        ("runs finished", finished_count(study.trainings)),
        ("seeds", _several(sorted({seed.number for one in study.trainings for seed in one.seeds}))),
        ("episodes of a test that names no number, puzzles apart", planned),
        ("commit", _several(one for one in commits if one is not None)),
        ("processor", _several(row["processor"] for row in results)),
        ("cores", _several(row["cores"] for row in results)),
        ("versions", ", ".join(versions) or "-"),
        ("time, all runs added up", f"{hours:,.2f} h"),
    ]


def _several(values: Iterable[object]) -> str:
    """Each different value once."""
    return " / ".join(dict.fromkeys(str(value) for value in values)) or "-"


def _settings(one: Training) -> str:
    began = f", begins with the networks of `{one.after}`" if one.after else ""
    settings = " ".join(f"`{text}`" for text in one.overrides) or "(defaults)"
    return f"- **{plain(one.label)}** (`{one.name}`{began}): {settings}"
