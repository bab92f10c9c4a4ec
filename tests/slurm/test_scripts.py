"""The job scripts as texts: what can be seen without SLURM."""

import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from conf.cli import composed
from conf.own import with_named_code
from tangram_core.run.code import override

pytestmark = pytest.mark.fast

FOLDER = Path(__file__).parents[2] / "slurm"
JOBS = sorted(FOLDER.rglob("*.sbatch"))
SCRIPTS = [*JOBS, *sorted(FOLDER.rglob("*.sh"))]
SHARED = "".join((FOLDER / f"{name}.sh").read_text() for name in ("lib", "master", "worker"))
# After these words stand settings.
TAKERS = re.compile(
    r"tangram-\w+ |start_master |start_worker |\.sbatch |submit\.sh |settings\+?=\("
)
SETTING = re.compile(r"(?<![\w.$/-])([a-z_]+(?:\.[a-z_]+)*)=([^\s\"()]+)")
PARAMETER = re.compile(r"^([A-Z_]+)=\$\{\1:[-?]", re.MULTILINE)
OF_WORKERS = ("role", "connect")
PATHS = {"run_dir": "runs/x", "connect": "runs/x"}


def identity(path: Path) -> str:
    return path.relative_to(FOLDER).as_posix()


def settings(path: Path) -> Iterator[list[tuple[str, str]]]:
    """What each line of a script or of an example in it sets: a command's config, and the word."""
    text = path.read_text().replace("\\\n", " ")
    text = re.sub(r'"?\$\(setting (\w+) "([^"]*)"\)"?', r"\1=\2", text)
    for line in text.splitlines():
        taker = TAKERS.search(line)
        if taker is None:
            continue
        found = []
        for name, value in SETTING.findall(line[taker.end() :]):
            known = PATHS.get(name, "1") if "$" in value else value.rstrip("'")
            found.append(("worker" if name in OF_WORKERS else "master", f"{name}={known}"))
        yield found


@pytest.mark.parametrize("path", SCRIPTS, ids=identity)
def test_scripts_stop_at_the_first_error_and_every_setting_is_one_of_the_config(path: Path) -> None:
    text = path.read_text()
    sourced = text.startswith("# ")  # the script that sources it says so
    assert sourced or "\nset -euo pipefail\n" in text
    for line in settings(path):
        for primary in dict(line):
            given = [word for one, word in line if one == primary]
            if primary == "worker" and not any(word.startswith("connect=") for word in given):
                given.append("connect=runs/x")
            composed(primary, with_named_code(given))


def test_workers_are_told_of_code_and_of_nothing_else() -> None:
    code = ["task=a.py:A", "agent.kind='b c.py:B'", "task.imports=[one,two]", "reward.name=r.py:f"]
    plain = ["task=gym", "agent=goal", "task.id=a.py", "seed=1", "run_dir=a.py:A"]
    script = 'source "$0"; code_of "$@"; printf "%s\\n" "${code[@]}"'
    command = ["bash", "-euc", script, str(FOLDER / "code.sh"), *plain, *code]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert told.splitlines() == code


@pytest.mark.parametrize("value", ["runs/x", "O'Brien", "a\\", "a\\'b\\\\", "${a}", "ä = $1 \\${"])
def test_a_setting_holds_any_value(value: str) -> None:
    command = ["bash", "-euc", 'source "$0"; setting run_dir "$1"', str(FOLDER / "code.sh"), value]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert told == override("run_dir", value)


def test_settings_are_found() -> None:
    found = {path.name: [word for line in settings(path) for _, word in line] for path in SCRIPTS}
    assert {"run_dir=runs/x", "resume=auto", "service.threads=1"} == set(found["master.sh"])
    assert {"seed=1", "tokens=parallelogram", "role=evaluator", "service.bind=0.0.0.0"} <= set(
        found["train.sbatch"]
    )
    assert {"max_updates=0", "task=gym", "sim=kinematic"} <= set(found["tryparts.sh"])


@pytest.mark.parametrize("path", JOBS, ids=identity)
def test_jobs_explain_and_use_their_parameters_and_can_be_queued_again(path: Path) -> None:
    text = path.read_text()
    names = PARAMETER.findall(text)
    assert {"PROJECT", "RUN_DIR", "RUN_WITH"} <= set(names)
    lines = text.splitlines()
    for name in names:
        (number,) = [i for i, line in enumerate(lines) if line.startswith(f"{name}=")]
        assert lines[number - 1].startswith("# "), f"{name} is not explained"
        rest = "\n".join(lines[number + 1 :]) + SHARED
        assert re.search(rf"\b{name}\b", rest), f"{name} is not used"
    for option in ("--open-mode=append", "--requeue", "--signal=B:USR1@", "--time=", "--output="):
        assert f"\n#SBATCH {option}" in text, option
    assert "\nfollow_master\n" in text or "\nend_job\n" in text


def test_the_image_takes_every_package_along() -> None:
    text = (FOLDER.parent / "docker" / "apptainer.def").read_text()
    files = re.search(r"^%files\n((?: .*\n)+)", text, re.MULTILINE)
    assert files is not None
    sources = [line.split()[0] for line in files.group(1).splitlines()]
    packages = {path.parent.name for path in FOLDER.parent.glob("*/__init__.py")} - {"tests"}
    assert {"conf", "master", "tangram_cli", "worker"} < packages <= set(sources)
    assert all((FOLDER.parent / source).exists() for source in sources)


# Stands for a command: a line of what it was told, and the next status of a list.
STAND_IN = """#!/bin/bash
echo "$*" >>"$RUN_DIR/told"
read -r status <"$RUN_DIR/statuses"
sed -i 1d "$RUN_DIR/statuses"
exit "$status"
"""


def end_of(
    folder: Path, role: str, statuses: list[int], sleep: str = ":", **variables: str
) -> tuple[int, list[str], list[str]]:
    """Run a script whose commands end like this: its status, its waits, and what they were told."""
    commands, run_dir = folder / ".venv" / "bin", folder / "run"
    commands.mkdir(parents=True)
    run_dir.mkdir()
    (folder / "slurm").symlink_to(FOLDER)
    for name, text in ((f"tangram-{role}", STAND_IN), ("sleep", f"#!/bin/sh\n{sleep}\n")):
        (commands / name).write_text(text)
        (commands / name).chmod(0o755)
    (run_dir / "connection.json").touch()
    (run_dir / "statuses").write_text("".join(f"{status}\n" for status in statuses))
    given = {"PROJECT": str(folder), "RUN_DIR": str(run_dir), "RUN_WITH": ""}
    command, env = [str(FOLDER / f"{role}.sh"), "seed=1"], os.environ | given | variables
    done = subprocess.run(command, check=False, env=env, capture_output=True, text=True)
    waits = re.findall(r"is started again in (\d+) s$", done.stdout, re.MULTILINE)
    return done.returncode, waits, (run_dir / "told").read_text().splitlines()


@pytest.mark.parametrize("role", ["master", "worker"])
@pytest.mark.parametrize(
    ("statuses", "waits"),
    [
        ([75] * 9 + [0], ["2", "4", "8", "16", "32", "64", "128", "256", "300"]),
        ([75, 2], ["2"]),
        ([2], []),
    ],
)
def test_what_the_environment_lacks_is_waited_for_and_wrong_settings_are_not(
    tmp_path: Path, role: str, statuses: list[int], waits: list[str]
) -> None:
    status, waited, told = end_of(tmp_path, role, statuses)
    assert (status, waited) == (statuses[-1], waits)
    assert [line.rpartition(" ")[2] for line in told] == ["seed=1"] * len(statuses)


@pytest.mark.parametrize(("role", "last"), [("master", 75), ("worker", 0)])
def test_a_time_limit_ends_who_waits(tmp_path: Path, role: str, last: int) -> None:
    status, waited, told = end_of(tmp_path, role, [75, 75, 75, 3], "kill -USR1 $PPID")
    assert (status, waited, len(told)) == (last, ["2"], 1)


def test_a_worker_whom_nobody_lets_in_leaves_in_the_end(tmp_path: Path) -> None:
    """A master that was killed leaves its connection file behind."""
    status, waited, told = end_of(tmp_path, "worker", [75, 75], PATIENCE_S="0")
    assert (status, waited, len(told)) == (75, [], 1)
