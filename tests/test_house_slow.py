"""Rules of the house that start other processes to be seen: tiers of tests, no engine, the site."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.blocks import PAGES
from tests.test_house import ROOT, run, run_python

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


# The documentation site


def built_site(config: Path, site: Path) -> subprocess.CompletedProcess[str]:
    pytest.importorskip("mkdocs", reason="pip install '.[docs]'")
    options = ["--strict", f"--config-file={config}", f"--site-dir={site}"]
    return run([sys.executable, "-m", "mkdocs", "build", *options])


def test_the_site_is_whole_and_asks_no_other_host(tmp_path: Path) -> None:
    """Strictly: each link and anchor leads somewhere, and each page is in the navigation."""
    result = built_site(ROOT / "mkdocs.yml", tmp_path)
    assert result.returncode == 0, result.stdout + result.stderr
    shown = [page.relative_to(ROOT).with_suffix("") for page in PAGES]
    for page in [name.parent if name.name == "README" else name for name in shown]:
        assert (tmp_path / page / "index.html").is_file()
    assert (
        'id="tangram_sim.env.TangramEnv.step"'
        in (tmp_path / "api" / "tangram_sim.env" / "index.html").read_text()
    )
    loads = r"<(?:script|img|source)[^>]* src=.?(?:https?:)?//|<link[^>]* href=.?(?:https?:)?//"
    loading = [p for p in tmp_path.rglob("*.*") if p.suffix in (".html", ".css")]
    assert [p for p in loading if re.search(rf"{loads}|url\(.?(?:https?:)?//", p.read_text())] == []


def test_a_dead_link_a_dead_anchor_and_a_lost_page_stop_the_site(tmp_path: Path) -> None:
    config = (ROOT / "mkdocs.yml").read_text().partition("\nnav:")[0]
    (tmp_path / "mkdocs.yml").write_text(f"{config}\nnav: [README.md]\n")
    (tmp_path / "docs").mkdir()
    for name in ("hooks.py", "site.css"):
        shutil.copy(ROOT / "docs" / name, tmp_path / "docs")
    (tmp_path / "docs" / "lost.md").write_text("# Lost\n")
    (tmp_path / "README.md").write_text(
        "# A page\n\n[a](#a-page) [b](gone.md) [c](docs/lost.md#no)\n\n```bash\n# no heading\n```\n"
    )
    result = built_site(tmp_path / "mkdocs.yml", tmp_path / "site")
    told = result.stdout + result.stderr
    assert result.returncode == 1, told
    assert "Aborted with 3 warnings in strict mode" in told
    for fault in ("docs/lost.md", "'gone.md'", "'docs/lost.md#no'"):
        assert fault in told
