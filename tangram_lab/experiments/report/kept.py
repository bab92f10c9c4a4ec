"""Runs of an earlier report that are not made again, where this code would make them alike."""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml

from tangram_agent.files import write_whole
from tangram_agent.runs import CONFIG
from tangram_lab.experiments.fingerprints import differences
from tangram_lab.experiments.jobs import Job, changed_settings
from tangram_lab.experiments.plan import seed_folder
from tangram_lab.experiments.report.data import DATA, read_data
from tangram_lab.experiments.report.reading import CURVE, read_bytes
from tangram_lab.experiments.report.study import SETTINGS, Seed, Study
from tangram_sim.errors import ConfigError

BUDGET = ("name", "test_episodes", "test_seed")
Runs = dict[Path, Seed]  # by the folder where each belongs


def read_kept(report: Path, budget: Mapping[str, Any]) -> Study:
    """The study of an earlier report.

    Args:
        report: its folder.
        budget: of the study that is to keep runs of it, as plan.json has it.

    Raises:
        RunError: its data cannot be read.
        ConfigError: it is of another budget.
    """
    read_bytes(report / DATA, "name a folder that tangram-report wrote, keep=...")
    study, _ = read_data(report / DATA)
    for name in BUDGET:
        before, now = study.plan["budget"].get(name), budget[name]
        if before != now:
            raise ConfigError(
                f"keep={report} was made with budget.{name}={before}, now it is {now}: keep "
                "another report"
            )
    return study


def runs_to_keep(earlier: Study, plan: Mapping[str, Any], jobs: Sequence[Job], study: Path) -> Runs:
    """The runs that this code would make alike, and that nobody has begun in the study's folder.

    They have the settings that are planned now and the fingerprint of this code, and so has the
    training that they begin with; they have all tests that are planned, and these are asked the
    same. A run whose weights another training begins with is not kept, as nobody kept its weights.

    Args:
        earlier: what is there.
        plan: content of plan.json, with the fingerprints of this code.
        jobs: all of the study, each training before what needs it.
        study: its folder.
    """
    there = {
        seed_folder(study, one.name, seed.number): seed
        for one in earlier.trainings
        if _alike(one.name, earlier, plan)
        for seed in one.finished
        if seed.result.get("seed") == seed.number
    }
    asked_alike = {
        one.name
        for one in earlier.tests
        if [*one.overrides] == [*plan["tests"].get(one.name, {}).get("overrides", [None])]
    }

    def is_there(job: Job) -> bool:
        seed = there.get(job.run_dir)
        same = job.trains or job.leaves.stem in asked_alike
        return seed is not None and same and job.fits(_left_by(job, seed), seed.result)

    made = {job.run_dir for job in jobs if job.run_dir.exists() or not is_there(job)}
    for job in reversed(jobs):  # what a training begins with stands before it
        if job.trains and job.needs is not None and job.run_dir in made and not job.done:
            made.add(job.needs.run_dir)
    return {job.run_dir: there[job.run_dir] for job in jobs if job.run_dir not in made}


def _alike(name: str, earlier: Study, plan: Mapping[str, Any]) -> bool:
    """Whether a training is what the plan makes of it now, and what it begins with is, too."""
    one = next((one for one in earlier.trainings if one.name == name), None)
    now = plan["trainings"].get(name)
    if one is None or now is None or one.after != now["after"]:
        return False
    # One that diverged has an empty fingerprint, which tells nothing of the code.
    before, code = earlier.fingerprints.get(name), plan["fingerprints"].get(name)
    if not before or not code or differences(before, code):
        return False
    known = one.settings and not changed_settings(one.settings, now["settings"], one.settings)
    return bool(known) and (one.after is None or _alike(one.after, earlier, plan))


def _left_by(job: Job, seed: Seed) -> dict[str, Any]:
    """The content of the file that a job would leave.

    Data have no settings of a test, as its plan has them: they are those that are asked for.
    """
    if job.trains:
        return seed.result
    content = seed.tests.get(job.leaves.stem, {})
    asked = {name: job.settings[name] for name in SETTINGS if name in job.settings}
    return asked | content if content else {}


def write_kept(kept: Runs, jobs: Iterable[Job]) -> None:
    """Make the folders of runs that are kept, without weights, each whole or not at all."""
    for run_dir, seed in kept.items():
        run_dir.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=".kept-", dir=run_dir.parent) as folder:
            made = Path(folder) / run_dir.name
            made.mkdir()
            lines = "".join(json.dumps(point) + "\n" for point in seed.curve)
            write_whole(made / CURVE, lines.encode())
            for job in (job for job in jobs if job.run_dir == run_dir):
                path = made / job.leaves.relative_to(run_dir)
                path.parent.mkdir(exist_ok=True)
                write_whole(path, json.dumps(_left_by(job, seed)).encode())
                if job.trains:
                    settings = yaml.safe_dump(dict(job.settings), sort_keys=False)
                    write_whole(made / CONFIG, settings.encode())
            made.rename(run_dir)
