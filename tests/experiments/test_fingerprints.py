"""Fingerprints: the same bits whatever kernels the processor would choose, and errors that tell."""

from pathlib import Path

import pytest

from conf.cli import composed
from tangram_lab.experiments import fingerprints
from tangram_lab.experiments.fingerprints import make_fingerprints
from tangram_sim.errors import ConfigError, RunError

CONFIG = composed("train", ["run_dir=x", "sim.actions_per_token=1"])
# What two other processors would have chosen.
OTHERS = [
    {"ATEN_CPU_CAPABILITY": "default", "MKL_CBWR": "AVX2", "OPENBLAS_CORETYPE": "PRESCOTT"},
    {"NPY_DISABLE_CPU_FEATURES": "X86_V3,X86_V4", "OMP_NUM_THREADS": "2"},
]


@pytest.mark.slow
def test_a_fingerprint_is_the_same_on_other_processors(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "own.py").write_text(
        "def near(achieved, desired, layout):\n"
        "    print('near')\n"
        "    return -abs(achieved - desired).mean(axis=(1, 2))\n"
    )
    own = composed("train", ["run_dir=x", f"reward.name={tmp_path}/own.py:near"])
    found = []
    for kernels in OTHERS:
        with monkeypatch.context() as machine:
            for name, value in kernels.items():
                machine.setenv(name, value)
            found.append(make_fingerprints({"one": CONFIG, "own": own, "same": CONFIG}))
    assert all(one == found[0] for one in found)
    assert found[0]["one"] == found[0]["same"] != found[0]["own"]
    assert found[0]["one"]["weights"] > found[0]["one"]["moved"] > 0.0


@pytest.mark.fast
def test_what_cannot_be_made_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert make_fingerprints({}) == {}
    with pytest.raises(ConfigError, match="batch_size"):
        make_fingerprints({"one": CONFIG | {"agent": CONFIG["agent"] | {"batch_size": -1}}})
    half = "printf '[\"one\", {'"  # it ends in the middle of a line
    for script, told in (
        (f"{half}; exit 1", "^no fingerprint could be made: status 1$"),
        (f"{half}; echo no room >&2; exit 3", "^no fingerprint could be made: no room$"),
        ("exit 0", "^fingerprints of 0 of 1 trainings were made$"),
    ):
        child = tmp_path / "child"
        child.write_text(f"#!/bin/sh\n{script}\n")
        child.chmod(0o700)
        monkeypatch.setattr(fingerprints.sys, "executable", str(child))
        with pytest.raises(RunError, match=told):
            make_fingerprints({"one": CONFIG})
