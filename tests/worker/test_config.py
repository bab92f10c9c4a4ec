"""Settings of the worker's commands: each wrong value is refused with what to do."""

import pytest

from tangram_sim.errors import ConfigError
from worker.config import EvalConfig, PlayConfig, WorkerConfig

pytestmark = pytest.mark.fast


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"connect": " "}, "set connect=tcp://HOST:PORT"),
        ({"role": "dancer"}, "role must be one of player, evaluator, got 'dancer'"),
        ({"index": -2}, "index must be between -1 and 65535, got -2"),
        ({"index": 65536}, "index must be between -1 and 65535, got 65536"),
    ],
)
def test_wrong_worker_settings(wrong: dict, reason: str) -> None:
    with pytest.raises(ConfigError) as caught:
        WorkerConfig(**({"connect": "tcp://127.0.0.1:5555"} | wrong))
    assert reason in str(caught.value)


@pytest.mark.parametrize("kind", [EvalConfig, PlayConfig])
@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"run_dir": ""}, "set run_dir=runs/my_run"),
        ({"episodes": 0}, "episodes must be between 1 and"),
        ({"episodes": 1_000_001}, "episodes must be between 1 and"),
        ({"actions": 0}, "actions must be between 1 and 100, got 0"),
        ({"actions": 101}, "actions must be between 1 and 100, got 101"),
        ({"seed": -1}, "seed must be between 0 and"),
        ({"seed": 2**63}, "seed must be between 0 and"),
    ],
)
def test_wrong_settings_of_the_tools(kind: type, wrong: dict, reason: str) -> None:
    kind(run_dir="runs/one")
    with pytest.raises(ConfigError) as caught:
        kind(**({"run_dir": "runs/one"} | wrong))
    assert reason in str(caught.value)


@pytest.mark.parametrize("out", ["film.mp4", "film", "", "gif", "film.GIF.txt"])
def test_a_picture_of_another_kind_is_refused_with_the_choices(out: str) -> None:
    with pytest.raises(ConfigError, match=r"out must end with \.gif or \.png, got"):
        PlayConfig("runs/one", out=out)


@pytest.mark.parametrize("out", ["", "/", "."])
def test_scores_need_a_file_name(out: str) -> None:
    with pytest.raises(ConfigError, match="out must name a file"):
        EvalConfig("runs/one", out=out)
