"""Rules of the house that start other processes to be seen: tiers of tests, no engine."""

import sys
from pathlib import Path

import pytest

from tests.test_house import run, run_python

pytestmark = pytest.mark.slow


def test_master_and_registration_never_load_the_engine() -> None:
    loaded = run_python(
        "import gymnasium, master.cli, master.launch, master.run, tangram_sim.register, sys\n"
        "assert 'Tangram-v0' in gymnasium.registry\n"
        "print([name for name in sys.modules if name.startswith('pybullet')])"
    )
    assert loaded == "[]"


def test_the_launcher_needs_no_torch() -> None:
    """It would start the master two seconds later, and hold 200 MB for as long as that trains."""
    needs = "master.launch, tangram_agent.setup, tangram_sim.rewards, tangram_sim.world"
    assert run_python(f"import sys, {needs}\nprint('torch' in sys.modules)") == "False"


def test_learning_needs_no_compiler() -> None:
    """Its import would take the master more than a second and 70 MB."""
    told = run_python(
        "import sys\n"
        "from tangram_agent.learner import Learner\n"
        "from tests.agent.builders import SCENE, random_transitions, setup\n"
        "Learner(setup(agent=SCENE), 0).update(random_transitions(setup(), 4), 0.0)\n"
        "print('torch._dynamo' in sys.modules)"
    )
    assert told == "False"


@pytest.mark.parametrize(
    ("marks", "status"),
    [("", 4), ("@pytest.mark.fast", 0), ("@pytest.mark.fast\n@pytest.mark.slow", 4)],
)
def test_each_test_carries_one_tier(tmp_path: Path, marks: str, status: int) -> None:
    (tmp_path / "test_it.py").write_text(f"import pytest\n\n{marks}\ndef test_it(): pass\n")
    options = ["-p", "tests.conftest", "-p", "no:cacheprovider", "-c", "pyproject.toml"]
    result = run([sys.executable, "-m", "pytest", *options, f"--rootdir={tmp_path}", str(tmp_path)])
    assert result.returncode == status, result.stdout + result.stderr
    if status:
        assert "test_it.py::test_it must carry exactly one of the markers" in result.stderr
