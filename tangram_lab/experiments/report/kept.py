"""Runs of an earlier report that are not made again, where this code would make them alike."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from tangram_agent.files import write_whole
from tangram_lab.experiments.fingerprints import differences
from tangram_lab.experiments.jobs import changed_settings
from tangram_lab.experiments.plan import PLAN
from tangram_lab.experiments.report.data import DATA, read_data
from tangram_lab.experiments.report.reading import checked_plan, make_study, read_bytes
from tangram_lab.experiments.report.study import Seed, Study
from tangram_sim.errors import RunError

KEPT = "kept.json"  # in a study's folder: the data of the earlier report
REMEDY = "name a folder that tangram-report wrote, keep=..."
BUDGET = ("name", "test_episodes", "test_seed")
Runs = dict[tuple[str, int], Seed]  # training and seed -> its run


def keep(report: Path, study: Path) -> None:
    """Copy the data of a report into the folder of a study.

    Raises:
        RunError: the report's data cannot be read.
    """
    content = read_bytes(report / DATA, REMEDY)
    read_data(report / DATA)
    write_whole(study / KEPT, content)


def kept_runs(data: Path, plan: Mapping[str, Any]) -> Runs:
    """The runs of an earlier report that a plan's code would make alike.

    They have the settings that the plan has, and its fingerprint, and so has the training that
    they begin with. Tests that the plan makes otherwise are left out.

    Args:
        data: the report's data.
        plan: content of plan.json, with the fingerprints of this code.

    Raises:
        RunError: the data are not what they should be, or of another budget.
    """
    earlier, _ = read_data(data)
    for name in BUDGET:
        before, now = earlier.plan["budget"].get(name), plan["budget"][name]
        if before != now:
            raise RunError(
                f"{data} was made with budget.{name}={before}, now it is {now}: keep another report"
            )
    same = {
        one.name
        for one in earlier.tests
        if [*one.overrides] == [*plan["tests"].get(one.name, {}).get("overrides", [None])]
    }
    return {
        (one.name, seed.number): replace(
            seed, tests={name: test for name, test in seed.tests.items() if name in same}
        )
        for one in earlier.trainings
        if _alike(one.name, earlier, plan)
        for seed in one.finished
    }


def _alike(name: str, earlier: Study, plan: Mapping[str, Any]) -> bool:
    """Whether a training is what the plan makes of it now, and what it begins with is, too."""
    one = next((one for one in earlier.trainings if one.name == name), None)
    now = plan["trainings"].get(name)
    if one is None or now is None or one.after != now["after"]:
        return False
    before, code = earlier.fingerprints.get(name), plan["fingerprints"].get(name)
    if before is None or code is None or differences(before, code):
        return False
    known = one.settings and not changed_settings(one.settings, now["settings"], one.settings)
    return bool(known) and (one.after is None or _alike(one.after, earlier, plan))


def completed(study: Study, folder: Path) -> Study:
    """A study with the runs that are kept where its own are not finished.

    Args:
        study: as it was read from its folder.
        folder: this folder.

    Raises:
        RunError: what is kept cannot be read.
    """
    if not study.plan or not (folder / KEPT).exists():
        return study
    kept = kept_runs(folder / KEPT, study.plan)
    own = {(one.name, seed.number): seed for one in study.trainings for seed in one.seeds}

    def read(name: str, seed: int) -> Seed:
        mine = own[name, seed]
        return mine if mine.finished else kept.get((name, seed), mine)

    return make_study(study.plan, checked_plan(study.plan, str(folder / PLAN)), read)
