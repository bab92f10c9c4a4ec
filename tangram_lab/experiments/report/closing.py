"""The end of a report: how, where and with what everything was made."""

from collections.abc import Iterable

from tangram_lab.experiments.report.markdown import details, plain, shell, table
from tangram_lab.experiments.report.records import Row
from tangram_lab.experiments.report.study import Study, Training

HOUR_S = 3600.0


def closing(study: Study) -> list[str]:
    """Budget, machine, versions, and every training with its settings."""
    results = [seed.result for one in study.trainings for seed in one.finished]
    return [
        "## How it was made",
        "",
        *([f"Budget `{study.budget}`: {plain(study.budget_note)}", ""] if study.plan else []),
        *table(["", ""], _facts(study, results), "---"),
        *_command(study),
        *details("All trainings and their settings", _trainings(study.trainings)),
    ]


def finished_count(trainings: Iterable[Training]) -> str:
    """How many runs are finished, of how many."""
    runs = [seed for one in trainings for seed in one.seeds]
    return f"{sum(seed.finished for seed in runs)} of {len(runs)}"


def _facts(study: Study, results: list[Row]) -> list[tuple[str, str]]:
    commits = [study.commit, *(row["commit"] for row in results)]
    hours = sum(row["wall_s"] for row in results) / HOUR_S
    return [
        ("runs finished", finished_count(study.trainings)),
        ("seeds", _several(study.planned_seeds)),
        ("episodes of every test", _test_episodes(study, results)),
        ("commit", _several(one for one in commits if one is not None)),
        ("processor", _several(row["processor"] for row in results)),
        ("cores", _several(row["cores"] for row in results)),
        ("versions", ", ".join(_versions(results)) or "-"),
        ("time, all runs added up", f"{hours:,.2f} h"),
    ]


def _command(study: Study) -> list[str]:
    if not study.plan:
        return []
    return ["The last command that ran trainings of it:", "", *shell(study.command)]


def _test_episodes(study: Study, results: list[Row]) -> str:
    """As planned; without a plan those of the evaluations while it trained."""
    if study.plan:
        return f"{study.test_episodes:,}"
    counts = [row.get("test_episodes") for row in results]
    return _several(f"{count:,.0f}" for count in counts if isinstance(count, int | float))


def _versions(results: list[Row]) -> list[str]:
    names = dict.fromkeys(name for row in results for name in row["versions"])
    return [
        f"{name} {_several(row['versions'][name] for row in results if name in row['versions'])}"
        for name in names
    ]


def _several(values: Iterable[object]) -> str:
    """Each different value once."""
    return " / ".join(dict.fromkeys(str(value) for value in values)) or "-"


def _trainings(trainings: Iterable[Training]) -> list[str]:
    lines = []
    for one in trainings:
        began = f", begins with the networks of `{one.after}`" if one.after else ""
        settings = " ".join(f"`{text}`" for text in one.overrides) or "(defaults)"
        lines.append(f"- **{plain(one.label)}** (`{one.name}`{began}): {settings}")
    return [*lines, ""]
