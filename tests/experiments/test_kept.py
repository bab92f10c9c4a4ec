"""Which runs of an earlier report are kept, and what is made again all the same."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tangram_lab.experiments.jobs import Job
from tangram_lab.experiments.plan import seed_folder, test_file
from tangram_lab.experiments.report.data import read_data, write_data
from tangram_lab.experiments.report.kept import read_kept, runs_to_keep, write_kept
from tangram_lab.experiments.report.reading import read_runs
from tangram_sim.errors import ConfigError, RunError
from tests.experiments.builders import (
    FINGERPRINT,
    SETTINGS,
    experiment,
    learning_curve,
    plan,
    result,
    scores,
    training,
    trial,
    write_plan,
    write_run,
)

pytestmark = pytest.mark.fast

Plan = dict[str, Any]
TRAININGS = {"ours": training("ours", "x"), "warm": training("warm", "x", after="ours")}
TESTS = {"random": trial("random"), "twice": trial("twice", 2)}
EXPERIMENTS = {"one": experiment("ranking", [*TRAININGS], tests=[*TESTS])}
ALL = {(name, seed) for name in TRAININGS for seed in (0, 1)}


@pytest.fixture
def earlier(tmp_path: Path) -> Path:
    """A report of two seeds of each training; the third is not finished."""
    runs = tmp_path / "earlier"
    write_plan(runs, plan(EXPERIMENTS, TRAININGS, TESTS))
    for name, seed in ALL:
        tests = dict.fromkeys(TESTS, scores(0.9 + 0.01 * seed))
        write_run(runs, name, result(seed, 0.9), learning_curve(seed, 0.9), tests)
    (tmp_path / "report").mkdir()
    write_data(tmp_path / "report" / "data.json", read_runs(runs), {})
    return tmp_path / "report"


def planned() -> Plan:
    """The same once more, as plan.json has it."""
    content: Plan = json.loads(json.dumps(plan(EXPERIMENTS, TRAININGS, TESTS)))
    return content


ASKED: Plan = {"random": {}, "twice": {"sim": {"actions_per_token": 2}}}


def jobs_of(
    folder: Path, tests: Plan = ASKED, seeds: tuple[int, ...] = (0, 1, 2), settings: Any = None
) -> list[Job]:
    """Of each training and seed: what trains it, and its tests."""
    jobs: list[Job] = []
    for seed in seeds:
        source: Job | None = None
        for name in TRAININGS:
            run_dir = seed_folder(folder, name, seed)
            leaves = run_dir / "result.json"
            source = Job(
                f"{name}, seed {seed}", name, (), run_dir, leaves, source, settings or SETTINGS
            )
            asked = {name: {"seed": 2, "episodes": 100} | test for name, test in tests.items()}
            jobs += [
                source,
                *(
                    Job(
                        test,
                        name,
                        (),
                        run_dir,
                        test_file(run_dir, test),
                        source,
                        told,
                        trains=False,
                    )
                    for test, told in asked.items()
                ),
            ]
    return jobs


def kept(
    report: Path, content: Plan, folder: Path, jobs: list[Job] | None = None
) -> set[tuple[str, int]]:
    """Training and seed of what is kept."""
    earlier = read_kept(report, content["budget"])
    found = runs_to_keep(earlier, content, jobs_of(folder) if jobs is None else jobs, folder)
    return {(path.parent.name, int(path.name.removeprefix("seed_"))) for path in found}


def test_every_finished_run_is_kept_where_nothing_changed(earlier: Path, tmp_path: Path) -> None:
    assert kept(earlier, planned(), tmp_path / "new") == ALL


def test_what_is_kept_is_done_and_reported_as_it_was(earlier: Path, tmp_path: Path) -> None:
    folder, jobs = tmp_path / "new", jobs_of(tmp_path / "new")
    write_plan(folder, planned())
    before = read_kept(earlier, planned()["budget"])
    write_kept(runs_to_keep(before, planned(), jobs, folder), jobs)
    assert [job.done for job in jobs] == [True] * 12 + [False] * 6
    write_data(tmp_path / "data.json", read_runs(folder), {})
    after, _ = read_data(tmp_path / "data.json")
    for one, other in zip(before.trainings, after.trainings, strict=True):
        assert one.seeds[:2] == other.seeds[:2]
    again = runs_to_keep(before, planned(), jobs, folder)
    assert again == {}  # it is there


def _other(part: str, name: str, value: Any) -> Callable[[Plan], None]:
    def change(content: Plan) -> None:
        content[part][name] = value if part != "trainings" else content[part][name] | value

    return change


def _without(part: str, name: str) -> Callable[[Plan], None]:
    def change(content: Plan) -> None:
        del content[part][name]

    return change


OURS = {("ours", 0), ("ours", 1)}
WARM = {("warm", 0), ("warm", 1)}
NEAR, FAR = FINGERPRINT | {"weights": 1000.0001}, FINGERPRINT | {"weights": 1000.1}
NARROW = {"settings": {"agent": {"batch_size": 3}}}
CHANGES = {
    "only rounded otherwise": (_other("fingerprints", "warm", NEAR), ALL),
    "a setting that was unknown": (_other("trainings", "warm", {"settings": {"later": 1}}), ALL),
    "another label": (_other("trainings", "warm", {"label": "w", "family": "y"}), ALL),
    # The source of a training that is made anew is made anew: nobody kept its weights.
    "another fingerprint": (_other("fingerprints", "warm", FAR), set()),
    "no fingerprint": (_without("fingerprints", "warm"), set()),
    "an empty one": (_other("fingerprints", "warm", {}), set()),
    "another setting": (_other("trainings", "warm", NARROW), set()),
    "not planned": (_without("trainings", "warm"), set()),
    "it begins with nothing": (_other("trainings", "warm", {"after": None}), set()),
    "what it begins with is another": (_other("fingerprints", "ours", FAR), set()),
    "a test is asked otherwise": (_other("tests", "twice", trial("twice", 3)), set()),
    "a test is called otherwise": (_other("tests", "twice", trial("again", 2)), ALL),
    "a test is not planned": (_without("tests", "random"), set()),
}  # fmt: skip


@pytest.mark.parametrize("case", CHANGES)
def test_what_this_code_would_not_make_alike_is_not_kept(
    earlier: Path, tmp_path: Path, case: str
) -> None:
    change, expected = CHANGES[case]
    content = planned()
    change(content)
    assert kept(earlier, content, tmp_path / "new") == expected


def _data(**changes: Any) -> Callable[[Plan], None]:
    def change(run: Plan) -> None:
        run["result"] |= changes.get("result", {})
        run["tests"]["random"] |= changes.get("test", {})
        run |= changes.get("run", {})

    return change


ODD = {
    "another seed": _data(result={"seed": 7}),
    "not its final weights": _data(result={"scored_updates": None}),
    "it was stopped": _data(result={"ended_by": "SIGTERM"}),
    "it is not finished": _data(run={"state": "not finished"}),
    "a test of other weights": _data(test={"updates": 1}),
    "a test of another seed": _data(test={"test_seed": 0}),
    "a test of other episodes": _data(test={"episodes": 7}),
    "a test is missing": _data(run={"tests": {}}),
}


@pytest.mark.parametrize("case", ODD)
def test_runs_that_are_not_whole_are_not_kept(earlier: Path, tmp_path: Path, case: str) -> None:
    data = json.loads((earlier / "data.json").read_text())
    ODD[case](data["runs"]["warm"][1])
    (earlier / "data.json").write_text(json.dumps(data))
    assert kept(earlier, planned(), tmp_path / "new") == ALL - {("warm", 1), ("ours", 1)}


def test_runs_whose_settings_nobody_knows_are_not_kept(earlier: Path, tmp_path: Path) -> None:
    data = json.loads((earlier / "data.json").read_text())
    data["plan"]["trainings"]["ours"]["settings"] = {}
    (earlier / "data.json").write_text(json.dumps(data))
    assert kept(earlier, planned(), tmp_path / "new") == set()


def test_only_what_is_asked_must_be_there(earlier: Path, tmp_path: Path) -> None:
    few = jobs_of(tmp_path, {"twice": ASKED["twice"]}, seeds=(1,))
    assert kept(earlier, planned(), tmp_path, few) == {("ours", 1), ("warm", 1)}
    more = jobs_of(tmp_path, ASKED | {"noisy": {}}, seeds=(1,))
    assert kept(earlier, planned(), tmp_path, more) == set()


def test_what_somebody_began_goes_on(earlier: Path, tmp_path: Path) -> None:
    """Where it needs the weights of another, these are made, too."""
    seed_folder(tmp_path, "ours", 0).mkdir(parents=True)
    seed_folder(tmp_path, "warm", 1).mkdir(parents=True)
    assert kept(earlier, planned(), tmp_path) == {("warm", 0)}


@pytest.mark.parametrize(
    ("name", "value"), [("name", "paper"), ("test_episodes", 7), ("test_seed", 0)]
)
def test_another_budget_is_refused(earlier: Path, name: str, value: Any) -> None:
    content = planned()
    content["budget"][name] = value
    with pytest.raises(ConfigError, match=f"budget.{name}=.*, now it is {value}: keep another"):
        read_kept(earlier, content["budget"])


def test_a_folder_without_a_report_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"cannot be read .*; name a folder that tangram-report"):
        read_kept(tmp_path, planned()["budget"])
    (tmp_path / "data.json").write_text("{}")
    with pytest.raises(RunError, match="its format is None, but this version reads"):
        read_kept(tmp_path, planned()["budget"])


def test_other_settings_and_weights_that_nobody_kept_are_told(
    earlier: Path, tmp_path: Path
) -> None:
    jobs = jobs_of(tmp_path / "new")
    before = read_kept(earlier, planned()["budget"])
    write_kept(runs_to_keep(before, planned(), jobs, tmp_path / "new"), jobs)
    for job in jobs:
        job.check()
    (other, *_) = jobs_of(tmp_path / "new", settings={"agent": {"batch_size": 3}})
    with pytest.raises(ConfigError, match=r"other settings \(agent.batch_size=64, now 3\)"):
        other.check()
    later = jobs_of(tmp_path / "new", {"noisy": {}})
    told = "noisy needs the weights of .*/ours/seed_0, which was kept of a report and has none: rem"
    with pytest.raises(ConfigError, match=told):
        later[1].check()
