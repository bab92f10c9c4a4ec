"""tangram-report: a study's figures and tables, as Markdown."""

from pathlib import Path

from tangram_agent.files import write_whole
from tangram_lab.experiments.pictures import draw_paper_pictures
from tangram_lab.experiments.report.closing import closing, finished_count
from tangram_lab.experiments.report.data import study_data, to_json
from tangram_lab.experiments.report.loose import read_runs
from tangram_lab.experiments.report.markdown import picture, plain, table
from tangram_lab.experiments.report.references import References
from tangram_lab.experiments.report.sections import Page, section
from tangram_lab.experiments.report.study import Study
from tangram_lab.experiments.report.style import drawing, looks
from tangram_sim.errors import RunError

FIGURES = "figures"
HOW_TO_READ = (
    "Scores are those of the fixed tests, exploration off. The mean reward is Eq. 14 on exact "
    "polygons: -1 is no overlap, 1 is perfect. Where several seeds were trained, numbers are their "
    "median, with the least and the most in brackets. Three policies that learned nothing stand "
    "beside them: *position only* asks for the motion to the target's centre and never for a turn, "
    "*perfect* asks for the exact motion onto the target as it is seen, *random* is chance."
)


def write_report(runs: Path, out: Path) -> list[Path]:
    """Report on a study; files of an earlier report in the same place are replaced.

    Args:
        runs: the study's folder, or one whose folders are runs.
        out: folder for README.md, data.json and figures/, or the page itself, `NAME.md`, with the
            others in the folder NAME beside it.

    Returns:
        The page and the data.

    Raises:
        RunError: a file of the study is not what it should be, or `out` cannot be written.
    """
    study = read_runs(runs)
    path, beside = (out, out.with_suffix("")) if out.suffix == ".md" else (out / "README.md", out)
    root, figures = path.parent, (beside / FIGURES).relative_to(path.parent).as_posix()
    _make(root / figures)
    page = Page(study, root, figures, looks(study), References(study))
    data = beside / "data.json"
    lines = _opening(study, data.relative_to(root).as_posix())
    with drawing():
        lines += _paper_pictures(root, figures) if study.plan else []
        for experiment in study.experiments:
            lines += section(page, experiment)
    lines += closing(study)
    write_whole(path, ("\n".join(lines).rstrip() + "\n").encode())
    write_whole(data, to_json(study_data(study)))
    return [path, data]


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(
            f"cannot make {folder} ({error.strerror}): choose another folder with out=..."
        ) from None


def _opening(study: Study, data: str) -> list[str]:
    rows = [
        (f"[{plain(one.title)}](#{one.name})", one.source, finished_count(one.trainings))
        for one in study.experiments
    ]
    return [
        f"# Experiments, budget `{study.budget}`" if study.plan else "# Runs",
        "",
        plain(study.budget_note),
        "",
        HOW_TO_READ,
        "",
        *table(["experiment", "source", "runs finished"], rows, "---"),
        f"`tangram-report` wrote this page; [{data}]({data}) holds all of its numbers.",
        "",
    ]


def _paper_pictures(root: Path, figures: str) -> list[str]:
    """The paper's Figs. 1 to 3, which need no training."""
    lines: list[str] = []
    for title, file, caption in draw_paper_pictures(root / figures):
        lines += [f"## {plain(title)}", "", *picture(title, f"{figures}/{file}")]
        lines += [f"*{plain(caption)}*", ""]
    return lines
