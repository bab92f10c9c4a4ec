"""Wrong settings are refused with the value, the bound and the remedy; budgets and rates."""

from typing import Any

import pytest

from master.config import MasterConfig
from tangram_core.errors import ConfigError
from tangram_core.run.service import ServiceConfig
from tangram_core.setup import from_mapping

pytestmark = pytest.mark.fast


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"run_dir": " "}, "run_dir must name a folder, got ' ': set run_dir=runs/my_run"),
        ({"run_dir": "a\nb"}, r"without line breaks and .* got 'a\\nb': set run_dir=runs/my_run"),
        ({"run_dir": "a\0b"}, r"got 'a\\x00b': set run_dir=runs/my_run"),
        ({"max_hours": float("nan")}, "max_hours must be a finite number, at least 0, got nan"),
        ({"seed": -1}, "seed must be between 0 and"),
        ({"workers": 0}, "workers must be at least 1, got 0: a run needs a player"),
    ],
)
def test_wrong_settings_are_refused(settings: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        MasterConfig(**{"run_dir": "runs/x"} | settings)


def test_settings_come_from_a_plain_mapping() -> None:
    given = {"run_dir": "runs/x", "max_hours": 2, "workers": 2, "service": {"envs": 3}}
    expected = MasterConfig("runs/x", max_hours=2.0, workers=2, service=ServiceConfig(envs=3))
    assert from_mapping(MasterConfig, given) == expected
