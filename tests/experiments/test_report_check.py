"""tangram-report check: what is told of pages, data and code that no longer fit each other."""

import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

from tangram_agent.setup import from_mapping
from tangram_lab.experiments.fingerprints import differences
from tangram_lab.experiments.plan import StudyConfig
from tangram_lab.experiments.report import check as report_check
from tangram_lab.experiments.report import page
from tangram_lab.experiments.report.check import Sources, check, check_page
from tangram_lab.experiments.report.data import read_data, write_data
from tangram_lab.experiments.report.page import Page, drawn_again, figure_sums, write_report
from tangram_lab.experiments.report.reading import read_runs
from tangram_sim.errors import RunError
from tests.experiments.builders import (
    FINGERPRINT,
    SETTINGS,
    experiment,
    learning_curve,
    plan,
    result,
    scores,
    training,
    write_plan,
    write_run,
)

pytestmark = pytest.mark.fast

TABLES = '<a id="fig4"></a>\n\n| ours | 0.996 (0.995 to 0.9971) |\n\n<a id="fig5"></a>\n\n0.5\n'


@pytest.fixture
def numbers(tmp_path: Path) -> Sources:
    (tmp_path / "bench.json").write_text(json.dumps({"a": [{"x": 0.12344, "b": True}], "c": -3.0}))
    return Sources(tmp_path, {"a": TABLES, "large": TABLES.replace("0.996", "0.998")})


PAGES = [
    ("It has 0.996.", ["has no source"]),
    ("<!-- data: a/fig4 -->\nIt has 0.996 (0.995).", []),
    ("<!-- data: a/fig4 -->\n\nIt has 0.996.", []),
    ("<!-- data: a/fig4 -->\n\nIt has 0.996.\n\nAnd 0.995.", ["0.995 has no source"]),
    ("<!-- data: a/fig4 -->\nIt has 0.997.", ["0.997 is not in a/fig4"]),  # it is 0.9971
    ("<!-- data: a/fig5 -->\nIt has 0.996.", ["0.996 is not in a/fig5"]),
    ("<!-- data: a/fig5 a/fig4 -->\nIt has 0.996.", []),
    ("<!-- data: large/fig4 -->\nIt has 0.998 and 0.996.", ["0.996 is not in large/fig4"]),
    ("<!-- data: bench.json -->\nIt has 0.123, 0.1234 and -3.000.", []),
    ("<!-- data: bench.json -->\nIt has 1.000.", ["1.000 is not in bench.json"]),  # true is none
    ("<!-- data: paper -->\nThe paper has 0.758 and 0.759.", ["0.759 is not in paper"]),
    ("<!-- data: paper -->\nThe paper has 0.760.", ["0.760 is not in paper"]),
    ("<!-- data: a/fig4 -->\nIt has -0.996.", ["-0.996 is not in a/fig4"]),
    ("<!-- data: a/fig4 -->\nFrom 0.995-0.996.", []),
    ("<!-- data: a/fig4 -->\nFrom 0.996..0.111.", ["0.111 is not in a/fig4"]),
    ("<!-- data: bench.json -->\nIt has 3.000.", ["3.000 is not in bench.json"]),  # it is -3
    ("<!-- data: pretrained/square -->\nOf 0.160 and 0.3333.", ["0.3333 is not in"]),
    (
        "<!-- data: bench.json -->\nIt has 12.3 %, 12 %, and 12.4 %.",
        ["12.4 % is not in bench.json"],
    ),
    ("It has 12.3 %.", ["12.3 % has no source"]),
    ("It has _0.111_ and __0.112__.", ["0.111 has no source", "0.112 has no source"]),
    *(
        (f"<!-- data: a/fig4 bench.json -->\nIt has {odd}.", [f"{odd} is not written as in the"])
        for odd in (
            "12.3%",
            "12.3\N{NO-BREAK SPACE}%",
            "12.3\n%",
            "12.3&nbsp;%",
            ".123",
            "-.123",
            "\N{MINUS SIGN}0.996",
        )
    ),
    ("<!-- data: none -->\nA side of .125, and 12.3% of it.", []),
    ("<!-- data: data.json -->\nIt has 0.996.", ["has a source that is none"]),
    ("<!-- data: a/fig4 -->\n````\n```\n````  \n\nIt has 0.111.", ["0.111 is not in a/fig4"]),
    ("It has 0.996. <!-- data: none -->", ["has no source"]),
    ("<!-- data: commit -->\nIt had 0.111.", ["name the commit by 7 digits or more"]),
    ("<!-- data: commit a -->\nIt had a 0.111.", ["name the commit by 7 digits or more"]),
    ("<!-- data: commit 0123abc -->\nAt commit 0123abc it had 0.111.", []),
    ("<!-- data: commit 0123abc -->\nIt had 0.111.", ["is of commit 0123abc, which the text does"]),
    ("<!-- data: none -->\nA side of 0.125.", []),
    ("<!-- data: a/fig4 -->\n- 0.996\n<!-- data: a/fig5 -->\n- 0.995", ["0.995 is not in a/fig5"]),
    ("<!-- data: a/fig4 none -->\nA side of 0.125.", ["none stands alone"]),
    ("`agent.noise=0.125`, [x](a_0.125.md), 1.25 and version 1.2.345\n\n```\n0.125\n```", []),
    ("| a |\n| --- |\n| 0.996 |", ["has no source"]),
]


@pytest.mark.parametrize(("text", "expected"), PAGES)
def test_every_score_of_a_page_has_a_source(
    numbers: Sources, text: str, expected: list[str]
) -> None:
    found = [*check_page("p.md", text, numbers)]
    assert len(found) == len(expected)
    assert all(part in line for part, line in zip(expected, found, strict=True))


def test_a_section_of_the_tables_is_there_once_and_ends() -> None:
    with pytest.raises(RunError, match=r"tables\.md of a has fig4 twice"):
        Sources(Path(), {"a": TABLES + TABLES})
    numbers = Sources(Path(), {"a": f"{TABLES}\n## How it was made\n\n0.111"})
    assert [numbers.has("a/fig5", text) for text in ("0.5", "0.111")] == [True, False]


def test_a_line_is_named(numbers: Sources) -> None:
    text = "one\ntwo\n\n```\nx\n\n```\n\nIt has 0.111."
    assert [*check_page("p.md", text, numbers)] == [
        "p.md:9: 0.111 has no source: put <!-- data: ... --> above it"
    ]


@pytest.mark.parametrize(
    "name",
    [
        *("fig4", "a/fig9", "nowhere.json", "../data.yaml", "a/data.json", "../outside.json"),
        f"{Path(__file__).parents[2]}/docs/results/bench.json",
    ],
)
def test_a_source_that_is_none(numbers: Sources, tmp_path: Path, name: str) -> None:
    (tmp_path.parent / "outside.json").write_text('{"x": 0.111}')
    (found,) = check_page("p.md", f"<!-- data: {name} -->\n0.111", numbers)
    assert f"p.md:1: 0.111 has a source that is none: no source is called {name}" in found


# The whole


def resolve(arguments: Sequence[str]) -> dict[str, Any]:
    """The settings that arguments come to; what they train: tests/cluster/test_evidence.py."""
    return SETTINGS | {"later": {"known": True}}


FACTS = {"tokens": ["square"], "parameters": 32_600}  # of every result of the builders


FIG4 = experiment("curves", ["ours"], tests=["random"], labels={}, main=False)
PLANNED: dict[str, Any] = {
    "run_dir": "x",
    "budget": {
        "name": "laptop",
        "note": "Narrower MHA.",
        "seeds": [0, 1],
        "main_seeds": [0, 1, 2],
        "test_episodes": 100,
        "test_seed": 2,
        "overrides": {},
    },
    "families": {"x": []},
    "trainings": {name: {"label": name, "family": "x"} for name in ("ours", "theirs")},
    "tests": {name: {"label": name} for name in ("random", "noisy")},
    "experiments": {"fig4": FIG4},
}


def choose(arguments: list[str]) -> StudyConfig:
    """The study of the fixture as it is in conf/, where tangram-experiment is told these words."""
    assert arguments == ["experiment=[fig4]", "budget=laptop"]
    return from_mapping(StudyConfig, PLANNED)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a whole study of one training, with its report in one of results."""
    folder = tmp_path_factory.mktemp("study")
    tests = {"random": {"label": "random", "overrides": []}}
    write_plan(folder, plan({"fig4": FIG4}, {"ours": training("ours", "x")}, tests, (0, 1)))
    for seed in (0, 1):
        final, curve = result(seed), learning_curve(seed, 0.9)
        curve[-1] |= {key: final[key] for key in ("updates", "episodes", "mean_reward")}
        write_run(folder, "ours", final, curve, {"random": scores(0.912)})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page, "draw_paper_pictures", lambda out: [])
        write_report(folder, folder / "results" / "small")
    return folder


@pytest.fixture
def report(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The report in a copy of the study, to spoil; its figures are not drawn again, but copied."""
    drawn = whole / "results" / "small" / "figures"

    def copied(figure: Figure, folder: Path, name: str) -> None:
        for path in drawn.glob(f"{name}.*"):
            shutil.copy(path, folder)

    monkeypatch.setattr(page, "save", copied)
    monkeypatch.setattr(page, "draw_paper_pictures", lambda out: [])
    monkeypatch.setattr(
        report_check, "make_fingerprints", lambda found: dict.fromkeys(found, FINGERPRINT)
    )
    monkeypatch.setattr(report_check, "make_facts", lambda config: FACTS)
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    return tmp_path / "results" / "small"


def checked(report: Path, text: str = "<!-- data: small/fig4 -->\n0.912") -> list[str]:
    page = report.parents[1] / "README.md"
    page.write_bytes(text.encode())
    return check(report.parent, [page], resolve, choose)


def changed(report: Path, change: dict[str, Any]) -> None:
    """A finished run's result is another one."""
    data = json.loads((report / "data.json").read_text())
    data["runs"]["ours"][1] |= change
    (report / "data.json").write_text(json.dumps(data))


def test_nothing_is_wrong(report: Path) -> None:
    assert checked(report) == []


def test_a_page_that_shows_something_else(report: Path) -> None:
    assert checked(report, "<!-- data: small/fig4 -->\n0.913") == [
        "README.md:1: 0.913 is not in small/fig4",
    ]


def test_each_report_is_a_source_and_whole(report: Path) -> None:
    large = report.with_name("large")
    shutil.copytree(report, large)
    assert checked(report, "<!-- data: large/fig4 -->\n0.912") == []
    assert checked(report, "<!-- data: large/fig4 -->\n0.913") == [
        "README.md:1: 0.913 is not in large/fig4"
    ]
    changed(large, {"state": "not finished", "result": {}, "tests": {}})
    assert "large/ours lacks the seeds [1]" in checked(report)


def test_tables_without_data_are_told(report: Path) -> None:
    shutil.copytree(report, report.with_name("bare"))
    (report.with_name("bare") / "data.json").unlink()
    with pytest.raises(RunError, match="bare has tables.md and no data.json: make them with"):
        checked(report)


def test_results_without_a_report_are_told(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="no report is in .*: make them with make evidence"):
        check(tmp_path, [], resolve, choose)


@pytest.mark.parametrize("name", ["fig4.png", "fig4.svg", "old.png"])
def test_figures_are_those_that_were_drawn_of_the_data(report: Path, name: str) -> None:
    folder = report / "figures"
    with (folder / name).open("ab") as file:
        file.write(b"x")
    (found,) = checked(report)
    assert found.startswith(f"{folder} has not the figures of data.json, as {name}: make it anew")
    (folder / name).unlink()
    assert (checked(report) == []) == (name == "old.png")


@pytest.mark.parametrize("what", ["one was forged", "all were deleted", "the code draws another"])
def test_figures_are_drawn_again(report: Path, monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    data, folder = json.loads((report / "data.json").read_text()), report / "figures"
    if what == "one was forged":
        (folder / "fig4.png").write_bytes(b"forged")
    elif what == "all were deleted":
        shutil.rmtree(folder)
    else:
        monkeypatch.setattr(page, "save", lambda figure, folder, name: None)
    data["figures"] = figure_sums(report)
    (report / "data.json").write_text(json.dumps(data))
    (found,) = checked(report)
    assert "has not the figures of data.json, as fig4" in found


def test_a_report_is_made_again_from_its_own_data(report: Path) -> None:
    before = {path: path.read_bytes() for path in report.rglob("*") if path.is_file()}
    (report / "figures" / "fig4.png").write_bytes(b"old")
    (report / "tables.md").write_text("old")
    write_report(report, report)
    assert {path: path.read_bytes() for path in report.rglob("*") if path.is_file()} == before


def test_a_report_of_tables_alone_needs_no_folder_of_figures(
    report: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Page, "_figure", lambda *given: [])
    data = json.loads((report / "data.json").read_text())
    data["figures"] = {}
    (report / "data.json").write_text(json.dumps(data))
    shutil.rmtree(report / "figures")
    study, _ = read_data(report / "data.json")
    (report / "tables.md").write_text(drawn_again(study)[0])
    assert checked(report) == []


def test_a_report_that_fails_leaves_the_earlier_one_whole(report: Path) -> None:
    before = {path: path.read_bytes() for path in report.rglob("*") if path.is_file()}
    curve = report.parents[1] / "trainings" / "ours" / "seed_0" / "curve.jsonl"
    point = json.loads(curve.read_text().splitlines()[-1])
    with curve.open("a") as file:
        file.write(json.dumps(point | {"note": "x"}) + "\n")
    with pytest.raises(RunError, match=r"Expected `float \| null`, got `str`"):
        write_report(report.parents[1], report)
    assert {path: path.read_bytes() for path in report.rglob("*") if path.is_file()} == before


def test_nothing_takes_the_place_of_a_report_before_a_run_is_finished(tmp_path: Path) -> None:
    write_plan(tmp_path, plan({}, {}, {}))
    with pytest.raises(RunError, match="no run is finished in .*: wait for one"):
        write_report(tmp_path, tmp_path / "report")


def test_tables_that_were_changed_by_hand(report: Path) -> None:
    tables = report / "tables.md"
    tables.write_text(tables.read_text().replace("0.912", "0.913"))
    assert any("is not what data.json gives" in line for line in checked(report))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"state": "not finished", "result": {}, "tests": {}}, "ours lacks the seeds [1]"),
        ({"tests": {}}, "ours lacks the test random of fig4"),
        ({"result": result(1, commit="0123abc-dirty")}, "changed tree, or of none: 0123abc-dirty"),
        ({"result": result(1, commit=None)}, "of a changed tree, or of none: None"),
        ({"result": result(1, commit="banana")}, "of a changed tree, or of none: banana"),
        ({"result": result(1) | {"seed": 7}}, "ours, seed 1: its seed is 7"),
        ({"result": result(1, scored_updates=1999)}, "seed 1: it did not come to its end"),
        ({"tests": {"random": scores(0.9, episodes=3)}}, "has episodes=3, not 100"),
        ({"tests": {"random": scores(0.9, test_seed=0)}}, "has test_seed=0, not 2"),
        ({"tests": {"random": scores(0.9, updates=7)}}, "has updates=7, not 2000"),
    ],
)
def test_what_the_study_lacks(report: Path, change: dict[str, Any], told: str) -> None:
    changed(report, change)
    assert any(told in line for line in checked(report))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            {"curve": {key: [0.0] for key in ("updates", "episodes", "train_s", "mean_reward")}},
            "ours, seed 1: its curve ends with updates=0.0, its result with 2000",
        ),
        ({"curve": {}}, "its curve ends with mean_reward=None, its result with 0.75"),
        ({"result": result(1, 0.99)}, "with mean_reward=0.75, its result with 0.99"),
        ({"result": result(1, episodes=17)}, ", its result with 17"),
        ({"result": result(1, run_id="one")}, "ours, seed 1 is the run of ours, seed 0"),
        (
            {"tests": {"random": scores(0.9, coverage_each=[0.9] * 100)}},
            "test random has not the mean reward of its episodes: 0.9",
        ),
        ({"tests": {"random": scores(1.5)}}, "has not the mean reward of its episodes: 1.5"),
        (
            {"tests": {"random": scores(0.9, {"exact": {"mean_reward": 0.3}})}},
            "ours, test random: exact differs between seeds: [1.0, 0.3]",
        ),
    ],
)
def test_runs_that_belie_themselves_are_told(
    report: Path, change: dict[str, Any], told: str
) -> None:
    data = json.loads((report / "data.json").read_text())
    data["runs"]["ours"][0]["result"]["run_id"] = "one"
    data["runs"]["ours"][1] |= change
    (report / "data.json").write_text(json.dumps(data))
    assert any(told in line for line in checked(report))


@pytest.mark.parametrize(
    ("section", "name", "change", "told"),
    [
        ("experiments", "fig4", {"tests": []}, "random would not be among the tests now"),
        ("experiments", "fig4", {"note": "new"}, "fig4 would be made otherwise now: note is new"),
        ("experiments", "fig4", {"main": True}, "ours would be made otherwise now: seeds is [0, 1"),
        ("experiments", "fig4", {"labels": {"ours": "x"}}, "labels is {'ours': 'x'}"),
        ("trainings", "ours", {"label": "theirs"}, "ours would be made otherwise now: label is"),
        ("trainings", "ours", {"overrides": ["a=1"]}, "overrides is ['a=1']"),
        (
            "tests",
            "random",
            {"overrides": ["a=1"]},
            "random would be made otherwise now: overrides is",
        ),
        ("budget", "test_seed", 0, "the budget's test_seed is now 0"),
        ("budget", "note", "Wider.", "the budget's note is now Wider."),
    ],
)
def test_what_its_command_would_plan_otherwise(
    report: Path, monkeypatch: pytest.MonkeyPatch, section: str, name: str, change: Any, told: str
) -> None:
    before = PLANNED[section][name]
    value = before | change if isinstance(change, dict) else change
    monkeypatch.setitem(PLANNED[section], name, value)
    assert any(told in line for line in checked(report))


def test_an_experiment_that_its_command_would_not_make(
    report: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(PLANNED, "experiments", {})
    assert "small/fig4 would not be among the experiments now" in checked(report)


@pytest.mark.parametrize("ends", ["\r\n", "\r"])
def test_pages_may_have_other_line_ends(report: Path, ends: str) -> None:
    text = ends.join(("<!-- data: none -->", "0.125", "", "It has 0.912."))
    (found,) = checked(report, text)
    assert "0.912 has no source" in found


def test_a_pipe_is_no_data(report: Path) -> None:
    (report / "data.json").unlink()
    os.mkfifo(report / "data.json")
    with pytest.raises(RunError, match=r"cannot be read \(it is a pipe\); make it again"):
        checked(report)


def test_code_that_trains_otherwise(report: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = {"mean_reward": 0.5, "weights": 1000.01}
    monkeypatch.setattr(report_check, "make_fingerprints", lambda found: dict.fromkeys(found, now))
    assert checked(report) == [
        "small/ours trains otherwise than when its figures were made: after 20 updates weights is "
        "1000.01, and was 1000.0: make them anew with make evidence KEEP=yes"
    ]


@pytest.mark.parametrize(
    ("kept", "told"),
    [
        ({"agent": {"batch_size": 32}, "max_updates": 2000}, "agent.batch_size=32, now 64"),
        ({"max_updates": 2000, "nonsense": 1}, "nobody kept agent"),
    ],
)
def test_other_settings_than_those_that_trained_are_told(
    report: Path, kept: dict[str, Any], told: str
) -> None:
    data = json.loads((report / "data.json").read_text())
    data["plan"]["trainings"]["ours"]["settings"] = kept
    (report / "data.json").write_text(json.dumps(data))
    assert checked(report) == [f"small/ours has not the settings that it was trained with: {told}"]


@pytest.mark.parametrize(
    ("other", "told"),
    [
        ({"parameters": 13_508}, "its parameters is 13508, not 32600"),
        ({"tokens": ["large_triangle"]}, "its tokens is ['large_triangle'], not ['square']"),
        ({"ended_by": "SIGINT"}, "it was ended by SIGINT, not by max_updates=2000"),
        ({"ended_by": "max_updates=1000"}, "it was ended by max_updates=1000, not by"),
        ({"ended_by": "max_episodes=2000"}, "it was ended by max_episodes=2000, not by"),
    ],
)
def test_a_result_of_another_training_is_told(
    report: Path, other: dict[str, Any], told: str
) -> None:
    changed(report, {"result": result(1, 0.9, **other)})
    assert any(
        line.startswith(f"small/ours, seed 1 is of another training: {told}")
        for line in checked(report)
    )


@pytest.mark.parametrize(("turns", "told"), [(4, "test random has turns=4, not 8"), (8, "")])
def test_puzzles_at_fewer_angles_are_told(report: Path, turns: int, told: str) -> None:
    data = json.loads((report / "data.json").read_text())
    data["plan"]["tests"]["random"]["overrides"] = ["puzzle=test", "turns=8"]
    for run in data["runs"]["ours"]:
        run["tests"]["random"] |= {"puzzle": ["test"], "turns": turns}
    (report / "data.json").write_text(json.dumps(data))
    found = [line for line in checked(report) if "turns=4" in line]
    assert [line.endswith(told) for line in found] == [True, True] * bool(told)


@pytest.mark.parametrize(("episodes", "told"), [(200, True), (50, True), (40, False)])
def test_a_test_may_have_a_number_of_episodes_of_its_own(
    report: Path, episodes: int, told: bool
) -> None:
    data = json.loads((report / "data.json").read_text())
    data["plan"]["tests"]["random"]["overrides"] = ["episodes=40"]
    for run in data["runs"]["ours"]:
        run["tests"]["random"]["episodes"] = episodes
    (report / "data.json").write_text(json.dumps(data))
    found = [line for line in checked(report) if "test random has episodes=" in line]
    assert [f"episodes={episodes}, not 40" in line for line in found] == [True, True] * told


@pytest.mark.parametrize("kept", [{}, {"ours": {}}, {"ours": {"mean_reward": 0.5}}])
def test_a_fingerprint_that_nobody_kept_is_told(report: Path, kept: dict[str, Any]) -> None:
    data = json.loads((report / "data.json").read_text())
    data["plan"]["fingerprints"] = kept
    (report / "data.json").write_text(json.dumps(data))
    (found,) = checked(report)
    told = (
        "weights is 1000.0, and was None" if kept.get("ours") else "small/ours has no fingerprint"
    )
    assert told in found


def test_fingerprints_that_differ() -> None:
    assert not differences(FINGERPRINT, {"mean_reward": 0.5000001, "weights": 1000.0009})
    assert differences(FINGERPRINT, {"mean_reward": 0.50001, "weights": 1000.0})
    assert differences(FINGERPRINT, {})  # it diverges now
    assert not differences({}, {})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 1}, "its format is 1, but this version reads 3"),
        ({"runs": {}}, "ours, seed 0 of its plan is missing"),
        ({"runs": 3}, r"Expected `object`, got `int` - at `\$.runs`"),
        ({"plan": {}}, "its format is None, but this version reads 4"),
    ],
)
def test_data_that_are_not_what_they_should_be(
    report: Path, change: dict[str, Any], message: str
) -> None:
    path = report / "data.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(RunError, match=message):
        read_data(path)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("ours", {}, "ours, seed 0 is there twice"),
        ("ours", {"seed": 77}, "ours, seed 77 is not in its plan"),
        ("unheard_of", {}, "unheard_of, seed 0 is not in its plan"),
        ("ours", {"tests": {"foo": scores(0.9)}}, "ours, seed 0: its plan has no test foo"),
        ("ours", {"tests": {"random": scores(0.9, coverage="x")}}, r"got `str` - at `\$.coverage`"),
        (
            "ours",
            {"tests": {"random": scores(0.9, {"exact": {"share_solved": [1]}})}},
            r"got `array` - at `\$.baselines\[...\].share_solved`",
        ),
    ],
)
def test_runs_that_no_plan_has_are_refused(
    report: Path, name: str, change: dict[str, Any], message: str
) -> None:
    path = report / "data.json"
    data = json.loads(path.read_text())
    first = data["runs"]["ours"][0]
    if change.get("tests"):
        first |= change
    else:
        data["runs"].setdefault(name, []).append(first | change)
    path.write_text(json.dumps(data))
    with pytest.raises(RunError, match=message):
        read_data(path)


def test_no_folder_of_this_machine_is_told(tmp_path: Path) -> None:
    study = plan({}, {}, {}) | {
        "command": "tangram-experiment run_dir=/home/me/runs 'a=[x,y]' jobs=2"
    }
    write_plan(tmp_path, study)
    write_data(tmp_path / "data.json", read_runs(tmp_path), {})
    told = json.loads((tmp_path / "data.json").read_text())["plan"]["command"]
    assert told == "tangram-experiment 'a=[x,y]' jobs=2"


def test_a_curve_whose_columns_differ_in_length(report: Path) -> None:
    changed(report, {"curve": {"updates": [1.0, 2.0], "mean_reward": [0.5]}})
    with pytest.raises(RunError, match="seed 1: the columns of its curve are not of one length"):
        read_data(report / "data.json")
