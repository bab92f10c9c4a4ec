"""Which runs of an earlier report are kept, and what is made again all the same."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tangram_lab.experiments.jobs import Job, without
from tangram_lab.experiments.plan import test_file
from tangram_lab.experiments.report import page
from tangram_lab.experiments.report.check import reports
from tangram_lab.experiments.report.data import read_data, write_data
from tangram_lab.experiments.report.kept import KEPT, keep, kept_runs
from tangram_lab.experiments.report.page import write_report
from tangram_lab.experiments.report.reading import read_runs
from tangram_sim.errors import RunError
from tests.experiments.builders import (
    FINGERPRINT,
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


def kept(earlier: Path, content: Plan) -> set[tuple[str, int]]:
    return {*kept_runs(earlier / "data.json", content)}


def test_every_finished_run_is_kept_with_its_tests_where_nothing_changed(earlier: Path) -> None:
    found = kept_runs(earlier / "data.json", planned())
    assert {*found} == ALL
    assert {*found["ours", 1].tests} == {*TESTS}
    assert found["ours", 1].tests["random"]["mean_reward"] == 0.91


def _other(part: str, name: str, value: Any) -> Callable[[Plan], None]:
    def change(content: Plan) -> None:
        content[part][name] = value if part != "trainings" else content[part][name] | value

    return change


def _without(part: str, name: str) -> Callable[[Plan], None]:
    def change(content: Plan) -> None:
        del content[part][name]

    return change


OURS = {("ours", 0), ("ours", 1)}
CHANGES = {
    "another fingerprint": (
        _other("fingerprints", "warm", FINGERPRINT | {"weights": 1e3 + 3}),
        OURS,
    ),
    "the same but for rounding": (
        _other("fingerprints", "warm", FINGERPRINT | {"weights": 1e3 + 0.01}),
        ALL,
    ),
    "no fingerprint": (_without("fingerprints", "warm"), OURS),
    "another setting": (
        _other("trainings", "warm", {"settings": {"agent": {"batch_size": 32}}}),
        OURS,
    ),
    "a setting that was unknown": (_other("trainings", "warm", {"settings": {"later": 1}}), ALL),
    "another label": (_other("trainings", "warm", {"label": "w", "family": "y"}), ALL),
    "not wanted": (_without("trainings", "warm"), OURS),
    "it begins with nothing": (_other("trainings", "warm", {"after": None}), OURS),
    "what it begins with is another": (_other("fingerprints", "ours", {}), set()),
}


@pytest.mark.parametrize("case", CHANGES)
def test_what_this_code_would_not_make_alike_is_not_kept(earlier: Path, case: str) -> None:
    change, expected = CHANGES[case]
    content = planned()
    change(content)
    assert kept(earlier, content) == expected


def test_runs_whose_settings_nobody_knows_are_not_kept(earlier: Path) -> None:
    data = json.loads((earlier / "data.json").read_text())
    data["plan"]["trainings"]["ours"]["settings"] = {}
    (earlier / "data.json").write_text(json.dumps(data))
    assert kept(earlier, planned()) == set()


def test_a_test_that_is_made_otherwise_now_is_left_out(earlier: Path) -> None:
    content = planned()
    content["tests"]["twice"]["overrides"] = ["sim.actions_per_token=3"]
    del content["tests"]["random"]
    assert [*kept_runs(earlier / "data.json", content)["ours", 0].tests] == []
    content["tests"]["twice"] = TESTS["twice"] | {"label": "anything"}
    assert [*kept_runs(earlier / "data.json", content)["ours", 0].tests] == ["twice"]


@pytest.mark.parametrize(
    ("name", "value"), [("name", "paper"), ("test_episodes", 7), ("test_seed", 0)]
)
def test_another_budget_is_refused(earlier: Path, name: str, value: Any) -> None:
    content = planned()
    content["budget"][name] = value
    with pytest.raises(RunError, match=f"was made with budget.{name}=.*, now it is {value}: keep"):
        kept(earlier, content)


def test_a_folder_without_a_report_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        RunError, match=r"cannot be read .*; name a folder that tangram-report wrote"
    ):
        keep(tmp_path, tmp_path)
    (tmp_path / "data.json").write_text("{}")
    with pytest.raises(RunError, match="its format is None, but this version reads"):
        keep(tmp_path, tmp_path)
    assert not (tmp_path / KEPT).exists()


# The report of a study that keeps runs


def test_a_report_takes_what_is_kept_where_its_own_runs_are_not_finished(
    earlier: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page, "draw_paper_pictures", lambda out, draws: [])
    runs = tmp_path / "runs"
    write_plan(runs, planned())
    keep(earlier, runs)
    for name, seed in (("ours", 0), ("ours", 2), ("warm", 2)):
        tests = dict.fromkeys(TESTS, scores(0.5))
        write_run(runs, name, result(seed, 0.5, commit="4567def"), [], tests)
    write_report(runs, earlier)  # in its own place
    study, _ = read_data(earlier / "data.json")
    found = {one.name: one.values("mean_reward", "random") for one in study.trainings}
    assert found == {"ours": {0: 0.5, 1: 0.91, 2: 0.5}, "warm": {0: 0.9, 1: 0.91, 2: 0.5}}
    text = (earlier / "tables.md").read_text()
    assert "| commit | 0123abc / 4567def |" in text
    assert "Missing" not in text
    assert reports(earlier.parent) == [earlier]


# The jobs that remain


def jobs_of(
    folder: Path, name: str, *, trained: bool = False, needs: Job | None = None
) -> list[Job]:
    """What is missing of a run: its training and two tests, or these alone."""
    run_dir = folder / name
    first = Job(name, name, (), run_dir, run_dir / "result.json", needs)
    tests = [
        Job(f"{name}_{test}", name, (), run_dir, test_file(run_dir, test), first, trains=False)
        for test in ("a", "b")
    ]
    return tests if trained else [first, *tests]


WARM = "s s_a s_b w w_a w_b"  # a source, and what begins with it


@pytest.mark.parametrize(
    ("known", "left"),
    [
        ("", f"{WARM} t_a t_b"),
        ("s s_a s_b", f"{WARM} t_a t_b"),
        ("w w_a w_b", "s s_a s_b t_a t_b"),
        (WARM, "t_a t_b"),
        ("s s_a s_b w w_a", f"{WARM} t_a t_b"),
        ("t t_a t_b", f"{WARM} t_a t_b"),
    ],
)
def test_a_run_is_kept_whole_or_made_with_what_it_begins_with(
    tmp_path: Path, known: str, left: str
) -> None:
    """A run that was trained here, t, is tested here."""
    source = jobs_of(tmp_path, "s")
    warm, trained = jobs_of(tmp_path, "w", needs=source[0]), jobs_of(tmp_path, "t", trained=True)
    files = set[Path]()
    for word in known.split():
        name, _, test = word.partition("_")
        folder = tmp_path / name
        files.add(test_file(folder, test) if test else folder / "result.json")
    found = [job.name for job in without([*source, *warm, *trained], files)]
    assert found == left.split()
