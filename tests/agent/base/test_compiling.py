"""Updates that are compiled as a whole: the same numbers, and a run stays with its own way."""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from master.config import COMPILERS, check_compiling
from master.learn.trainer import Trainer
from tangram_agent.base.compiling import Whole, cache_folder
from tangram_agent.base.learning import Rates
from tangram_core.errors import ConfigError, RunError
from tangram_core.run.service import ServiceConfig
from tests.agent.agents.outline.outlines import outline_setup
from tests.agent.base.test_ddpg import CASES, changed, copied, play
from tests.agent.builders import PAPER, learner_of, setup

# Agents whose updates differ in their parts: bootstrapping, several tokens, pairs.
FEW = {"kind": "mlp", "hidden": [4]}  # what is traced soon
SEVERAL = pytest.param(("ddpg", "several"), marks=pytest.mark.check)
TRACED = [("ddpg", "paper"), SEVERAL, ("pairs", "mlp")]


@pytest.fixture
def traced(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Graphs run as they were traced, without a compiler; the list of them."""
    graphs: list[Any] = []

    def kept(graph: Any, example: list[torch.Tensor], **_: Any) -> Any:
        graphs.append(graph)
        assert not [node for node in graph.graph.nodes if node.op == "get_attr"]
        return graph

    monkeypatch.setattr("torch._inductor.standalone_compile", kept)
    return graphs


@pytest.mark.slow
@pytest.mark.parametrize("case", TRACED)
def test_a_graph_updates_as_single_operations_do(
    case: tuple[str, str], traced: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """All networks, target networks, averages and optimisers, and all numbers.

    What is compiled ahead changes nothing, and is what updates need.
    """
    made = CASES[case]()
    monkeypatch.setitem(
        vars(made.agent.config), "batch_size", 16 if (made.agent_kind == "pair") else 32
    )  # as `play` draws
    plain, whole = learner_of(made, 0), learner_of(made, 0, compiled=True)
    before = copied(whole)
    whole.prepare()
    assert changed(before, whole.state()) == set()
    numbers = [play(learner, made, range(4)) for learner in (plain, whole)]
    np.testing.assert_allclose(*map(_values, numbers), rtol=2e-4, atol=2e-6)
    one, other = plain.state(), whole.state()
    assert one.keys() == other.keys()
    for name, values in one.items():
        np.testing.assert_allclose(other[name], values, rtol=1e-3, atol=2e-5, err_msg=name)
    assert len(traced) == 1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's own
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("case", TRACED)
@pytest.mark.parametrize("compiled", [False, True])
def test_a_gpu_updates_as_a_processor_does(case: tuple[str, str], compiled: bool) -> None:
    """By torch's own compiler, recorded; what was learned there is gone on with here."""
    made = CASES[case]()
    here, there = learner_of(made, 0), learner_of(made, 0, "cuda", compiled)
    before = copied(there)
    there.prepare()
    assert changed(before, there.state()) == set()
    numbers = [play(learner, made, range(4)) for learner in (here, there)]
    np.testing.assert_allclose(*map(_values, numbers), rtol=2e-3, atol=2e-5)
    assert here.updates == there.updates == 4
    for name, values in here.state().items():
        np.testing.assert_allclose(there.state()[name], values, rtol=1e-2, atol=2e-4, err_msg=name)
    here.load_state(copied(there))
    there.load_state(copied(here))  # into what was recorded
    numbers = [play(learner, made, range(4, 5)) for learner in (here, there)]
    np.testing.assert_allclose(*map(_values, numbers), rtol=2e-3, atol=2e-5)


def _values(numbers: list[Any]) -> list[list[float]]:
    return [list(one.values()) for one in numbers]


@pytest.mark.slow
def test_a_graph_goes_on_with_what_was_restored(traced: list[Any]) -> None:
    """It holds on to tensors, which a restored state must fill and not replace."""
    made = setup(agent=PAPER, net=FEW)
    first, second = (learner_of(made, seed, compiled=True) for seed in (0, 9))
    play(second, made, range(1))
    play(first, made, range(2))
    second.load_state(copied(first))
    assert play(first, made, range(2, 4)) == play(second, made, range(2, 4))
    assert changed(first.state(), second.state()) == set()
    assert traced


@dataclass(frozen=True)
class Rows:
    """What `Whole` takes, the smallest."""

    own: torch.Tensor


@pytest.mark.slow
def test_what_lies_otherwise_in_memory_is_compiled_anew(traced: list[Any]) -> None:
    """Compiled code takes its arguments as they lay when it was made."""
    total = torch.zeros(())
    whole = Whole(lambda rows, _: total.add_(rows.own[0].sum()), [total], compiled=True)
    rows = torch.arange(4.0).reshape(2, 2)
    for own, graphs in ((rows, 1), (rows.clone(), 1), (rows.T, 2)):
        whole(Rows(own), Rates(0.0, 0.0, 0.0))
        assert len(traced) == graphs
    assert total == 1.0 + 1.0 + 2.0


@pytest.mark.slow
def test_a_compiler_that_fails_is_told_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: Any, **__: Any) -> Any:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("torch._inductor.standalone_compile", fails)
    learner = learner_of(setup(agent=PAPER, net=FEW), 0, compiled=True)
    before = copied(learner)
    with pytest.raises(RunError, match=r"No space left.*: empty .*service.compile=false"):
        learner.prepare()
    assert changed(before, learner.state()) == set()


@pytest.mark.fast
def test_each_torch_and_each_processor_has_its_own_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TORCHINDUCTOR_CACHE_DIR", raising=False)
    here = cache_folder()
    assert here.name.startswith(torch.__version__)
    monkeypatch.setattr(Path, "read_bytes", lambda _: b"model: 1\nflags\t\t: fpu sse\n")
    assert cache_folder() != here
    assert cache_folder().parent == here.parent


@pytest.mark.check
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's own
@pytest.mark.skipif(not any(map(shutil.which, COMPILERS)), reason="needs a C++ compiler")
def test_a_compiled_update_is_the_same_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By torch's own compiler."""
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    made = setup(agent=PAPER, net=FEW)
    plain, whole = learner_of(made, 0), learner_of(made, 0, compiled=True)
    before = copied(whole)
    once = play(whole, made, range(3))
    after = copied(whole)
    whole.load_state(before)
    assert play(whole, made, range(3)) == once
    assert changed(after, whole.state()) == set()
    expected = play(plain, made, range(3))
    np.testing.assert_allclose(_values(once), _values(expected), rtol=1e-3, atol=1e-5)


@pytest.mark.fast
@pytest.mark.parametrize("began", [True, False])
def test_a_run_stays_with_what_it_began_with(began: bool) -> None:
    made = setup()
    before = Trainer(made, 0, "cpu", compiled=began)
    arrays, counters = before.state()
    Trainer(made, 0, "cpu", compiled=began).load_state(arrays, counters)
    message = f"began with service.compile={str(began).lower()}"
    with pytest.raises(RunError, match=message):
        Trainer(made, 0, "cpu", compiled=not began).load_state(arrays, counters)


@pytest.mark.fast
def test_what_cannot_be_compiled_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = ServiceConfig(compile=True)
    check_compiling(ServiceConfig())
    with pytest.raises(ConfigError, match="compile=true changes nothing with agent.kind=outline"):
        outline_setup().agent.check_training(compiled=True)  # before there is a folder of the run
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(ConfigError, match="no-such-compiler is not found: unset CXX"):
        check_compiling(wanted)
    monkeypatch.delenv("CXX")
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ConfigError, match=r"g\+\+ or clang\+\+ is not found: install g"):
        check_compiling(wanted)
