"""The file of studies, the rows that its runs leave, and what is drawn of them."""

import json
import re
from pathlib import Path

import pandas as pd
import pytest
from PIL import Image
from rich.console import Console

from tangram_core.errors import ConfigError, RunError
from tangram_lab.experiments.report import write_report, write_runs
from tangram_lab.experiments.rows import (
    COLUMNS,
    Spread,
    append,
    curve_rows,
    done,
    read_rows,
    rows_of,
    spreads,
)
from tangram_lab.experiments.runner import Work, read_json, run_study
from tangram_lab.experiments.studies import StudyConfig, jobs_of, read_studies
from tests.test_docs import ROOT, unknown

pytestmark = pytest.mark.fast

SMALL = """
budgets:
  short: {seeds: 2, tests: 16, test_seed: 3, set: [max_updates=20, net=mha]}
families:
  ours: {set: [agent=tangram], short: [net=mlp]}
tests: {as_trained: [], puzzles: [puzzle=test, turns=2]}
studies:
  game:
    title: A game
    seeds: 3
    trainings:
      one: {label: first, family: ours, tests: [as_trained, puzzles]}
      two:
        {label: second, family: ours, seeds: 1, set: [max_updates=5], tests: [as_trained],
         after: one}
    figures:
      curve: {kind: curves, title: Curves, trainings: [one]}
      dots: {kind: seeds, title: Seeds, test: as_trained, trainings: [one, two]}
      line: {kind: tests, title: Tests, trainings: [one], tests: [as_trained, puzzles]}
"""
RESULT = {
    "commit": "0123456789" * 4 + "-dirty",
    "updates": 20,
    "episodes": 64,
    "parameters": 9,
    "train_s": 1.5,
}
SCORES = {
    "episodes": 16,
    "mean_reward": 0.123456789,
    "angle_error_deg_median": 2.0,
    "baselines": {"exact": {"mean_reward": 1.0}},
}
CURVE = [
    {"episodes": 0, "updates": 0, "train_s": 0.0, "mean_reward": -0.5},
    {"episodes": 32, "updates": 10, "train_s": 0.7, "mean_reward": 0.69},
    {"episodes": 64, "updates": 20, "train_s": 1.5, "mean_reward": 0.7},
]


def studies(folder: Path, text: str = SMALL) -> Path:
    path = folder / "studies.yaml"
    path.write_text(text)
    return path


def test_jobs_are_told_each_setting_once_and_the_last_word_counts(tmp_path: Path) -> None:
    config = StudyConfig(run_dir="x", study="game", budget="short")
    jobs = list(jobs_of(config, read_studies(studies(tmp_path))))
    assert [job.name for job in jobs] == ["one, seed 0", "two, seed 0", "one, seed 1"]
    assert jobs[0].told == ("agent=tangram", "max_updates=20", "net=mlp")
    assert jobs[1].told == ("agent=tangram", "max_updates=5", "net=mlp")
    assert jobs[0].tests == {
        "as_trained": ("episodes=16", "seed=3"),
        "puzzles": ("seed=3", "puzzle=test", "turns=2"),
    }
    assert [job.drawn for job in jobs] == [True, False, True]


def test_more_seeds_are_given_up_to_those_of_the_study(tmp_path: Path) -> None:
    config = StudyConfig(run_dir="x", study="game", budget="short", seeds=10)
    jobs = list(jobs_of(config, read_studies(studies(tmp_path))))
    assert [(job.training, job.seed) for job in jobs if job.seed] == [("one", 1), ("one", 2)]


def test_a_training_goes_on_with_an_earlier_one_of_its_seed_once_that_is_whole(
    tmp_path: Path,
) -> None:
    config = StudyConfig(run_dir="x", study="game", budget="short", seeds=1)
    one, two = jobs_of(config, read_studies(studies(tmp_path)))
    assert (one.after, two.after) == (None, "one")
    first = Work(one, tmp_path / "one", [], None)
    then = Work(two, tmp_path / "two", ["as_trained"], first)
    assert first.ready
    assert not then.ready
    (tmp_path / "one").mkdir()
    (tmp_path / "two").mkdir()
    (tmp_path / "one" / "result.json").write_text('{"ended_by": "max_updates"}')
    assert then.ready
    child = then.next()
    assert child is not None
    assert f"warm_start='{tmp_path / 'one'}'" in child.arguments


CHAIN = """      three: {label: third, family: ours, tests: [as_trained], after: two}
      four: {label: fourth, family: ours, tests: [as_trained], after: three}
    figures:
"""


def test_what_a_training_goes_on_with_is_trained_before_it_though_it_has_its_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = read_studies(studies(tmp_path, SMALL.replace("    figures:\n", CHAIN)))
    config = StudyConfig(run_dir=str(tmp_path / "runs"), study="game", budget="short", out=".")
    jobs = list(jobs_of(config, known))  # two has one seed, and so have those after it
    assert [(job.training, job.seed) for job in jobs if job.seed] == [("one", 1)]
    there = {("one", 0, test) for test in jobs[0].tests}
    there |= {(job.training, 0, "as_trained") for job in jobs[1:3]} | {("one", 1, "as_trained")}
    monkeypatch.setattr("tangram_lab.experiments.runner.done", lambda _: there)
    begun = list[str]()
    monkeypatch.setattr(Work, "next", lambda work: begun.append(work.job.name))
    monkeypatch.setattr(Work, "write", lambda *_: "done")
    console = Console(record=True, width=200)
    assert run_study(config, jobs, console) == 1
    assert begun == ["one, seed 0", "one, seed 1"]  # one is not whole, so nothing goes on with it
    told = console.export_text()
    for name in ("two", "three", "four"):
        assert f"{name}, seed 0: not begun, because the training before it failed" in told


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("family: ours, seeds", "family: theirs, seeds", "there is no family 'theirs'"),
        ("tests: [as_trained]", "tests: [gone]", "there is no test 'gone'"),
        ("after: one", "after: two", "there is no earlier training 'two'"),
        ("title: A game", "titel: A game", "unknown field `titel`"),
    ],
)
def test_a_file_that_names_what_it_has_not_is_refused(
    before: str, after: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=message):
        read_studies(studies(tmp_path, SMALL.replace(before, after)))


def test_a_study_that_there_is_not_is_refused() -> None:
    with pytest.raises(ConfigError, match="study must be one of paper, "):
        list(jobs_of(StudyConfig(run_dir="x", study="gone"), read_studies()))


@pytest.mark.parametrize("budget", ["smoke", "laptop", "paper"])
def test_every_setting_of_every_study_is_known(budget: str) -> None:
    known = read_studies()
    wrong = list[str]()
    for name in known.studies:
        for job in jobs_of(StudyConfig(run_dir="x", study=name, budget=budget), known):
            wrong += unknown(["tangram-train", *job.told])
            bounds = {one for one in job.told if re.fullmatch(r"max_\w+=[1-9]\d*", one)}
            wrong += [] if bounds else [f"{name}, {job.name} never ends"]
            for told in job.tests.values():
                wrong += [one for one in told if unknown(["tangram-eval", one])]
    assert wrong == []


def test_no_seed_and_no_test_of_a_study_is_left_out_of_its_rows() -> None:
    known = read_studies()
    missing = list[str]()
    for name in known.studies:
        budget = "paper" if name == "paper" else "laptop"
        there = done(ROOT / "docs" / "results" / f"{name}.csv")
        config = StudyConfig(run_dir="x", study=name, budget=budget, seeds=10)
        for job in jobs_of(config, known):
            missing += [
                f"{job.name}, {t}" for t in job.tests if (job.training, job.seed, t) not in there
            ]
    assert missing == []


def test_a_test_leaves_a_row_of_the_agent_and_one_of_each_rival() -> None:
    agent, rival = rows_of("one", "first", 0, "as_trained", RESULT, SCORES, CURVE)
    assert {name: value for name, value in agent.items() if value not in (None, "")} == {
        "training": "one",
        "label": "first",
        "seed": 0,
        "test": "as_trained",
        "policy": "agent",
        "commit": "0123456-dirty",
        "tests": 16,
        "mean_reward": 0.123456789,
        "angle_error_deg": 2.0,
        "updates": 20,
        "episodes": 64,
        "parameters": 9,
        "train_seconds": 1.5,
        "reached_0.70": "32 to 64",
    }
    assert (rival["policy"], rival["mean_reward"], "updates" in rival) == ("exact", 1.0, False)


def test_rows_are_added_under_the_head_that_is_there(tmp_path: Path) -> None:
    path = tmp_path / "game.csv"
    path.write_text("training,seed,test,policy,mean_reward\n")
    for seed in (0, 1):
        append(path, COLUMNS, rows_of("one", "first", seed, "puzzles", RESULT, SCORES, CURVE))
    assert path.read_text().splitlines() == [
        "training,seed,test,policy,mean_reward",
        "one,0,puzzles,agent,0.123457",
        "one,0,puzzles,exact,1.0",
        "one,1,puzzles,agent,0.123457",
        "one,1,puzzles,exact,1.0",
    ]
    assert done(path) == {("one", 0, "puzzles"), ("one", 1, "puzzles")}
    assert done(tmp_path / "none.csv") == set()


def test_a_curve_keeps_its_ends() -> None:
    long = [point | {"updates": n} for n, point in enumerate(CURVE * 40)]
    kept = [row["updates"] for row in curve_rows("one", 0, long)]
    assert (len(kept), kept[0], kept[-1]) == (30, 0, 119)


def test_seeds_are_told_as_median_least_and_most() -> None:
    rows = pd.DataFrame(
        {
            "training": ["one"] * 4,
            "test": ["a"] * 4,
            "policy": ["agent"] * 3 + ["exact"],
            "mean_reward": [0.3, 0.1, 0.2, 1.0],
        }
    )
    assert spreads(rows, "mean_reward") == {
        ("one", "a", "agent"): Spread(0.2, 0.1, 0.3),
        ("one", "a", "exact"): Spread(1.0, 1.0, 1.0),
    }


def test_what_is_no_csv_is_told(tmp_path: Path) -> None:
    path = tmp_path / "game.csv"
    path.write_bytes(b"\xff\x00")
    with pytest.raises(RunError, match=r"game\.csv: cannot be read"):
        read_rows(path)


def test_scores_of_version_0_1_are_read_by_their_new_names(tmp_path: Path) -> None:
    path, result = tmp_path / "game.csv", tmp_path / "result.json"
    path.write_text("training,seed,test,policy,share_solved,share_solved_iou\none,0,a,agent,0.5,\n")
    append(
        path,
        COLUMNS,
        [{"training": "one", "seed": 1, "test": "a", "policy": "agent", "solved": 1.0}],
    )
    with pytest.warns(FutureWarning, match=r"game\.csv: share_solved is called solved now, .*0\.3"):
        rows = read_rows(path)
    assert rows["solved"].tolist() == [0.5, 1.0]
    assert not {"share_solved", "share_solved_iou"} & {*rows.columns}
    result.write_text('{"raw_overlap": 0.75, "mean_reward": 0.5}')
    with pytest.warns(FutureWarning, match="raw_overlap is called coverage now"):
        assert read_json(result) == {"coverage": 0.75, "mean_reward": 0.5}


def test_a_report_is_a_page_and_a_picture_for_each_figure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = read_studies(studies(tmp_path))
    monkeypatch.setattr("tangram_lab.experiments.report.read_studies", lambda: known)
    for seed in (0, 1):
        for test in ("as_trained", "puzzles"):
            scores = SCORES | {"mean_reward": 0.5 + seed / 4}
            rows = rows_of("one", "first", seed, test, RESULT, scores, CURVE)
            append(tmp_path / "game.csv", COLUMNS, rows)
        points = curve_rows("one", seed, CURVE)
        append(tmp_path / "game_curves.csv", points[0], points)
    written = [path.name for path in write_report(tmp_path, tmp_path / "out")]
    assert written == ["game.md", "game_curve.png", "game_dots.png", "game_line.png"]
    lines = (tmp_path / "out" / "game.md").read_text().splitlines()
    assert lines[0] == "# A game"
    assert lines[6:8] == [
        "| first | `one` | as_trained | 2 | 0.6250 (0.5000 to 0.7500) | 2.0000 | 20 | 64 | 9 | 2 |",
        "| *exact* | `one` | as_trained |  | 1.0000 |  |  |  |  |  |",
    ]
    for name in written[1:]:
        with Image.open(tmp_path / "out" / name) as picture:
            assert picture.width == 900


def test_a_sweep_is_one_table_by_what_differs(tmp_path: Path) -> None:
    for number, (agent, seed) in enumerate([("paper", 0), ("paper", 1), ("tangram", 0)]):
        run = tmp_path / "sweep" / str(number)
        run.mkdir(parents=True)
        config = {"seed": seed, "run_dir": str(run), "agent": {"name": agent}, "workers": 1}
        (run / "config.yaml").write_text(json.dumps(config))
        if number < 2:
            score = {"ended_by": "max_updates=20", "mean_reward": number / 2, **RESULT}
            (run / "result.json").write_text(json.dumps(score))
    out = write_runs(tmp_path / "sweep", tmp_path / "report")
    assert out.read_text().splitlines()[-2:] == [
        "| agent.name=paper | 2 of 2 | 0.2500 (0.0000 to 0.5000) | 20 | 64 | 9 | 2 |",
        "| agent.name=tangram | 0 of 1 |  |  |  |  |  |",
    ]


def test_a_folder_without_runs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="has neither runs nor the CSV of a study"):
        list(write_report(tmp_path, tmp_path))
