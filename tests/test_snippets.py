"""The Python of README and docs/gymnasium.md, run as it stands."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tangram_agent.runs import load_run
from tangram_sim.env import TangramEnv
from tangram_sim.register import KWARGS

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
SNIPPETS = [
    (page, number, code)
    for page in ("README.md", "docs/gymnasium.md")
    for number, code in enumerate(
        re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
    )
]


@pytest.mark.parametrize(("page", "number", "code"), SNIPPETS)
def test_it_runs_without_a_warning(
    page: str, number: int, code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in re.findall(r"stable_baselines3|human", code):
        module = {"human": "pygame"}.get(name, name)
        pytest.importorskip(module, reason="pip install '.[human,peers]'")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(code, f"{page}, snippet {number}", "exec"), names)  # noqa: S102
    for told in {"reward", "rewards"} & names.keys() if "agent" in names else ():
        assert np.min(names[told]) > 0.99
    if "over" in names:
        assert names["info"]["is_success"]
    if "model" in names:
        assert names["model"]._n_updates > 100
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "agent"),
    [("Tangram-v0", "pretrained/square"), ("Tangram7-v0", "pretrained/tangram7")],
)
def test_an_id_is_what_its_agent_was_trained_on(name: str, agent: str) -> None:
    setup = load_run(agent).setup
    env = TangramEnv(**KWARGS[name])
    assert env.layout.fingerprint() == setup.layout.fingerprint()
    assert env.sim == setup.sim
    assert setup.reward.name == "overlap"
    env.close()
