"""The attacks that need no training; the others run by `tangram-bench attack`."""

import json
from pathlib import Path

import pytest

from tangram_lab.benchmarks import attack
from tangram_lab.benchmarks.attack import FILES, LOCKSTEP, OWN, Attack, tried
from tangram_lab.benchmarks.attacks import LIVE

pytestmark = pytest.mark.slow


def test_attacks_with_files_hold(tmp_path: Path) -> None:
    rows = list(tried(FILES, tmp_path))
    assert [row["held"] for row in rows] == [True] * len(FILES), json.dumps(rows, indent=1)


def test_an_attack_that_fails_has_not_held(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor does one that the product no longer withstands."""
    monkeypatch.setattr(attack, "load_checkpoint", lambda _: None)

    def breaks(_: object) -> tuple[bool, str]:
        raise ConnectionError("gone")

    [damaged] = [one for one in FILES if "forged checkpoints" in one[1]]
    attacks: list[Attack] = [damaged, ("1", "one", "1", breaks)]
    rows = list(tried(attacks, tmp_path))
    assert [row["held"] for row in rows] == [False, False]
    assert rows[1]["seen"] == "ConnectionError('gone')"


def test_all_rows_are_tried() -> None:
    """Row 4 and others twice, in several ways."""
    rows = {one[0] for one in (*LIVE, *FILES, *OWN, *LOCKSTEP)}
    assert rows == {"held", *map(str, range(1, 14))}
